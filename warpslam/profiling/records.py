"""What a profile keeps of a launch and of a stay in a phase."""

from __future__ import annotations

from dataclasses import dataclass

from warpslam.profiling.costs import Work

GPU = 0
"""Stands for a thread where a kernel ran on the device."""


@dataclass(frozen=True, slots=True)
class Launch:
    """A kernel launch.

    kernel: Name; " (adjoint)" for a generated adjoint.
    path: Phase.
    thread: Identity of the thread it ran on, or `GPU`.
    own: Whether that is the thread that entered the phase.
    start, stop: Of the kernel alone, by `phases.clock` [s]; on the GPU only their difference is measured.
    """

    kernel: str
    path: str
    thread: int
    own: bool
    start: float
    stop: float
    work: Work


@dataclass(frozen=True, slots=True)
class Interval:
    """Time of a thread that went into something else than a kernel.

    what: "launch" (preparing arguments), "wait" (for the other slices), "load" (of the module ``name``, compiling it if
    need be), "profiler" (counting points).
    """

    what: str
    path: str
    thread: int
    own: bool
    start: float
    seconds: float
    name: str = ""
