"""A request to stop that comes from outside: SIGTERM is what ctrl-C is, but for the exit code; and what may be finished
all the same.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


class Terminated(KeyboardInterrupt):
    """SIGTERM: of a scheduler whose time is up, of ``docker stop``, of ``kill``."""


_arrived = threading.Event()
_is_due = threading.Event()  # as long as `terminable` lasts


def was_terminated() -> bool:
    """Whether this process has been sent SIGTERM since `terminable` began."""
    return _arrived.is_set()


def raise_if_terminated() -> None:
    """Raise what a SIGTERM has raised already, but where nothing heeds it: many a library's import swallows it.

    Raises:
        Terminated: The signal has come, and the block of `terminable` goes on.
    """
    if _is_due.is_set():
        raise Terminated


@contextmanager
def terminable() -> Iterator[None]:
    """SIGTERM raises `Terminated` in the main thread during the block."""
    if threading.current_thread() is not threading.main_thread():  # where no handler can be set
        yield
        return
    _arrived.clear()

    def stop(number: int, frame: Any) -> None:
        _arrived.set()
        _is_due.set()
        raise Terminated

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
        _is_due.clear()


class Deferral:
    """Keeps the first request to stop back, from `defer` on: what is being done then is short, and dear if it is lost.

    The second one is as ever. A context, which gives the signals back to whom they belonged. Without effect outside the
    main thread, and for signals that nobody handles.
    """

    def __init__(self) -> None:
        self.has_come = False
        """Whether one was kept back."""
        self._before: dict[int, Any] = {}

    def defer(self) -> None:
        """From now on."""
        if threading.current_thread() is not threading.main_thread() or self._before or self.has_come:
            return
        for number in (signal.SIGINT, signal.SIGTERM):
            handler = signal.getsignal(number)
            if callable(handler):
                self._before[number] = handler
                signal.signal(number, self._keep_back)

    def _keep_back(self, number: int, frame: Any) -> None:
        self.has_come = True
        if number == signal.SIGTERM:
            _arrived.set()
        self._give_back()

    def _give_back(self) -> None:
        while self._before:
            signal.signal(*self._before.popitem())

    def __enter__(self) -> Deferral:
        return self

    def __exit__(self, *_: object) -> None:
        self._give_back()
