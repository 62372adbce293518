"""The figures of a profile: by phase, by kernel, and what was compiled."""

from __future__ import annotations

import io
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import asdict, dataclass

import numpy as np
from rich.console import Console
from rich.table import Table

from warpslam.profiling.records import Launch, Recording
from warpslam.storage.json_files import to_json

_NAME_WIDTH = 14  # at least; longer names go on in the next line


@dataclass
class PhaseFigures:
    """Seconds of a phase without those of phases within it; all but ``elsewhere`` on the thread that entered it."""

    phase: str
    """Names of the phase and of those around it."""
    calls: int = 0
    """How often it was entered."""
    wall: float = 0.0
    """All of it; the sum of the next six."""
    kernels: float = 0.0
    """In kernels."""
    launch: float = 0.0
    """Preparing launches."""
    wait: float = 0.0
    """For the slices on other threads."""
    load: float = 0.0
    """Loading modules, compiling them included."""
    profiler: float = 0.0
    """Counting points, which an unprofiled run does not."""
    python: float = 0.0
    """The rest: Python, NumPy, and on CUDA waiting for the device."""
    elsewhere: float = 0.0
    """In kernels on other threads, or on the GPU."""


@dataclass
class KernelFigures:
    """A kernel in a phase; rates are over ``wall``, and None where the kernel has no such work."""

    kernel: str
    """Name."""
    phase: str
    """Path of the phase."""
    calls: int
    """Launches."""
    seconds: float
    """Summed over all threads."""
    wall: float
    """Seconds during which at least one thread was in it."""
    mean_ms: float
    """Mean of a launch [ms]."""
    p95_ms: float
    """What 95 % of the launches stay below [ms]."""
    share: float
    """Of the seconds of all kernels."""
    points: int | None = None
    """Samples computed; None for kernels that do not work on samples."""
    counted: bool = True
    """False if ``points`` is an upper bound."""
    points_per_second: float | None = None
    """Samples a second."""
    gflop: float | None = None
    """Operations of all launches [10^9]."""
    gflops: float | None = None
    """Operations a second [10^9/s]."""
    peak_share: float | None = None
    """``gflops`` over the rate of a matrix product on all cores."""
    gigabytes: float | None = None
    """Read and written [GB]."""
    gigabytes_per_second: float | None = None
    """Read and written a second [GB/s]."""


@dataclass
class ModuleFigures:
    """A module that was loaded."""

    module: str
    """Name."""
    phase: str
    """Path of the phase."""
    seconds: float
    """Loading it, compiling it included."""


class Report:
    """Figures of a finished profile, largest first.

    phases, kernels, modules: Rows of the tables.
    overhead_us: Mean time a launch takes beyond its kernel [microseconds].
    """

    def __init__(self, recording: Recording) -> None:
        self.wall_seconds, self.peak_gflops = recording.wall_seconds, recording.peak_gflops
        self.launch_count = len(recording.launches)
        self.phases = _phases(recording)
        self.kernels = _kernels(recording)
        self.modules = [ModuleFigures(i.name, i.path, i.seconds) for i in recording.intervals if i.what == "load"]
        self.modules.sort(key=lambda m: -m.seconds)
        launch_seconds = sum(i.seconds for i in recording.intervals if i.what == "launch")
        self.overhead_us = 1e6 * launch_seconds / max(self.launch_count, 1)

    def to_json(self) -> str:
        """All figures as JSON text; seconds, GFLOP/s and GB/s."""
        return to_json(
            {
                "wall_seconds": self.wall_seconds,
                "peak_gflops": self.peak_gflops,
                "launches": self.launch_count,
                "launch_overhead_us": self.overhead_us,
                "phases": [asdict(figures) for figures in self.phases],
                "kernels": [asdict(figures) for figures in self.kernels],
                "modules": [asdict(figures) for figures in self.modules],
            }
        )

    def tables(self, min_share: float = 0.0) -> list[Table]:
        """Tables for `rich`: phases, kernels, and modules if any was loaded.

        min_share: Kernels with less than this share of the time are summed in one row.
        """
        tables = [self._phase_table(), self._kernel_table(min_share)]
        return [*tables, self._module_table()] if self.modules else tables

    def table(self, width: int) -> str:
        """The tables as text, ``width`` characters wide."""
        console = Console(file=io.StringIO(), width=width)
        for table in self.tables():
            console.print(fitted(table, width))
        assert isinstance(console.file, io.StringIO)
        return console.file.getvalue()

    def _phase_table(self) -> Table:
        title = f"Phases, seconds ({self.wall_seconds:.2f} s, {self.launch_count} launches)"
        parts = ("wall", "kernels", "launch", "wait", "load", "python", "profiler", "elsewhere")
        table = _table(title, ["phase"], ["calls", *parts])
        for row in self.phases:
            table.add_row(row.phase, str(row.calls), *(f"{getattr(row, part):.3f}" for part in parts))
        return table

    def _kernel_table(self, min_share: float) -> Table:
        title = f"Kernels (matrix product on all cores: {self.peak_gflops:.0f} GFLOP/s)"
        columns = ["calls", "total s", "mean ms", "p95 ms", "share", "Mpoint/s", "GFLOP/s", "of peak", "GB/s"]
        table = _table(title, ["kernel", "phase"], columns)
        small = [row for row in self.kernels if row.share < min_share]
        for row in self.kernels[: len(self.kernels) - len(small)]:
            bound = "" if row.counted else "<= "
            table.add_row(
                row.kernel,
                row.phase,
                str(row.calls),
                f"{row.seconds:.3f}",
                f"{row.mean_ms:.3f}",
                f"{row.p95_ms:.3f}",
                f"{row.share:.1%}",
                _optional(row.points_per_second, 1e-6, "{:.2f}", bound),
                _optional(row.gflops, 1.0, "{:.1f}", bound),
                _optional(row.peak_share, 100.0, "{:.0f} %", bound),
                _optional(row.gigabytes_per_second, 1.0, "{:.2f}"),
            )
        if small:
            calls, seconds = sum(row.calls for row in small), sum(row.seconds for row in small)
            share = sum(row.share for row in small)
            table.add_row(f"{len(small)} more", "", str(calls), f"{seconds:.3f}", "", "", f"{share:.1%}")
        return table

    def _module_table(self) -> Table:
        table = _table("Modules loaded, compiled where the kernel cache had none", ["module", "phase"], ["seconds"])
        for row in self.modules:
            table.add_row(row.module, row.phase, f"{row.seconds:.3f}")
        return table


def _phases(recording: Recording) -> list[PhaseFigures]:
    figures: dict[str, PhaseFigures] = {}
    for span in recording.spans:
        row = figures.setdefault(span.path, PhaseFigures(span.path))
        row.calls += 1
        row.wall += span.stop - span.start - span.inner
    for launch in recording.launches:
        row = figures.setdefault(launch.path, PhaseFigures(launch.path))
        seconds = launch.stop - launch.start
        if launch.own:
            row.kernels += seconds
        else:
            row.elsewhere += seconds
    for interval in recording.intervals:
        if interval.own:
            row = figures.setdefault(interval.path, PhaseFigures(interval.path))
            setattr(row, interval.what, getattr(row, interval.what) + interval.seconds)
    for row in figures.values():
        row.python = row.wall - row.kernels - row.launch - row.wait - row.load - row.profiler
    return sorted(figures.values(), key=lambda row: -row.wall)


def _kernels(recording: Recording) -> list[KernelFigures]:
    groups: dict[tuple[str, str], list[Launch]] = defaultdict(list)
    for launch in recording.launches:
        groups[launch.kernel, launch.path].append(launch)
    total = sum(launch.stop - launch.start for launch in recording.launches)
    rows = [_kernel(name, path, launches, total, recording.peak_gflops) for (name, path), launches in groups.items()]
    return sorted(rows, key=lambda row: -row.seconds)


def _kernel(name: str, path: str, launches: list[Launch], total: float, peak: float) -> KernelFigures:
    times = np.array([launch.stop - launch.start for launch in launches])
    wall = _covered((launch.start, launch.stop) for launch in launches)
    seconds = float(times.sum())
    row = KernelFigures(
        kernel=name,
        phase=path,
        calls=len(launches),
        seconds=seconds,
        wall=wall,
        mean_ms=1e3 * float(times.mean()),
        p95_ms=1e3 * float(np.percentile(times, 95)),
        share=seconds / max(total, 1e-12),
        counted=all(launch.work.counted for launch in launches),
    )
    wall = max(wall, 1e-12)
    points = [launch.work.points for launch in launches if launch.work.points is not None]
    if points:
        row.points = sum(points)
        row.points_per_second = row.points / wall
    flop, moved = (sum(getattr(launch.work, name) for launch in launches) for name in ("flop", "bytes"))
    if flop:
        row.gflop = flop / 1e9
        row.gflops = row.gflop / wall
        row.peak_share = row.gflops / peak if peak else None
    if moved:
        row.gigabytes = moved / 1e9
        row.gigabytes_per_second = row.gigabytes / wall
    return row


def _covered(intervals: Iterable[tuple[float, float]]) -> float:
    """Length of the union of intervals."""
    length, reached = 0.0, -np.inf
    for start, stop in sorted(intervals):
        length += max(stop - max(start, reached), 0.0)
        reached = max(reached, stop)
    return float(length)


def _table(title: str, names: list[str], figures: list[str]) -> Table:
    table = Table(title=title, title_justify="left")
    for name in names:
        table.add_column(name, overflow="fold", min_width=_NAME_WIDTH)
    for name in figures:
        table.add_column(name, justify="right", no_wrap=True)
    return table


def fitted(table: Table, width: int) -> Table:
    """The table without the figures at its right end that do not fit into ``width`` characters: names never go."""
    console = Console(width=10_000, file=io.StringIO())
    figures = [column for column in table.columns if column.no_wrap]
    dropped = 0
    while len(figures) - dropped > 2 and console.measure(table).minimum > width:
        table.columns.pop()
        dropped += 1
    if dropped:
        table.caption, table.caption_justify = f"{dropped} more columns on a wider terminal, and in --json", "left"
    return table


def _optional(value: float | None, scale: float, form: str, prefix: str = "") -> str:
    return "" if value is None else prefix + form.format(scale * value)
