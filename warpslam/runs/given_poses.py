"""Poses that a file gives to the frames of a run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from warpslam.errors import DatasetError
from warpslam.sequences.pose_files import as_pose, read_redwood_log
from warpslam.sequences.time_lists import SECONDS, unit_that_fits
from warpslam.storage.text_lines import parse_numbers, read_lines
from warpslam.storage.tum import associate, read_tum

if TYPE_CHECKING:
    from warpslam.sequences.base import Frame, RgbdSequence

_FORMATS = (
    "'t tx ty tz qx qy qz qw' (TUM, by time), or in the order of the frames 12 numbers (KITTI, rows of a 3x4 matrix) "
    "or 16 (rows of a 4x4 matrix)"
)


@dataclass(frozen=True)
class GivenPoses:
    """Poses that a file gives to frames, by time or by frame number."""

    path: Path
    """The file."""

    times: np.ndarray | None
    """[s], shape (N,); None where the n-th pose is that of frame n."""

    poses: np.ndarray
    """T_world_camera, shape (N, 4, 4)."""

    @classmethod
    def read(cls, path: str | Path) -> GivenPoses:
        """Read a trajectory: TUM's format, such as an earlier run's trajectory.tum, KITTI's, a 4x4 matrix a line, or
        Redwood's log.

        Raises:
            DatasetError: The file can't be read.
        """
        path = Path(path)
        lines = read_lines(path)
        width = len([word for word in lines[0][1] if not word.startswith("#")]) if lines else 8
        if width == 3:
            return cls(path, None, read_redwood_log(path, 1 + max(_first_numbers(lines[::5]), default=0)))
        if width in (12, 16):
            rows = [(n, parse_numbers(path, n, words, width, _FORMATS).reshape(-1, 4)) for n, words in lines]
            bottom = np.array([[0.0, 0.0, 0.0, 1.0]])
            return cls(path, None, np.array([as_pose(path, n, np.vstack([T[:3], bottom])) for n, T in rows]))
        if width != 8:
            raise DatasetError(f"{path}:{lines[0][0]}: {width} numbers; a line of poses is {_FORMATS}")
        return cls(path, *read_tum(path))

    def fitted_to(self, sequence: RgbdSequence, frames: Sequence[int]) -> GivenPoses:
        """These poses with their times in the unit of the sequence's.

        Raises:
            DatasetError: None of the frames has a pose.
        """
        fitted = self
        times = _times(sequence, frames)
        if self.times is not None and len(self.times):
            fitted = replace(self, times=self.times * unit_that_fits(self.times, times, SECONDS))
        if np.isfinite(fitted.of_frames(sequence, frames)).any():
            return fitted
        if self.times is None:
            raise DatasetError(f"{self.path}: has {len(self.poses)} poses, none for the frames from {frames[0]} on")
        span = f" ({self.times.min():.3f} to {self.times.max():.3f} s)" if len(self.times) else ""
        raise DatasetError(
            f"{self.path}: none of its {len(self.times)} times{span} is within 20 ms of those of {sequence.name} "
            f"({times[0]:.3f} to {times[-1]:.3f} s); where a folder has no times of its own, give a pose for each "
            "frame in their order, as 12 numbers a line (KITTI)"
        )

    def of_frames(self, sequence: RgbdSequence, frames: Sequence[int]) -> np.ndarray:
        """Poses of frames, float64 (N, 4, 4), NaN where there is none."""
        found = (self.at(index, time) for index, time in zip(frames, _times(sequence, frames), strict=True))
        unknown = np.full((4, 4), np.nan)
        return np.array([unknown if pose is None else pose for pose in found])

    def of(self, frame: Frame) -> np.ndarray | None:
        """The pose of a frame (4, 4); None if there is none."""
        return self.at(frame.index, frame.timestamp)

    def at(self, index: int, timestamp: float) -> np.ndarray | None:
        """The pose of a frame by its number, or the one nearest to its time within 20 ms; None if there is none."""
        if self.times is None:
            known = index < len(self.poses) and np.isfinite(self.poses[index]).all()
            return self.poses[index] if known else None
        position = int(associate(np.array([timestamp]), self.times)[0])
        return None if position < 0 else self.poses[position]


def _times(sequence: RgbdSequence, frames: Sequence[int]) -> np.ndarray:
    """Times [s] of frames, without reading them where the sequence knows."""
    times = getattr(sequence, "timestamps", None)
    if times is not None:
        return np.asarray(times, dtype=np.float64)[np.asarray(frames)]
    return np.array([sequence[index].timestamp for index in frames])


def _first_numbers(lines: list[tuple[int, list[str]]]) -> list[int]:
    return [int(words[0]) for _, words in lines if words[0].isdigit()]
