"""Who looks on while a run is under way: a progress bar, the worker of a batch, a viewer."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from warpslam.pipeline.methods import Method
    from warpslam.runs.record import Progress, RunResult
    from warpslam.runtime.compilation import ModuleProgress
    from warpslam.sequences.base import RgbdSequence


class Observer:
    """What a run tells of itself; each method does nothing unless it is overridden, so that this one hears nothing.

    An exception that one of them raises ends the run as an error of its own does: what there is by then is written.
    """

    def begin(self, name: str) -> None:
        """The sequence of that name was opened, and its run begins."""

    def module(self, progress: ModuleProgress) -> None:
        """A module of kernels is about to be loaded, or compiled if it never was; or has been."""

    def ready(self, method: Method, sequence: RgbdSequence) -> None:
        """All is loaded: ``method`` is about to be given the frames."""

    def frame(self, progress: Progress) -> None:
        """A frame was processed."""

    def stage(self, name: str) -> None:
        """After the last frame: something begins that takes a while, such as "extracting the mesh"."""

    def done(self, result: RunResult) -> None:
        """The run is over, by itself or by ctrl-C, and everything is written."""

    def close(self) -> None:
        """Nothing more will be told; called by whoever made it, also after an error."""


class Observers(Observer):
    """Several that look on, told one after the other."""

    def __init__(self, *observers: Observer) -> None:
        self.observers = observers

    def begin(self, name: str) -> None:
        """See `Observer`."""
        for observer in self.observers:
            observer.begin(name)

    def module(self, progress: ModuleProgress) -> None:
        """See `Observer`."""
        for observer in self.observers:
            observer.module(progress)

    def ready(self, method: Method, sequence: RgbdSequence) -> None:
        """See `Observer`."""
        for observer in self.observers:
            observer.ready(method, sequence)

    def frame(self, progress: Progress) -> None:
        """See `Observer`."""
        for observer in self.observers:
            observer.frame(progress)

    def stage(self, name: str) -> None:
        """See `Observer`."""
        for observer in self.observers:
            observer.stage(name)

    def done(self, result: RunResult) -> None:
        """See `Observer`."""
        for observer in self.observers:
            observer.done(result)

    def close(self) -> None:
        """See `Observer`."""
        for observer in self.observers:
            observer.close()
