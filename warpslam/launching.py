"""Launching Warp kernels: all CPU cores, launches recorded once and replayed.

Warp runs a CPU kernel on the calling thread and releases the GIL meanwhile. Kernels over rays and their samples
therefore run in equal slices of the rays, one a thread; those that add up gradients get a buffer (``slot``) for each
slice, since atomics are not atomic on the CPU. The number of slices is fixed, so that sums are formed in the same
order in every run.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import lru_cache, partial
from typing import Any

import warp as wp

from warpslam.errors import ConfigError
from warpslam.kernels import decoder

MAX_SLICES = 8

Step = tuple[wp.Kernel, Any, list]
"""A kernel, its dimensions and its arguments."""


def slice_count(device: wp.Device) -> int:
    """Slices of a launch over rays, which is also the number of gradient buffers: the CPU's cores (at most 8), 1 on
    CUDA.
    """
    if device.is_cuda:
        return 1
    return max(1, min(_core_count(), MAX_SLICES))


@lru_cache(maxsize=1)
def _core_count() -> int:
    """Cores that this process may use; fewer where several share a machine and WARPSLAM_THREADS says so."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    text = os.environ.get("WARPSLAM_THREADS", "")
    if not text:
        return cores
    if not text.isdecimal() or int(text) < 1:
        raise ConfigError(f"environment variable WARPSLAM_THREADS = {text!r} must be a whole number from 1 on")
    return min(cores, int(text))


@lru_cache(maxsize=1)
def _pool() -> ThreadPoolExecutor:
    # Tracking and mapping may both run slices (`warpslam.scheduler`), and neither should queue behind the other.
    return ThreadPoolExecutor(max_workers=2 * (MAX_SLICES - 1), thread_name_prefix="warpslam")


class Launcher:
    """Launches kernels on a device, and records the iterations that are repeated (`iterate`) for replay.

    Recording does not suspend execution: the first iteration of a kind runs while it is recorded.
    """

    def __init__(self, device: wp.Device) -> None:
        self.device = device
        self._program: Program | None = None
        self._tape: wp.Tape | None = None
        self._kinds: dict[str, tuple[tuple, Program]] = {}

    def iterate(self, kind: str, uses: tuple, iteration: Callable[[], None]) -> None:
        """One iteration of a kind: recorded when it runs for the first time, and replayed from then on.

        uses: What the iteration depends on and keeps its identity (arrays) or value (numbers) as long as the record
            holds; with another one it is recorded anew.
        """
        known = self._kinds.get(kind)
        if known is not None and _same(known[0], uses):
            known[1].run()
            return
        program = Program(self.device)
        self._program = program
        try:
            iteration()
        finally:
            self._program = None
        self._kinds[kind] = uses, program

    def forget(self) -> None:
        """Drop all records."""
        self._kinds.clear()

    def launch(self, kernel: wp.Kernel, dim: Any, inputs: list) -> None:
        """One launch over ``dim`` threads."""
        self.call(self.command(kernel, dim, inputs).launch)

    @contextmanager
    def tape(self) -> Iterator[wp.Tape]:
        """A `wp.Tape` that gets the adjoints of this launcher's taped launches within the ``with`` block.

        It is never entered itself: an entered tape is the whole process's, and would take up what other threads launch.
        """
        self._tape = wp.Tape()
        try:
            yield self._tape
        finally:
            self._tape = None

    def launch_taped(self, kernel: wp.Kernel, dim: int, inputs: list, outputs: list) -> None:
        """A launch whose generated adjoint goes to the active tape, if there is one; arguments are arrays and numbers.
        """
        self.launch(kernel, dim, inputs + outputs)
        if self._tape is None:
            return
        gradients = ([getattr(argument, "grad", None) for argument in part] for part in (inputs, outputs))
        adjoint = wp.launch(
            kernel,
            dim,
            inputs,
            outputs,
            *gradients,
            device=self.device,
            adjoint=True,
            record_cmd=True,
            record_tape=False,
        )
        self._tape.record_func(adjoint.launch, [array for array in outputs if array.requires_grad])

    def slices(self, count: int, steps: Callable[[int, int, int], list[Step]]) -> None:
        """Launches that work on rays (or rows) apart: ``steps(first, stop, slot)`` for each slice of ``count``."""
        commands = self.slice_commands(count, steps)
        run_slices(commands)
        if self._program is not None:
            self._program.add_slices(commands)

    def slice_commands(self, count: int, steps: Callable[[int, int, int], list[Step]]) -> list[list[wp.Launch]]:
        """The commands of `slices` without running them."""
        number = slice_count(self.device)
        bounds = [count * n // number for n in range(number + 1)]
        return [
            [self.command(*step) for step in steps(first, stop, slot)]
            if stop > first
            else []
            for slot, (first, stop) in enumerate(zip(bounds[:-1], bounds[1:], strict=True))
        ]

    def call(self, function: Callable[[], Any]) -> None:
        """Call something without arguments, such as `wp.array.zero_` or the backward pass of a tape."""
        function()
        if self._program is not None:
            self._program.add(function)

    def command(self, kernel: wp.Kernel, dim: Any, inputs: list) -> wp.Launch:
        """A launch that has not happened yet."""
        return wp.launch(kernel, dim=dim, inputs=inputs, device=self.device, record_cmd=True, record_tape=False)


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


def _same(a: tuple, b: tuple) -> bool:
    if len(a) != len(b):
        return False
    return all(x is y or (isinstance(x, int | float | str) and x == y) for x, y in zip(a, b, strict=True))


def run_slices(commands: list[list[wp.Launch]]) -> None:
    """Each slice's launches in order, the slices side by side."""
    first, *others = commands
    waiting = [_pool().submit(_run_all, part) for part in others]
    _run_all(first)
    for other in waiting:
        other.result()


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


def decoders_for(device: wp.Device):
    """The decoder kernels built for this kind of device."""
    return decoder.CUDA if device.is_cuda else decoder.CPU


def synchronize(device: wp.Device) -> None:
    """Wait for the device's current stream, so that wall-clock times mean something (nothing to do on the CPU)."""
    if device.is_cuda:
        wp.synchronize_stream(device)
