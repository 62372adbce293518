"""The estimated camera trajectory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np

from warpslam.poses import motion_between, pose_from_vector


@dataclass(frozen=True)
class Trajectory:
    """Poses of all frames so far.

    timestamps: [s], float64 (N,). poses: T_world_camera, float64 (N, 4, 4). status: "OK", "LOST" or "SKIPPED" of each
    frame.
    """

    timestamps: np.ndarray
    poses: np.ndarray
    status: list[str]


RECENT_FRAMES = 20
STEP_FACTOR = 5.0  # a step beyond this multiple of the recent ones is a jump


@dataclass(frozen=True)
class Track:
    """What is known of the camera's motion so far.

    vectors: Pose vectors of all frames. status: Their status. depth_errors: Their mean depth errors [m].
    motion: Of the last frame against the one before (4, 4), as it was tracked. The poses may say something else since:
        bundle adjustment has moved one of them, and that is no motion of the camera.
    first: Frame from which the camera has moved without a break; poses before it say nothing of where it is.
    """

    vectors: Sequence[np.ndarray]
    status: Sequence[str]
    depth_errors: Sequence[float]
    motion: np.ndarray
    first: int = 0

    @property
    def last(self) -> int | None:
        """The last frame whose pose is known, if there is one."""
        return next((n for n in range(len(self.status) - 1, self.first - 1, -1) if self.status[n] == "OK"), None)

    def starts(self, constant_speed: bool) -> list[np.ndarray]:
        """Where the camera may be now, most likely first: constant speed (if on and known), and the last known pose."""
        last = self.last
        if last is None:
            return []
        T = pose_from_vector(self.vectors[last])
        if constant_speed and last > self.first and last == len(self.status) - 1 and self.status[last - 1] == "OK":
            return [T @ self.motion, T]
        return [T]

    def is_jump(self, T_world_camera: np.ndarray, max_step: float, max_turn: float) -> bool:
        """Whether the camera can't well have come to a pose: a step beyond ``max_step`` [m] or ``max_turn`` [degrees] a
        frame, and far beyond the recent ones.
        """
        last = self.last
        if last is None:
            return False
        recent = [self._step(n - 1, n) for n in self._recent() if n > self.first and self.status[n - 1] == "OK"]
        # Before any step is known the camera may be a fast one.
        usual = np.median(recent, axis=0) if recent else np.array([max_step, max_turn])
        elapsed = len(self.status) - last
        step = motion_between(pose_from_vector(self.vectors[last]), T_world_camera)
        return bool((np.array(step) > elapsed * np.maximum(STEP_FACTOR * usual, [max_step, max_turn])).any())

    def depth_error(self) -> float:
        """Median depth error of the recent frames [m], 0 if there are none."""
        errors = [self.depth_errors[n] for n in self._recent() if self.depth_errors[n] > 0]
        return float(np.median(errors)) if errors else 0.0

    def _recent(self) -> list[int]:
        known = (n for n in range(len(self.status) - 1, self.first - 1, -1) if self.status[n] == "OK")
        return list(islice(known, RECENT_FRAMES))

    def _step(self, a: int, b: int) -> tuple[float, float]:
        return motion_between(pose_from_vector(self.vectors[a]), pose_from_vector(self.vectors[b]))
