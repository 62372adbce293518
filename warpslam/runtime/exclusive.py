"""One user at a time: what keeps two threads, or a forked process, out of an object whose arrays are being written."""

from __future__ import annotations

import functools
import os
import threading
from collections.abc import Callable
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar

from warpslam.errors import InputError

P = ParamSpec("P")
R = TypeVar("R")


class ObjectLock:
    """Held while an object is used: another thread waits until it is free.

    A process that was forked may go on with the object where it was made on the CPU and nobody used it at that moment.

    Args:
        outlives_fork: Whether a forked process may use the object: no thread and no GPU belongs to it.
    """

    def __init__(self, *, outlives_fork: bool = True) -> None:
        self.outlives_fork = outlives_fork
        self._begin()

    def _begin(self) -> None:
        self._lock, self._pid, self._depth = threading.RLock(), os.getpid(), 0

    def __enter__(self) -> None:
        if os.getpid() != self._pid:
            if self._depth or not self.outlives_fork:
                raise InputError(
                    "this object was made before the process was forked, and its threads or its GPU stayed behind: "
                    "make it in the new process, or start processes by multiprocessing's method spawn"
                )
            self._begin()
        self._lock.acquire()
        self._depth += 1

    def __exit__(self, *_: object) -> None:
        self._depth -= 1
        self._lock.release()


class Locked(Protocol):
    """What has a lock."""

    @property
    def lock(self) -> ObjectLock:
        """Held while the object is used."""


S = TypeVar("S", bound=Locked)


def exclusive(method: Callable[Concatenate[S, P], R]) -> Callable[Concatenate[S, P], R]:
    """A method that holds the lock of its object."""

    @functools.wraps(method)
    def locked(self: S, *arguments: Any, **keywords: Any) -> R:
        with self.lock:
            return method(self, *arguments, **keywords)

    return locked  # type: ignore[return-value]
