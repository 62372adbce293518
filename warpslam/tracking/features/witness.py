"""A second, independent answer to where the camera is: from sparse features, against keyframes that somebody else owns.

A frame is matched with the one before it by a predicted motion, or else by optical flow, by a wider search, or by
descriptors alone; then, from the pose that this gives, with the points of the keyframes, whose pose it is. Points are
those that depth gives at a keyframe's own features, in its axes: a keyframe that is moved takes them along.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
import warp as wp

from warpslam.camera import Intrinsics
from warpslam.poses import orthonormalized
from warpslam.tracking.features.detection import DEPTH_STRIDE, FeatureFrame, depth_at
from warpslam.tracking.features.device import FEATURE, DeviceFrame, FoundPose, PoseFinder
from warpslam.tracking.features.pairs import descriptor_pairs, flow_pairs, ransac_pose
from warpslam.tracking.features.settings import FeatureSettings

LEAST_BY_KEYFRAMES = 20
LEAST_BY_PREVIOUS = 25
LEAST_SHARE = 0.4
"""Of the matches with the previous frame, to be believed; of pairs by optical flow `LEAST_FLOW_SHARE`."""
LEAST_FLOW_SHARE = 0.3
MANY = 60
"""Inliers from which a place is taken without looking further."""
LEAST_COMPARED = 100
"""Pixels from which agreement of depth says something."""
FLOW_COUNT = 400
DEPTH_SIGMA_RANGE = (0.002, 0.04)
DEPTH_SIGMA_RATE = 0.05
DEPTH_SIGMA_FACTOR = 2.5 * 1.4826


@dataclass(frozen=True, eq=False)
class Witness:
    """Where features say that a camera is."""

    T_world_camera: np.ndarray
    """float64 (4, 4)."""
    inliers: int
    """Features that agree with the pose."""
    matches: int
    """Features that were matched."""
    agreement: float
    """Share of the depth that agrees with that of the frame compared with, both ways, in [0, 1]."""
    compared: int
    """Pixels that this rests on, every eighth of a row and column."""
    H: np.ndarray
    """Normal matrix of the inliers for T_camera_world <- exp(xi) T_camera_world, xi = (v, w); float64 (6, 6)."""
    by: str
    """How the motion was found: "motion", "flow", "wide", "descriptors", "keyframe"."""
    by_keyframes: bool = True
    """Whether keyframes hold the pose, or the previous frame alone."""

    @property
    def share(self) -> float:
        """Inliers among the matches, in [0, 1]."""
        return self.inliers / max(self.matches, 1)

    @property
    def is_strong(self) -> bool:
        """Whether the answer may be preferred to another."""
        return self.inliers >= MANY and self.share >= 0.5 and self.agreement >= 0.8

    @property
    def is_held(self) -> bool:
        """Whether it is an answer at all."""
        if not self.by_keyframes and self.agreement < 0.8:
            return False
        return self.compared <= LEAST_COMPARED or self.agreement >= (0.4 if self.inliers >= MANY else 0.6)


Previous = tuple[FeatureFrame, np.ndarray, np.ndarray]
"""Features, grey image uint8 (H, W) and T_world_camera (4, 4) of the frame before."""


class FeatureWitness:
    """Keeps the features of keyframes and finds frames among them. What it learns is `depth_sigma`, nothing else."""

    def __init__(self, camera: Intrinsics, device: wp.Device, settings: FeatureSettings | None = None) -> None:
        self.camera, self.device = camera, device
        self.settings = settings or FeatureSettings()
        self.depth_sigma = self.settings.depth_sigma
        """Standard deviation of inverse depth between frames [1/m], a running value: all that a checkpoint needs beside
        the images of the keyframes.
        """
        self._keyframes: dict[int, FeatureFrame] = {}
        self._finder = PoseFinder(camera, device, self.settings)
        self._uploaded: WeakKeyDictionary[FeatureFrame, DeviceFrame] = WeakKeyDictionary()

    def add_keyframe(self, number: int, frame: FeatureFrame) -> None:
        """Take in a keyframe by its owner's number, or other features of it (`retimed`)."""
        self._keyframes[number] = frame

    def drop_keyframe(self, number: int) -> None:
        """Forget a keyframe."""
        del self._keyframes[number]

    def locate(
        self,
        frame: FeatureFrame,
        grey: np.ndarray,
        previous: Previous,
        keyframe_poses: Mapping[int, np.ndarray],
        predicted: np.ndarray | None,
        candidates: Sequence[int],
    ) -> Witness | None:
        """Where a frame is that follows another.

        Args:
            frame: Its features.
            grey: uint8 (H, W).
            previous: The frame before.
            keyframe_poses: T_world_camera (4, 4) of keyframes.
            predicted: T_world_camera expected, (4, 4); None = that of the previous frame.
            candidates: Keyframes to match with, the likeliest first; the first `FeatureSettings.local_keyframes` count.

        Returns:
            None if features do not tell.
        """
        reference = orthonormalized(previous[2] if predicted is None else predicted)
        by, found = self._follow(frame, grey, previous, reference)
        local = [number for number in candidates if number in self._keyframes][: self.settings.local_keyframes]
        if found is None:
            return self.relocalize(frame, keyframe_poses, candidates)
        by_keyframes = self._by_keyframes(frame, keyframe_poses, local, reference, found)
        held = by_keyframes or found
        T_previous_world = np.linalg.inv(previous[2])
        witness = self._witness(frame, held, reference, previous[0], T_previous_world, by, by_keyframes is not None)
        if not witness.is_held:
            return None
        if by_keyframes is not None:
            self._learn(self._device_frame(frame), by_keyframes)
        return witness

    def relocalize(
        self, frame: FeatureFrame, keyframe_poses: Mapping[int, np.ndarray], candidates: Sequence[int]
    ) -> Witness | None:
        """Where a frame is of which nothing is known, by its descriptors: at the candidate with the most inliers.

        Args:
            frame: Its features.
            keyframe_poses: T_world_camera (4, 4) of keyframes.
            candidates: Keyframes to compare with, the likeliest first.

        Returns:
            None if it is at none of them.
        """
        best: tuple[int, FoundPose] | None = None
        for number in (number for number in candidates if number in self._keyframes):
            found = self._by_descriptors(frame, self._keyframes[number], np.eye(4), LEAST_BY_KEYFRAMES)
            if found is not None and (best is None or found.inliers > best[1].inliers):
                best = number, found
            if best is not None and best[1].inliers > MANY:
                break
        if best is None:
            return None
        number, found = best
        reference = np.asarray(keyframe_poses[number], dtype=np.float64)
        others = [n for n in candidates if n != number and n in self._keyframes]
        local = [number, *others[: self.settings.local_keyframes - 1]]
        held = self._by_keyframes(frame, keyframe_poses, local, reference, found)
        if held is None:
            return None
        T_keyframe_world = np.linalg.inv(reference)
        witness = self._witness(frame, held, reference, self._keyframes[number], T_keyframe_world, "keyframe", True)
        return witness if witness.is_held else None

    def rows(
        self,
        frame: FeatureFrame,
        keyframe_poses: Mapping[int, np.ndarray],
        candidates: Sequence[int],
        T_world_camera: np.ndarray,
    ) -> FeatureRows | None:
        """Matches with keyframes at a pose that is nearly right, as rows of normal equations.

        Args:
            frame: Features; if `retimed`, their rows are those of a rolling shutter and of delayed depth.
            keyframe_poses: T_world_camera (4, 4) of keyframes.
            candidates: Keyframes to match with, the likeliest first.
            T_world_camera: Pose of the frame, (4, 4).

        Returns:
            None without keyframes. Valid until the witness is used again.
        """
        local = [number for number in candidates if number in self._keyframes][: self.settings.local_keyframes]
        if not local or len(frame) == 0:
            return None
        reference = np.asarray(T_world_camera, dtype=np.float64)
        self._match_keyframes(frame, keyframe_poses, local, reference, np.eye(4), 6.0)
        return FeatureRows(self._finder, self._device_frame(frame), reference, self.depth_sigma)

    def between(self, earlier: int, later: int, T_later_earlier: np.ndarray) -> FoundPose | None:
        """Pose of a keyframe by the points of an earlier one alone.

        Args:
            earlier, later: Their numbers.
            T_later_earlier: Where it is looked for, (4, 4).

        Returns:
            In axes of the later one as it was believed; None if too few features agree.
        """
        frame, before = self._keyframes[later], self._keyframes[earlier]
        if len(before) == 0 or len(frame) == 0:
            return None
        found = self._by_projection(frame, before, T_later_earlier, 15.0, 80)
        return found or self._by_projection(frame, before, T_later_earlier, 40.0, 60)

    def _follow(
        self, frame: FeatureFrame, grey: np.ndarray, previous: Previous, reference: np.ndarray
    ) -> tuple[str, FoundPose | None]:
        """Pose against the previous frame, in axes of ``reference``, and how it was found."""
        before, grey_before, pose_before = previous
        T_reference_before = np.linalg.inv(reference) @ pose_before
        if len(before) == 0 or len(frame) == 0:
            return "", None
        found = self._by_projection(frame, before, T_reference_before, 15.0, 80)
        if found is not None:
            return "motion", found
        found = self._by_flow(frame, grey, before, grey_before, T_reference_before)
        if found is not None:
            return "flow", found
        found = self._by_projection(frame, before, T_reference_before, 40.0, 60)
        if found is not None:
            return "wide", found
        return "descriptors", self._by_descriptors(frame, before, T_reference_before, LEAST_BY_PREVIOUS)

    def _by_projection(
        self, frame: FeatureFrame, before: FeatureFrame, T_reference_before: np.ndarray, radius: float, limit: int
    ) -> FoundPose | None:
        target, start = self._device_frame(frame), np.eye(4)
        sources = [(self._device_frame(before), T_reference_before)]
        self._finder.match(sources, target, start, radius=radius, limit=limit, ratio=0.85)
        found = self._finder.solve(target.features, target.motion, start, self.depth_sigma, rounds=3, iterations=6)
        good = found.matches >= 30 and found.inliers >= LEAST_BY_PREVIOUS and found.share > LEAST_SHARE
        return found if good else None

    def _by_flow(
        self,
        frame: FeatureFrame,
        grey: np.ndarray,
        before: FeatureFrame,
        grey_before: np.ndarray,
        T_reference_before: np.ndarray,
    ) -> FoundPose | None:
        known = np.flatnonzero(before.depth > 0)
        # A fixed draw over the whole image: features are in order of their cells.
        picked = known[np.linspace(0, len(known) - 1, FLOW_COUNT).astype(int)] if len(known) > FLOW_COUNT else known
        if len(picked) < 15:
            return None
        moved, followed = flow_pairs(grey_before, grey, before.pixels[picked])
        if followed.sum() < 15:
            return None
        points, pixels = before.points[picked[followed]], moved[followed]
        start = ransac_pose(points, pixels, self.camera, error=4.0, iterations=100, confidence=0.99)
        if start is None or start[1] < 12:
            return None
        depth, on_edge = depth_at(frame.thin_depth, pixels / DEPTH_STRIDE, self.settings.max_depth)
        inverse = np.where(depth > 0, 1.0 / np.maximum(depth, 0.1), 0.0)
        measured = np.zeros(len(pixels), FEATURE)
        measured["pixel"], measured["pixel_sigma"] = pixels, 1.0
        measured["inverse_depth"], measured["on_edge"] = inverse, on_edge
        points = points @ T_reference_before[:3, :3].T + T_reference_before[:3, 3]
        self._finder.pair(points, np.arange(len(pixels)), len(pixels))
        T_camera_reference = start[0] @ np.linalg.inv(T_reference_before)
        motion = self._device_frame(frame).motion
        features = self._finder.measurements(measured)
        found = self._finder.solve(features, motion, T_camera_reference, max(self.depth_sigma, 0.01))
        good = found.inliers >= LEAST_BY_PREVIOUS and found.share >= LEAST_FLOW_SHARE
        return found if good else None

    def _by_descriptors(
        self, frame: FeatureFrame, other: FeatureFrame, T_reference_other: np.ndarray, least: int
    ) -> FoundPose | None:
        known = np.flatnonzero(other.depth > 0)
        i, j = descriptor_pairs(other.descriptors[known], frame.descriptors)
        if len(i) < least:
            return None
        points = other.points[known[i]]
        start = ransac_pose(points, frame.pixels[j], self.camera, error=6.0, iterations=200, confidence=0.999)
        if start is None or start[1] < least:
            return None
        points = points @ T_reference_other[:3, :3].T + T_reference_other[:3, 3]
        self._finder.pair(points, j, len(frame))
        target = self._device_frame(frame)
        T_camera_reference = start[0] @ np.linalg.inv(T_reference_other)
        found = self._finder.solve(target.features, target.motion, T_camera_reference, self.depth_sigma)
        return found if found.inliers >= least else None

    def _by_keyframes(
        self,
        frame: FeatureFrame,
        poses: Mapping[int, np.ndarray],
        numbers: Sequence[int],
        reference: np.ndarray,
        found: FoundPose,
    ) -> FoundPose | None:
        """Pose against keyframes, from one that is nearly right."""
        if not numbers or len(frame) == 0:
            return None
        start = found.T_camera_reference
        self._match_keyframes(frame, poses, numbers, reference, start, 6.0 if found.inliers > 50 else 10.0)
        target = self._device_frame(frame)
        refined = self._finder.solve(target.features, target.motion, start, self.depth_sigma)
        return refined if refined.inliers >= LEAST_BY_KEYFRAMES else None

    def _match_keyframes(
        self,
        frame: FeatureFrame,
        poses: Mapping[int, np.ndarray],
        numbers: Sequence[int],
        reference: np.ndarray,
        T_camera_reference: np.ndarray,
        radius: float,
    ) -> None:
        T_reference_world = np.linalg.inv(reference)
        sources = [(self._device_frame(self._keyframes[n]), T_reference_world @ poses[n]) for n in numbers]
        target = self._device_frame(frame)
        self._finder.match(sources, target, T_camera_reference, radius=radius, limit=90, ratio=0.9)

    def _witness(
        self,
        frame: FeatureFrame,
        found: FoundPose,
        reference: np.ndarray,
        other: FeatureFrame,
        T_other_world: np.ndarray,
        by: str,
        by_keyframes: bool,
    ) -> Witness:
        pose = orthonormalized(reference @ np.linalg.inv(found.T_camera_reference))
        mine, others = self._device_frame(frame), self._device_frame(other)
        agreement, compared = self._finder.agreement(mine, others, T_other_world @ pose)
        return Witness(pose, found.inliers, found.matches, agreement, compared, found.H, by, by_keyframes)

    def _learn(self, frame: DeviceFrame, found: FoundPose) -> None:
        """Running deviation of inverse depth: registration, time and blur make it several times a sensor's noise."""
        errors = found.depth_errors[frame.steady[found.features]]
        if found.inliers > 30 and len(errors) > 20:
            now = DEPTH_SIGMA_FACTOR * float(np.median(np.abs(errors)))
            mixed = (1.0 - DEPTH_SIGMA_RATE) * self.depth_sigma + DEPTH_SIGMA_RATE * now
            self.depth_sigma = float(np.clip(mixed, *DEPTH_SIGMA_RANGE))

    def _device_frame(self, frame: FeatureFrame) -> DeviceFrame:
        if frame not in self._uploaded:
            self._uploaded[frame] = self._finder.upload(frame)
        return self._uploaded[frame]


class FeatureRows:
    """Matches of a frame with keyframes: reprojection and depth residuals for a joint system."""

    def __init__(
        self, finder: PoseFinder, frame: DeviceFrame, T_world_reference: np.ndarray, depth_sigma: float
    ) -> None:
        self._finder, self._frame, self._depth_sigma = finder, frame, depth_sigma
        self._T_world_reference = T_world_reference

    def at(self, T_world_camera: np.ndarray) -> FoundPose:
        """H = J' W J and b = J' W r at a pose (4, 4), Huber-weighted.

        For the step xi = -H^-1 b of T_camera_world <- exp(xi) T_camera_world, xi = (v, w) [m, rad]; residuals are in
        units of their standard deviation.
        """
        T = np.linalg.inv(T_world_camera) @ self._T_world_reference
        return self._finder.evaluate(self._frame.features, self._frame.motion, T, self._depth_sigma)
