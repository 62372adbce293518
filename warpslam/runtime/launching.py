"""Launching Warp kernels: all CPU cores, launches recorded once and replayed.

Warp runs a CPU kernel on the calling thread and releases the GIL meanwhile. Kernels over rays and their samples
therefore run in equal slices of the rays, one a thread; those that add up gradients get a buffer (``slot``) for each
slice, since atomics are not atomic on the CPU. The number of slices is fixed, so that sums are formed in the same
order in every run, on any number of cores.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import warp as wp

from warpslam.runtime.cores import slice_count
from warpslam.runtime.program import Program, run_slices

Step = tuple[wp.Kernel, Any, list]
"""A kernel, its dimensions and its arguments."""


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
        """A launch whose generated adjoint goes to the active tape, if any; arguments are arrays and numbers."""
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
            block_dim=kernel.module.options["block_dim"],
            adjoint=True,
            record_cmd=True,
            record_tape=False,
        )
        self._tape.record_func(adjoint.launch, [array for array in outputs if array.requires_grad])

    def slices(self, count: int, steps: Callable[[int, int, int], list[Step]], *, whole: bool = False) -> None:
        """Launches that work on rays (or rows) apart: ``steps(first, stop, slot)`` for each slice of ``count``.

        whole: One slice has all.
        """
        commands = self.slice_commands(count, steps, whole=whole)
        run_slices(commands)
        if self._program is not None:
            self._program.add_slices(commands)

    def spread(self, kernel: wp.Kernel, shape: int | tuple[int, ...], inputs: list) -> None:
        """One launch on all cores: `slices` along the first axis of ``shape``. The kernel takes the first index of its
        slice before ``inputs``.
        """
        count, *rest = (shape,) if isinstance(shape, int) else shape

        def steps(first: int, stop: int, slot: int) -> list[Step]:
            return [(kernel, (stop - first, *rest), [first, *inputs])]

        self.slices(count, steps)

    def slice_commands(
        self, count: int, steps: Callable[[int, int, int], list[Step]], *, whole: bool = False
    ) -> list[list[wp.Launch]]:
        """The commands of `slices` without running them."""
        number = slice_count(self.device)
        bounds = [0, *[count] * number] if whole else [count * n // number for n in range(number + 1)]
        return [
            [self.command(*step) for step in steps(first, stop, slot)] if stop > first else []
            for slot, (first, stop) in enumerate(zip(bounds[:-1], bounds[1:], strict=True))
        ]

    def call(self, function: Callable[[], Any]) -> None:
        """Call something without arguments, such as `wp.array.zero_` or the backward pass of a tape."""
        function()
        if self._program is not None:
            self._program.add(function)

    def command(self, kernel: wp.Kernel, dim: Any, inputs: list) -> wp.Launch:
        """A launch that has not happened yet."""
        # On CUDA the block size is part of a module: with another one it would be compiled once more.
        return wp.launch(
            kernel,
            dim=dim,
            inputs=inputs,
            device=self.device,
            block_dim=kernel.module.options["block_dim"],
            record_cmd=True,
            record_tape=False,
        )


def _same(a: tuple, b: tuple) -> bool:
    if len(a) != len(b):
        return False
    return all(x is y or (isinstance(x, int | float | str) and x == y) for x, y in zip(a, b, strict=True))


def synchronize(device: wp.Device) -> None:
    """Wait for the device's current stream, so that wall-clock times mean something (nothing to do on the CPU)."""
    if device.is_cuda:
        wp.synchronize_stream(device)
