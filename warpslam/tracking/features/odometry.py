"""Odometry by features alone: the witness with keyframes and poses of its own, as a yardstick for it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import warp as wp

from warpslam.camera import Intrinsics
from warpslam.poses import motion_between, orthonormalized
from warpslam.tracking.features.detection import FeatureFrame, SensorTiming, detect, retimed
from warpslam.tracking.features.settings import FeatureSettings
from warpslam.tracking.features.witness import FeatureWitness, Witness

SAMPLED_POINTS = 64
"""Points of a keyframe that tell how much of it is in view."""
LEAST_IN_VIEW = 0.2
MAX_GAP = 30
MAX_DISTANCE, MAX_TURN = 0.25, 12.0
"""[m], [degrees]."""
LEAST_KEPT = 0.75
"""Of the features that the last keyframe's first follower had in common with it."""
RECENT = 300


@dataclass(frozen=True, eq=False)
class OdometryFrame:
    """What became of a frame."""

    T_world_camera: np.ndarray
    """float64 (4, 4); the last known one where the frame is lost."""
    is_ok: bool
    witness: Witness | None = None
    keyframe: bool = False


class FeatureOdometry:
    """Keyframes by motion and by how many inliers are left, poses as they come; nothing is refined afterwards."""

    def __init__(
        self,
        camera: Intrinsics,
        device: wp.Device | str,
        settings: FeatureSettings | None = None,
        timing: SensorTiming | None = None,
    ) -> None:
        self.camera, self.timing = camera, timing
        self.settings = settings or FeatureSettings()
        self.witness = FeatureWitness(camera, wp.get_device(device), self.settings)
        self.keyframe_poses: dict[int, np.ndarray] = {}
        self._samples: list[np.ndarray] = []
        self._previous: tuple[FeatureFrame, np.ndarray, np.ndarray] | None = None
        self._velocity = np.eye(4)
        self._past: list[tuple[float, np.ndarray]] = []
        self._usual = 0
        self._gap = 0

    def step(self, grey: np.ndarray, depth: np.ndarray, time: float = 0.0) -> OdometryFrame:
        """One frame: uint8 (H, W), z-depth [m] float32 (H, W) with 0 = missing, time [s] where timing is corrected."""
        frame = detect(grey, depth, self.camera, self.settings)
        if self._previous is None:
            self._add_keyframe(frame, np.eye(4))
            return self._take(frame, grey, np.eye(4), time, None, True)
        last = self._previous[2]
        predicted = last @ self._velocity
        timed = self._timed(frame, depth)
        witness = self.witness.locate(
            timed, grey, self._previous, self.keyframe_poses, predicted, self._likely(predicted)
        )
        if witness is None:
            self._velocity = np.eye(4)
            self._past = []
            return OdometryFrame(last, False)
        pose = witness.T_world_camera
        self._velocity = orthonormalized(np.linalg.inv(last) @ pose)
        self._gap += 1
        wanted = self._wants_keyframe(pose, witness)
        result = self._take(timed, grey, pose, time, witness, wanted)
        if wanted:
            # With the motion that led here, which was not known before.
            self._add_keyframe(self._timed(frame, depth), pose)
        return result

    def _take(
        self,
        frame: FeatureFrame,
        grey: np.ndarray,
        pose: np.ndarray,
        time: float,
        witness: Witness | None,
        keyframe: bool,
    ) -> OdometryFrame:
        self._previous = frame, grey, pose
        self._past = [*self._past[-2:], (time, pose)]
        return OdometryFrame(pose, True, witness, keyframe)

    def _timed(self, frame: FeatureFrame, depth: np.ndarray) -> FeatureFrame:
        """The frame with its depth and rows at the time of its middle row; twist over the last two steps, since over
        one an error of a pose would move the next frame's depth as far.
        """
        if self.timing is None or len(self._past) < 2:
            return frame
        (start, first), (end, last) = self._past[0], self._past[-1]
        motion = np.linalg.inv(first) @ last
        turn = cv2.Rodrigues(motion[:3, :3])[0][:, 0]
        shift = motion[:3, 3] - 0.5 * np.cross(turn, motion[:3, 3])
        twist = np.concatenate([shift, turn]) / max(end - start, 1e-3)
        return retimed(frame, depth, self.camera, self.settings, self.timing, twist)

    def _wants_keyframe(self, pose: np.ndarray, witness: Witness) -> bool:
        if self._gap == 1:
            self._usual = max(witness.inliers, 60)
        distance, turn = motion_between(self.keyframe_poses[len(self.keyframe_poses) - 1], pose)
        few = not witness.by_keyframes or witness.inliers < LEAST_KEPT * self._usual
        return few or self._gap >= MAX_GAP or distance > MAX_DISTANCE or turn > MAX_TURN

    def _add_keyframe(self, frame: FeatureFrame, pose: np.ndarray) -> None:
        number = len(self.keyframe_poses)
        self.witness.add_keyframe(number, frame)
        self.keyframe_poses[number] = pose
        points = frame.points[frame.depth > 0] if (frame.depth > 0).any() else np.zeros((1, 3), np.float32)
        self._samples.append(points[np.linspace(0, len(points) - 1, SAMPLED_POINTS).astype(int)])
        self._gap = 0

    def _likely(self, pose: np.ndarray) -> list[int]:
        """Late keyframes by how much of them a pose has in view; the last one comes first."""
        first = max(0, len(self._samples) - RECENT)
        last = len(self._samples) - 1
        T = np.linalg.inv(pose) @ np.stack([self.keyframe_poses[number] for number in range(first, last + 1)])
        x = np.einsum("nij,nkj->nki", T[:, :3, :3], np.stack(self._samples[first:])) + T[:, None, :3, 3]
        u, v = self.camera.project(x[..., 0], x[..., 1], np.maximum(x[..., 2], 1e-3))
        seen = (x[..., 2] > 0.1) & (u >= 0) & (v >= 0) & (u < self.camera.width) & (v < self.camera.height)
        shares = seen.mean(axis=1)
        order = np.lexsort((-np.arange(len(shares)), -shares))
        near = [first + int(n) for n in order if shares[n] > LEAST_IN_VIEW and first + n != last]
        return [last, *near]
