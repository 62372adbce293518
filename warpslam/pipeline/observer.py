"""Who looks on while a run is under way: a progress bar, the worker of a batch, a viewer."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from warpslam.runs.record import Progress, RunResult
    from warpslam.runtime.compilation import ModuleProgress


class Observer:
    """What a run tells of itself; each method does nothing unless it is overridden, so that this one hears nothing.

    An exception that one of them raises ends the run as an error of its own does: what there is by then is written.
    """

    def begin(self, name: str) -> None:
        """The sequence of that name was opened, and its run begins."""

    def module(self, progress: ModuleProgress) -> None:
        """A module of kernels is about to be loaded, or compiled if it never was; or has been."""

    def frame(self, progress: Progress) -> None:
        """A frame was processed."""

    def done(self, result: RunResult) -> None:
        """The run is over, by itself or by ctrl-C, and everything is written."""
