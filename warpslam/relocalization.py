"""Where the camera is when tracking alone does not tell: failure is noticed, and the pose found again.

A tracked pose is trusted if the map explains the depth (residual, inliers) and the step to it is one the camera may
have made. Otherwise the frame is tracked with more iterations from where the camera was last, then from the keyframes
that look most like it, and with more rays, too, from the best of these. A pose found that way may be anywhere, so it
has to explain the frame as well as tracked frames are explained; if none does, the frame is lost.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np

from warpslam.camera import Intrinsics, pose_from_vector
from warpslam.config import TrackingConfig
from warpslam.field import FieldArrays
from warpslam.keyframes import ImagePool, Keyframe
from warpslam.tracker import Tracker, TrackingResult

RECENT_FRAMES = 20
STEP_FACTOR = 5.0  # a step beyond this multiple of the recent ones is a jump
ERROR_FACTOR = 1.5  # a pose found again errs no more than this multiple of the recent depth errors
PROMISING_FACTOR = 4.0  # a pose whose depth error is this far above the limit is worth a long optimisation
SHORT_FACTOR = 3  # iterations from each start and keyframe, as a multiple of those of tracking
MIN_AGREEING = 0.6  # of all depth rays, at a pose found again: what looks past the map does not speak for it
THUMBNAIL = (12, 16)  # rows, columns
GREY_WEIGHT = 2.0  # how much a difference in grey, 0..1, counts beside a relative difference in depth
MIN_SHARED = 0.3  # share of cells that two thumbnails must both have depth in


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


def motion_between(a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    """Distance [m] and angle [degrees] between two poses (4, 4)."""
    cosine = (np.trace(a[:3, :3].T @ b[:3, :3]) - 1.0) / 2.0
    return float(np.linalg.norm(a[:3, 3] - b[:3, 3])), float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


@dataclass(frozen=True)
class Located:
    """A frame's pose, why it can't be trusted ("" if it can), and whether the camera was lost in between."""

    tracked: TrackingResult
    why_lost: str = ""
    after_loss: bool = False


class Localizer:
    """Finds the pose of the frame in slot 0 of the image pool, by tracking or, failing that, against the keyframes."""

    def __init__(self, tracker: Tracker, config: TrackingConfig, camera: Intrinsics) -> None:
        self.tracker, self.config, self.camera = tracker, config, camera
        self._thumbnails: dict[int, Thumbnail] = {}

    def locate(
        self, arrays: FieldArrays, images: ImagePool, index: int, track: Track, keyframes: Sequence[Keyframe]
    ) -> Located:
        """Pose of frame ``index``, which comes after the frames of ``track``."""
        starts = track.starts(self.config.constant_speed)
        was_known = track.last is not None and track.last == len(track.status) - 1
        tried = [self.tracker.track(arrays, images, index, start) for start in starts[:1]]
        if tried and (not self._why_lost(tried[0], track) if was_known else self._is_found(tried[0], track)):
            return Located(tried[0], after_loss=not was_known)

        # Longer, and from the last pose as well: the constant-speed guess may be what failed. Once the camera is lost
        # it has moved on, and this does not pay any more.
        if was_known:
            tried += [self._track_longer(arrays, images, index, start) for start in starts]
        best = min(tried, key=_badness, default=None)
        if not (was_known and best is not None and not self._why_lost(best, track)) and self.config.relocalization:
            likely = self._likely(images, keyframes)[: self.config.relocalization_keyframes]
            poses = [pose_from_vector(keyframe.pose) for keyframe in likely]
            tried += [self._track_longer(arrays, images, index, pose) for pose in poses]
            best = min(tried, key=_badness, default=None)
        if best is None:
            nowhere = TrackingResult(np.eye(4), np.inf, np.inf, 0.0, 0.0)
            return Located(nowhere, "it is not known where the camera starts: there is no keyframe to compare with")

        # The long optimisation is dear: once, and from a pose that it can be expected to mend.
        if best.depth_error < PROMISING_FACTOR * self._limit(track):
            effort = self.config.recovery_factor
            longest = self.tracker.track(arrays, images, index, best.T_world_camera, effort=effort)
            best = min(best, longest, key=_badness)
        why = self._why_lost(best, track)
        if was_known and not why:
            return Located(best)
        if self._is_found(best, track):
            return Located(best, after_loss=True)
        after = f"mean depth error {best.depth_error:.2f} m, {self._limit(track):.2f} m is the limit after a loss"
        return Located(best, why or after)

    def _track_longer(self, arrays: FieldArrays, images: ImagePool, index: int, start: np.ndarray) -> TrackingResult:
        return self.tracker.track(arrays, images, index, start, iteration_factor=SHORT_FACTOR)

    def _likely(self, images: ImagePool, keyframes: Sequence[Keyframe]) -> list[Keyframe]:
        """Keyframes by the likeness of their images to the current one."""
        rgb, depth, scale = images.current()
        current = Thumbnail.of(rgb, depth * np.float32(scale))
        for keyframe in keyframes:
            if keyframe.image not in self._thumbnails:
                rgb, depth, scale = images.images[keyframe.image].unpack(self.camera)
                self._thumbnails[keyframe.image] = Thumbnail.of(rgb, depth * np.float32(scale))
        return sorted(keyframes, key=lambda keyframe: current.difference(self._thumbnails[keyframe.image]))

    def _why_lost(self, result: TrackingResult, track: Track) -> str:
        """What speaks against a pose that was tracked; "" if nothing does."""
        config = self.config
        if result.inliers < config.lost_inliers:
            return f"only {result.inliers:.0%} of the depth rays agree with the map"
        if not result.depth_error <= config.lost_depth_error:
            return f"mean depth error {result.depth_error:.2f} m"
        if track.is_jump(result.T_world_camera, config.max_step, config.max_turn):
            return "the camera would have jumped"
        return ""

    def _is_found(self, result: TrackingResult, track: Track) -> bool:
        needed = max(MIN_AGREEING, self.config.lost_inliers)
        return result.depth_error <= self._limit(track) and result.agreeing >= needed

    def _limit(self, track: Track) -> float:
        """Largest mean depth error [m] of a pose that was found again."""
        return max(self.config.relocalized_depth_error, ERROR_FACTOR * track.depth_error())


def _badness(result: TrackingResult) -> float:
    return result.depth_error / max(result.agreeing, 1e-3)


@dataclass(frozen=True)
class Thumbnail:
    """A frame at 12 x 16 cells: mean depth [m], NaN where less than half a cell has depth, and mean grey, 0..1."""

    depth: np.ndarray
    grey: np.ndarray

    @classmethod
    def of(cls, rgb: np.ndarray, depth: np.ndarray) -> Thumbnail:
        """From uint8 (H, W, 3) and float32 (H, W) [m], 0 = missing."""
        known = _cell_means((depth > 0).astype(np.float64))
        with np.errstate(divide="ignore", invalid="ignore"):
            mean = np.where(known >= 0.5, _cell_means(depth.astype(np.float64)) / known, np.nan)
        return cls(mean, _cell_means(rgb.mean(axis=2) / 255.0))

    def difference(self, other: Thumbnail) -> float:
        """Mean relative difference in depth and, apart from the exposure, in grey; infinite if little is shared."""
        both = np.isfinite(self.depth) & np.isfinite(other.depth)
        if both.mean() < MIN_SHARED:
            return np.inf
        a, b = self.depth[both], other.depth[both]
        # Cells that straddle an edge differ by much and tell little.
        depth = np.minimum(np.abs(a - b) / np.minimum(a, b), 0.5).mean()
        grey = np.abs((self.grey - self.grey.mean()) - (other.grey - other.grey.mean())).mean()
        return float(depth + GREY_WEIGHT * grey)


def _cell_means(image: np.ndarray) -> np.ndarray:
    rows, columns = (np.linspace(0, image.shape[axis], THUMBNAIL[axis] + 1).astype(int) for axis in (0, 1))
    sums = np.pad(image.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    corners = sums[np.ix_(rows, columns)]
    areas = np.outer(np.diff(rows), np.diff(columns))
    return (corners[1:, 1:] - corners[:-1, 1:] - corners[1:, :-1] + corners[:-1, :-1]) / np.maximum(areas, 1)
