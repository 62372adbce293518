"""Launches that were recorded, and their replay: on the CPU slice by slice, on CUDA as one graph."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache, partial
from typing import Any

import warp as wp

from warpslam.runtime.cores import MAX_SLICES, thread_count


@lru_cache(maxsize=1)
def _pool() -> ThreadPoolExecutor:
    # Tracking and mapping may both run slices (`mapping.scheduler`), and neither should queue behind the other.
    return ThreadPoolExecutor(max_workers=2 * (MAX_SLICES - 1), thread_name_prefix="warpslam")


if hasattr(os, "register_at_fork"):
    # Threads do not survive a fork: a child that waited for those of its parent would wait for ever.
    os.register_at_fork(after_in_child=_pool.cache_clear)


class Program:
    """An iteration recorded by a `Launcher`: `run` replays it; on CUDA as one graph, captured at the first replay."""

    def __init__(self, device: wp.Device) -> None:
        self.device = device
        self._steps: list[Callable[[], Any]] = []
        self._slices: list[list[wp.Launch]] | None = None
        self._graph: Any = None

    def add(self, step: Callable[[], Any]) -> None:
        """Append a call."""
        self._steps.append(step)
        self._slices = None

    def add_slices(self, commands: list[list[wp.Launch]]) -> None:
        """Append launches by slice; those that follow one another directly need no common end."""
        if self._slices is not None:
            for mine, more in zip(self._slices, commands, strict=True):
                mine.extend(more)
            return
        self._slices = [list(part) for part in commands]
        self._steps.append(partial(run_slices, self._slices))

    def run(self) -> None:
        """Once more."""
        if not self.device.is_cuda:
            self._replay()
            return
        if self._graph is None:
            with wp.ScopedCapture(self.device) as capture:
                self._replay()
            self._graph = capture.graph
        wp.capture_launch(self._graph)

    def _replay(self) -> None:
        for step in self._steps:
            step()


def run_slices(commands: list[list[wp.Launch]]) -> None:
    """Each slice's launches in order, the slices side by side on as many threads as there are cores.

    Which thread runs a slice changes nothing: each has buffers of its own.
    """
    threads = min(len(commands), thread_count())
    mine, *others = (commands[n::threads] for n in range(threads))
    waiting = [_pool().submit(_run_parts, parts) for parts in others]
    _run_parts(mine)
    for other in waiting:
        other.result()


def _run_parts(parts: list[list[wp.Launch]]) -> None:
    for part in parts:
        _run_all(part)


_LAUNCH = wp.Launch.launch


def _run_all(commands: list[wp.Launch]) -> None:
    # A profiler that replaces Warp's method sees every launch.
    if wp.Launch.launch is not _LAUNCH or (commands and not commands[0].device.is_cpu):
        for command in commands:
            command.launch()
        return
    for command in commands:
        call = getattr(command, "packed", None)
        if call is None:
            call = command.packed = _pack(command)
        call(command.params[0])


def _pack(command: wp.Launch) -> Callable[[Any], None]:
    """The launch of a command on the CPU, given its bounds, with the arguments as the kernel reads them.

    Warp writes the arguments into a new structure at every launch, 10 us of Python a launch, which two threads spend
    one after the other. All of ours are numbers and arrays that stay the same.
    """
    arguments = command.kernel.adj.args
    fields = [(argument.label, type(value)) for argument, value in zip(arguments, command.params[1:], strict=True)]
    packed = type("Arguments", (ctypes.Structure,), {"_fields_": fields})(*command.params[1:])
    forward, reference = command.hooks.forward, ctypes.byref(packed)
    return lambda bounds: forward(ctypes.byref(bounds), reference)
