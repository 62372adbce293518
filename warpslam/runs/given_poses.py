"""Poses that a file gives to the frames of a run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from warpslam.storage.tum import associate, read_tum


@dataclass(frozen=True)
class GivenPoses:
    """Poses that a file gives to frames, by time."""

    path: Path
    """The file."""

    times: np.ndarray
    """[s], shape (N,)."""

    poses: np.ndarray
    """T_world_camera, shape (N, 4, 4)."""

    @classmethod
    def read(cls, path: str | Path) -> GivenPoses:
        """Read a trajectory in the TUM format, such as an earlier run's trajectory.tum.

        Raises:
            DatasetError: The file can't be read.
        """
        return cls(Path(path), *read_tum(path))

    def at(self, timestamp: float) -> np.ndarray | None:
        """The pose nearest in time, within 20 ms; None if there is none."""
        position = int(associate(np.array([timestamp]), self.times)[0])
        return None if position < 0 else self.poses[position]
