"""`Profile`, which records what runs inside a ``with`` block and reports it."""

from __future__ import annotations

from pathlib import Path

from warpslam.errors import WarpSlamError
from warpslam.profiling.recorder import Recorder
from warpslam.profiling.records import Recording
from warpslam.profiling.report import Report
from warpslam.profiling.trace import write_trace


class Profile(Recording):
    """What ran inside its ``with`` block; once the block is left, `table`, `to_json` and `write_trace` report it.

    Only one profile can be active at a time, and it sees all threads. Phases that other threads enter run beside those
    of the one that profiles, so that walls may then add up to more than ``wall_seconds``.
    """

    def __init__(self) -> None:
        super().__init__()
        self._recorder = Recorder(self)
        self._report: Report | None = None

    def __enter__(self) -> Profile:
        self._recorder.begin()
        return self

    def __exit__(self, *_: object) -> None:
        self._recorder.end()

    @property
    def report(self) -> Report:
        """The figures.

        Raises:
            WarpSlamError: The ``with`` block has not been left.
        """
        if self._recorder.is_active:
            raise WarpSlamError("the profile is still active: leave its with block first")
        if self._report is None:
            self._report = Report(self)
        return self._report

    def table(self, width: int = 160) -> str:
        """Tables of phases, kernels and compiled modules, as text."""
        return self.report.table(width)

    def to_json(self) -> str:
        """The same figures, unrounded, as JSON."""
        return self.report.to_json()

    def write_trace(self, path: str | Path) -> None:
        """Write every launch with its time and thread in the trace event format, for Perfetto or chrome://tracing."""
        write_trace(self, Path(path))
