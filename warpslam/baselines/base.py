"""What the baselines share: frames in, trajectory out, under the interface of `warpslam.slam.Slam`."""

from __future__ import annotations

from typing import Any

import numpy as np

from warpslam.camera import Intrinsics
from warpslam.config import Config
from warpslam.errors import FrameError
from warpslam.frames import FrameResult, read_images
from warpslam.poses import check_transform, pose_from_vector, vector_from_pose
from warpslam.trajectory import Trajectory


class Baseline:
    """Keeps the record of all frames.

    name: What ``--method`` calls it.
    device: Device that it computes on, as text or Warp device.
    compile_seconds: Seconds spent on compiling kernels.
    """

    name: str
    device: Any
    compile_seconds = 0.0

    def __init__(self, intrinsics: Intrinsics, config: Config, seed: int) -> None:
        self.intrinsics, self.config, self.seed = intrinsics, config, seed
        self._vectors: list[np.ndarray] = []
        self._timestamps: list[float] = []
        self._status: list[str] = []

    @property
    def trajectory(self) -> Trajectory:
        """All poses so far."""
        poses = np.array([pose_from_vector(vector) for vector in self._vectors]).reshape(-1, 4, 4)
        return Trajectory(np.array(self._timestamps), poses, list(self._status))

    def step(
        self,
        rgb: Any,
        depth: Any,
        timestamp: float | None = None,
        T_world_camera: np.ndarray | None = None,
        *,
        depth_scale: float | None = None,
    ) -> FrameResult:
        """Take in one frame; arguments and errors are those of `Slam.step`."""
        index = len(self._vectors)
        timestamp = index / 30.0 if timestamp is None else float(timestamp)
        given = None if T_world_camera is None else check_transform(T_world_camera, unknown_is_nan=True)
        try:
            rgb, depth = read_images(rgb, depth, self.intrinsics, self.config.grid.max_depth, depth_scale)
            if given is not None and not np.isfinite(given).all():
                raise FrameError("its T_world_camera holds NaN or infinity")
        except FrameError as error:
            return self._skip(index, timestamp, str(error))
        return self._step(index, timestamp, rgb, depth, given)

    def _step(
        self, index: int, timestamp: float, rgb: np.ndarray, depth: np.ndarray, given: np.ndarray | None
    ) -> FrameResult:
        raise NotImplementedError

    def _append(self, vector: np.ndarray, timestamp: float, status: str) -> None:
        self._vectors.append(vector)
        self._timestamps.append(timestamp)
        self._status.append(status)

    def _skip(self, index: int, timestamp: float, message: str) -> FrameResult:
        vector = self._vectors[-1].copy() if self._vectors else vector_from_pose(np.eye(4))
        self._append(vector, timestamp, "SKIPPED")
        return FrameResult(index, timestamp, pose_from_vector(vector), "SKIPPED", inliers=0.0, message=message)
