"""Features as the second witness: asked where direct registration is in doubt, and where a camera is lost.

Features of a frame are computed when somebody asks for them, from the images that are kept anyway.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import warp as wp

from warpslam.camera import NO_MOTION, FrameMotion, Intrinsics
from warpslam.scene.image_pool import ImagePool
from warpslam.scene.keyframes import Keyframe
from warpslam.tracking.features.detection import FeatureFrame, SensorTiming, detect, retimed
from warpslam.tracking.features.device import FoundPose
from warpslam.tracking.features.settings import FeatureSettings
from warpslam.tracking.features.witness import FeatureRows, FeatureWitness, Witness

LATEST = 2
"""Frames whose features are kept."""


@dataclass(frozen=True)
class Picture:
    """A frame as features are found in it."""

    rgb: np.ndarray
    """uint8 (H, W, 3)."""
    depth: np.ndarray
    """float32 (H, W) [m]."""
    index: int = -1
    """Of the frame: its features are found once; -1 = it has none."""
    motion: FrameMotion = NO_MOTION
    """Of the camera while it took the frame, by which features are brought to one time."""

    @classmethod
    def of(cls, rgb: np.ndarray, units: np.ndarray, scale: float) -> Picture:
        """From an image as the pool keeps it: depth in uint16, and metres per unit."""
        return cls(rgb, units.astype(np.float32) * np.float32(scale))

    @property
    def grey(self) -> np.ndarray:
        """uint8 (H, W)."""
        return cv2.cvtColor(self.rgb, cv2.COLOR_RGB2GRAY)


class SecondWitness:
    """Features of frames and keyframes, found when they are wanted.

    Args:
        camera: Camera of all frames.
        device: Where poses are found.
        max_depth: Depth beyond this is not used [m].
        keyframes: The tracker's.
        images: Where theirs are kept.
    """

    def __init__(
        self, camera: Intrinsics, device: wp.Device, max_depth: float, keyframes: list[Keyframe], images: ImagePool
    ) -> None:
        self.camera, self.keyframes, self.images = camera, keyframes, images
        self.settings = FeatureSettings(max_depth=max_depth)
        self._witness = FeatureWitness(camera, device, self.settings)
        self._known: dict[int, FrameMotion] = {}  # the motion that a keyframe's features were corrected by
        self._latest: dict[int, FeatureFrame] = {}  # of frames as they were found, by index

    @property
    def depth_sigma(self) -> float:
        """What the witness has learnt, see `FeatureWitness.depth_sigma`."""
        return self._witness.depth_sigma

    @depth_sigma.setter
    def depth_sigma(self, value: float) -> None:
        self._witness.depth_sigma = value

    def locate(
        self,
        frame: Picture,
        before: Picture,
        pose_before: np.ndarray,
        foretold: np.ndarray,
        keyframes: Sequence[int],
    ) -> Witness | None:
        """Where a frame is that follows another; ``keyframes``: those to match it with, the likeliest first."""
        self._learn(keyframes)
        previous = self._features(before), before.grey, pose_before
        return self._witness.locate(
            self._features(frame), frame.grey, previous, self._poses(keyframes), foretold, keyframes
        )

    def relocalize(self, frame: Picture, keyframes: Sequence[int]) -> Witness | None:
        """Where a frame is of which nothing is known."""
        self._learn(keyframes)
        return self._witness.relocalize(self._features(frame), self._poses(keyframes), keyframes)

    def rows(self, frame: Picture, pose: np.ndarray, keyframes: Sequence[int]) -> FeatureRows | None:
        """Matches of a frame whose pose is nearly known with keyframes; see `FeatureWitness.rows`."""
        self._learn(keyframes)
        return self._witness.rows(self._features(frame), self._poses(keyframes), keyframes, pose)

    def between(self, earlier: int, later: int, T_later_earlier: np.ndarray) -> FoundPose | None:
        """Where the points of a keyframe say that a later one is; see `FeatureWitness.between`."""
        self._learn([earlier, later])
        return self._witness.between(earlier, later, T_later_earlier)

    def _poses(self, keyframes: Sequence[int]) -> dict[int, np.ndarray]:
        return {number: self.keyframes[number].pose for number in keyframes}

    def _features(self, picture: Picture) -> FeatureFrame:
        found = self._latest.get(picture.index)
        if found is None:
            found = detect(picture.grey, picture.depth, self.camera, self.settings)
        if picture.index >= 0:
            self._latest[picture.index] = found
            while len(self._latest) > LATEST:
                del self._latest[min(self._latest)]
        if picture.motion.is_none:
            return found
        timing = SensorTiming(picture.motion.depth_offset, picture.motion.readout)
        return retimed(found, picture.depth, self.camera, self.settings, timing, np.array(picture.motion.twist))

    def _learn(self, keyframes: Sequence[int]) -> None:
        for number in keyframes:
            keyframe = self.keyframes[number]
            if self._known.get(number) != keyframe.motion:
                picture = Picture.of(*self.images.kept(keyframe.image).unpack(self.camera))
                # On the CPU they are those of the frame, which may have been asked already.
                index = keyframe.index if self._witness.device.is_cpu else -1
                picture = replace(picture, index=index, motion=keyframe.motion)
                self._witness.add_keyframe(number, self._features(picture))
                self._known[number] = keyframe.motion
