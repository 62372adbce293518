"""What every reader returns: frames with depth in metres and poses in OpenCV axes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from warpslam.camera import ONE_MOMENT, Intrinsics, SensorTiming


@dataclass(frozen=True)
class Frame:
    """One RGB-D frame."""

    index: int
    """Position in the sequence."""
    timestamp: float
    """Time [s]; readers of formats without times use index / 30."""
    rgb: np.ndarray
    """Colour image, uint8, shape (H, W, 3), RGB order."""
    depth: np.ndarray
    """z-depth [m], float32, shape (H, W), 0 = missing."""
    T_world_camera: np.ndarray | None = None
    """Ground-truth camera-to-world transform, float64, shape (4, 4), OpenCV axes; None where unknown."""
    depth_timestamp: float | None = None
    """Time of the depth image [s], where it has one of its own."""


@dataclass(frozen=True)
class Remark:
    """What a reader noticed in opening a sequence, for `warpslam check` and for the log of a run."""

    check: str
    """What it is about."""
    message: str
    """What is so, and where."""
    remedy: str = ""
    """What to do or type."""
    is_fine: bool = False
    """Nothing is lost by it; it is only said."""


class EndOfFrames(Exception):
    """A camera that is running has ended; a run that reads it is over, and writes its results."""


class RgbdSequence(ABC):
    """A random-access RGB-D sequence.

    name: Short name, used for the run folder.
    intrinsics: Camera of the frames as returned, that is after undistortion, resizing and cropping.
    preset: Name of the settings that suit the sequence (see `warpslam.config.PRESETS`).
    timing: When the pixels of the frames, as returned, are taken.
    can_read_ahead: Whether a thread may read a frame while the one before is worked on.
    remarks: What was noticed in opening it.
    is_live: Frames come one after another from a camera that is running, and end some time; not read ahead.
    """

    name: str
    intrinsics: Intrinsics
    preset: str = "default"
    timing: SensorTiming = ONE_MOMENT
    can_read_ahead: bool = True
    remarks: tuple[Remark, ...] = ()
    is_live: bool = False

    @abstractmethod
    def __len__(self) -> int: ...

    @abstractmethod
    def __getitem__(self, index: int) -> Frame: ...

    def __iter__(self) -> Iterator[Frame]:
        for index in range(len(self)):
            yield self[index]

    def as_published(self) -> RgbdSequence:
        """The sequence with frames as the paper's code takes them; itself where that makes no difference."""
        return self

    def stored_timing(self, timing: SensorTiming) -> SensorTiming:
        """What ``camera.yaml`` should say of a camera whose frames, as returned, have a timing."""
        return timing

    def ground_truth(self) -> np.ndarray | None:
        """All ground-truth poses, float64, shape (N, 4, 4), NaN-filled where one is unknown; None if there are none."""
        return None
