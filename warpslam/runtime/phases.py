"""Names for the parts of the algorithm, so that a profile can tell whose kernels it sees.

A phase entered within another is part of it: ``"mapping / frustum selection"``. Phases follow the thread that enters
them; what that thread hands to the launching module's workers stays in its phase.
"""

from __future__ import annotations

import itertools
import threading
import time
from contextlib import ContextDecorator
from contextvars import ContextVar, Token
from dataclasses import dataclass, field
from typing import Protocol

clock = time.perf_counter

OTHER = "other"
"""Path of what is in no phase."""


@dataclass
class Span:
    """One stay in a phase.

    path: Names of the phase and of those around it, joined by " / ".
    thread: Number of the thread that entered it (`thread_number`).
    start, stop: By `clock` [s].
    inner: Seconds spent in phases entered within, on the same thread.
    """

    path: str
    thread: int
    parent: Span | None
    start: float = 0.0
    stop: float = 0.0
    inner: float = 0.0
    token: Token | None = field(default=None, repr=False)


class PhaseListener(Protocol):
    """What an active profile does about phases."""

    def changes(self) -> None:
        """The current phase is about to change."""

    def left(self, span: Span) -> None:
        """A stay is over."""


listener: PhaseListener | None = None
_current: ContextVar[Span | None] = ContextVar("warpslam_phase", default=None)
_numbers = itertools.count(1)
_thread = threading.local()


def thread_number() -> int:
    """Of this thread, from 1 on: no other one ever has it, while the system's identity is given again."""
    number: int | None = getattr(_thread, "number", None)
    if number is None:
        number = _thread.number = next(_numbers)
    return number


def current() -> Span | None:
    """The innermost phase of this thread, while a profile is active."""
    return _current.get()


class phase(ContextDecorator):
    """``with phase("growth"):`` or ``@phase("growth")``; does nothing while no profile is active."""

    def __init__(self, name: str) -> None:
        self.name = name
        self._open: tuple[PhaseListener, Span] | None = None

    def _recreate_cm(self) -> phase:
        # A decorated function may run on several threads, or within itself.
        return phase(self.name)

    def __enter__(self) -> None:
        if listener is not None:
            listener.changes()
            self._open = listener, enter(self.name)

    def __exit__(self, *_: object) -> None:
        if self._open is not None:
            profile, span = self._open
            self._open = None
            profile.changes()
            leave(span)
            profile.left(span)


def enter(name: str) -> Span:
    """Begin a stay in a phase within the current one."""
    parent = _current.get()
    path = name if parent is None or parent.path == OTHER else f"{parent.path} / {name}"
    span = Span(path, thread_number(), parent)
    span.token = _current.set(span)
    span.start = clock()
    return span


def leave(span: Span) -> None:
    """End a stay; on the thread that began it."""
    span.stop = clock()
    if span.token is not None:
        _current.reset(span.token)
    if span.parent is not None and span.parent.thread == span.thread:
        span.parent.inner += span.stop - span.start
