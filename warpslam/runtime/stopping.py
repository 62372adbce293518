"""A request to stop that comes from outside: SIGTERM is what ctrl-C is, but for the exit code."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


class Terminated(KeyboardInterrupt):
    """SIGTERM: of a scheduler whose time is up, of ``docker stop``, of ``kill``."""


_arrived = threading.Event()


def was_terminated() -> bool:
    """Whether this process has been sent SIGTERM since `terminable` began."""
    return _arrived.is_set()


@contextmanager
def terminable() -> Iterator[None]:
    """SIGTERM raises `Terminated` in the main thread during the block."""
    if threading.current_thread() is not threading.main_thread():  # where no handler can be set
        yield
        return
    _arrived.clear()

    def stop(number: int, frame: Any) -> None:
        _arrived.set()
        raise Terminated

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
