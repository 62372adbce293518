"""Features as the second witness: asked where direct registration is in doubt, and where a camera is lost.

Features of a frame are computed when somebody asks for them, from the images that are kept anyway.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import warp as wp

from warpslam.camera import Intrinsics
from warpslam.scene.image_pool import ImagePool
from warpslam.scene.keyframes import Keyframe
from warpslam.tracking.features.detection import FeatureFrame, detect
from warpslam.tracking.features.settings import FeatureSettings
from warpslam.tracking.features.witness import FeatureWitness, Witness


@dataclass(frozen=True)
class Picture:
    """A frame as features are found in it."""

    rgb: np.ndarray
    """uint8 (H, W, 3)."""
    depth: np.ndarray
    """float32 (H, W) [m]."""

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
        self._known: set[int] = set()

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

    def _poses(self, keyframes: Sequence[int]) -> dict[int, np.ndarray]:
        return {number: self.keyframes[number].pose for number in keyframes}

    def _features(self, picture: Picture) -> FeatureFrame:
        return detect(picture.grey, picture.depth, self.camera, self.settings)

    def _learn(self, keyframes: Sequence[int]) -> None:
        for number in keyframes:
            if number not in self._known:
                picture = Picture.of(*self.images.kept(self.keyframes[number].image).unpack(self.camera))
                self._witness.add_keyframe(number, self._features(picture))
                self._known.add(number)
