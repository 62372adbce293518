"""Where the camera is when tracking alone does not tell: failure is noticed, and the pose found again.

A tracked pose is trusted if the map explains the depth (residual, inliers) and the step to it is one the camera may
have made. Otherwise the frame is tracked with more iterations from where the camera was last, then from the keyframes
that look most like it, and with more rays, too, from the best of these. A pose found that way may be anywhere, so it
has to explain the frame as well as tracked frames are explained; if none does, the frame is lost.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from warpslam.camera import Intrinsics
from warpslam.config import TrackingConfig
from warpslam.field.arrays import FieldArrays
from warpslam.scene.image_pool import ImagePool
from warpslam.scene.keyframes import Keyframe
from warpslam.tracking.thumbnail import Thumbnail
from warpslam.tracking.tracker import Tracker, TrackingResult
from warpslam.trajectory import FrameHistory, Located

ERROR_FACTOR = 1.5  # a pose found again errs no more than this multiple of the recent depth errors
PROMISING_FACTOR = 4.0  # a pose whose depth error is this far above the limit is worth a long optimisation
SHORT_FACTOR = 3  # iterations from each start and keyframe, as a multiple of those of tracking
MIN_AGREEING = 0.6  # of all depth rays, at a pose found again: what looks past the map does not speak for it


class Localizer:
    """Finds the pose of the frame in slot 0 of the image pool, by tracking or, failing that, against the keyframes."""

    def __init__(self, tracker: Tracker, config: TrackingConfig, camera: Intrinsics) -> None:
        self.tracker, self.config, self.camera = tracker, config, camera
        self._thumbnails: dict[int, Thumbnail] = {}

    def locate(
        self, arrays: FieldArrays, images: ImagePool, index: int, history: FrameHistory, keyframes: Sequence[Keyframe]
    ) -> Located:
        """Pose of frame ``index``, which comes after the frames of ``history``."""
        starts = history.starts(self.config.constant_speed)
        was_known = history.was_known
        tried = [self.tracker.track(arrays, images, index, start) for start in starts[:1]]
        if tried and (not self._why_lost(tried[0], history) if was_known else self._is_found(tried[0], history)):
            return _located(tried[0], after_loss=not was_known)

        # Longer, and from the last pose as well: the constant-speed guess may be what failed. Once the camera is lost
        # it has moved on, and this does not pay any more.
        if was_known:
            tried += [self._track_longer(arrays, images, index, start) for start in starts]
        best = min(tried, key=_badness, default=None)
        if not (was_known and best is not None and not self._why_lost(best, history)) and self.config.relocalization:
            likely = self._likely(images, keyframes)[: self.config.relocalization_keyframes]
            tried += [self._track_longer(arrays, images, index, keyframe.pose) for keyframe in likely]
            best = min(tried, key=_badness, default=None)
        if best is None:
            nowhere = TrackingResult(np.eye(4), np.inf, np.inf, 0.0, 0.0)
            return _located(nowhere, "it is not known where the camera starts: there is no keyframe to compare with")

        # The long optimisation is dear: once, and from a pose that it can be expected to mend.
        if best.depth_error < PROMISING_FACTOR * self._limit(history):
            effort = self.config.recovery_factor
            longest = self.tracker.track(arrays, images, index, best.T_world_camera, effort=effort)
            best = min(best, longest, key=_badness)
        why = self._why_lost(best, history)
        if was_known and not why:
            return _located(best)
        if self._is_found(best, history):
            return _located(best, after_loss=True)
        after = f"mean depth error {best.depth_error:.2f} m, {self._limit(history):.2f} m is the limit after a loss"
        return _located(best, why or after)

    def _track_longer(self, arrays: FieldArrays, images: ImagePool, index: int, start: np.ndarray) -> TrackingResult:
        return self.tracker.track(arrays, images, index, start, iteration_factor=SHORT_FACTOR)

    def _likely(self, images: ImagePool, keyframes: Sequence[Keyframe]) -> list[Keyframe]:
        """Keyframes by the likeness of their images to the current one."""
        rgb, depth, scale = images.current()
        current = Thumbnail.of(rgb, depth * np.float32(scale))
        for keyframe in keyframes:
            if keyframe.image not in self._thumbnails:
                rgb, depth, scale = images.kept(keyframe.image).unpack(self.camera)
                self._thumbnails[keyframe.image] = Thumbnail.of(rgb, depth * np.float32(scale))
        return sorted(keyframes, key=lambda keyframe: current.difference(self._thumbnails[keyframe.image]))

    def _why_lost(self, result: TrackingResult, history: FrameHistory) -> str:
        """What speaks against a pose that was tracked; "" if nothing does."""
        config = self.config
        if result.inliers < config.lost_inliers:
            return f"only {result.inliers:.0%} of the depth rays agree with the map"
        if not result.depth_error <= config.lost_depth_error:
            return f"mean depth error {result.depth_error:.2f} m"
        if history.is_jump(result.T_world_camera, config.max_step, config.max_turn):
            return "the camera would have jumped"
        return ""

    def _is_found(self, result: TrackingResult, history: FrameHistory) -> bool:
        needed = max(MIN_AGREEING, self.config.lost_inliers)
        return result.depth_error <= self._limit(history) and result.agreeing >= needed

    def _limit(self, history: FrameHistory) -> float:
        """Largest mean depth error [m] of a pose that was found again."""
        return max(self.config.relocalized_depth_error, ERROR_FACTOR * history.depth_error())


def _located(tracked: TrackingResult, why_lost: str = "", *, after_loss: bool = False) -> Located:
    return Located(tracked.T_world_camera, why_lost, after_loss, tracked.inliers, tracked.depth_error, tracked.loss)


def _badness(result: TrackingResult) -> float:
    return result.depth_error / max(result.agreeing, 1e-3)
