"""What a profile keeps: launches of kernels, stays in phases, and what else took time."""

from __future__ import annotations

from dataclasses import dataclass, field

from warpslam.profiling.costs import Work
from warpslam.runtime.phases import Span

GPU = 0
"""Stands for the number of a thread where a kernel ran on the device."""


@dataclass(frozen=True, slots=True)
class Launch:
    """A kernel launch; its times are those of the kernel alone."""

    kernel: str
    """Name; " (adjoint)" follows that of a generated adjoint."""
    path: str
    """Phase."""
    thread: int
    """Number of the thread it ran on, or `GPU`."""
    own: bool
    """Whether that is the thread that entered the phase."""
    start: float
    """By `phases.clock` [s]; on the GPU only the difference to ``stop`` is measured."""
    stop: float
    """By `phases.clock` [s]."""
    work: Work
    dim: tuple[int, ...] = ()
    """Its dimensions; empty where a launch on the GPU is not told apart."""


@dataclass(frozen=True, slots=True)
class Interval:
    """Time of a thread that went into something else than a kernel."""

    what: str
    """Preparing a "launch", "wait" for other slices, "load" of a module, or "profiler", which counts points."""
    path: str
    """Phase."""
    thread: int
    """Number of the thread."""
    own: bool
    """Whether that is the thread that entered the phase."""
    start: float
    """By `phases.clock` [s]."""
    seconds: float
    """Length [s]."""
    name: str = ""
    """Module that was loaded, and compiled if need be."""


@dataclass
class Recording:
    """What ran on all threads while a profile was active."""

    launches: list[Launch] = field(default_factory=list)
    """In the order in which they ended."""
    intervals: list[Interval] = field(default_factory=list)
    """Likewise."""
    spans: list[Span] = field(default_factory=list)
    """Stays in phases, likewise."""
    threads: dict[int, str] = field(default_factory=dict)
    """Names of threads by number (`phases.thread_number`)."""
    start: float = 0.0
    """When it began, by `phases.clock` [s]."""
    wall_seconds: float = 0.0
    """How long it took [s]."""
    peak_gflops: float = 0.0
    """Single-precision matrix product of NumPy on all cores, measured at the beginning [GFLOP/s]."""
