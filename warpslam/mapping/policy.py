"""The two ways of mapping, one a loss (`mapping.loss`): what the rest of the program asks of both, and which it
gets.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
import warp as wp

from warpslam.camera import Intrinsics
from warpslam.config import Config, MappingConfig
from warpslam.mapping.direct_mapper import PARTS, DirectMapper
from warpslam.mapping.mapper import Mapper, MappingResult
from warpslam.scene.image_pool import ImagePool
from warpslam.scene.keyframes import Keyframe, PlacedImage
from warpslam.scene.scene_map import SceneMap
from warpslam.scene.touched_rows import TouchedRowsState


class MapOptimizer(Protocol):
    """Optimises a `SceneMap` from the current frame, whose image is in slot 0 of a pool, and keyframes."""

    scene: SceneMap
    """The map it optimises."""
    device: wp.Device
    """Where."""

    def start_first(self, images: ImagePool, frame: int, pose: np.ndarray) -> Callable[[], MappingResult]:
        """Map the first frame; the function that is returned waits for the device, and reads the outcome."""

    def start_frame(
        self, images: ImagePool, frame: int, pose: np.ndarray, keyframes: list[Keyframe]
    ) -> Callable[[], MappingResult]:
        """The same for a later frame."""

    def refine(
        self, images: ImagePool, frame: int, pose: np.ndarray, keyframes: list[Keyframe], rounds: range
    ) -> MappingResult:
        """Go on with the whole map after the last frame, for several rounds, whose numbers are part of the seeds."""

    def restrict(self, free: dict[str, np.ndarray] | None, renewed: dict[str, np.ndarray]) -> None:
        """From now on only rows that are true change, bool (rows,) by level, and no decoder; None ends it.

        renewed: Rows, int (n,) by level, whose features were begun again.
        """

    def make_room(self, images: ImagePool, pose: np.ndarray, window: list[PlacedImage]) -> None:
        """Have rows wherever a call on the image in slot 0 and a window may need them."""

    def map_again(
        self, images: ImagePool, keyframe: Keyframe, keyframes: list[Keyframe], iterations: int, round_: int
    ) -> MappingResult:
        """Map a keyframe, whose image is in slot 0, together with others that see the same."""

    def changed_rows(self) -> dict[str, wp.array]:
        """Rows of each level that the last call may have changed, int (n,); levels it left alone are absent."""

    def state(self) -> dict[str, TouchedRowsState]:
        """What the next call depends on beside the map, by level."""

    def restore(self, state: dict[str, TouchedRowsState]) -> None:
        """Put back what `state` was; the map is already what it was."""


def images_at_a_time(config: MappingConfig) -> int:
    """Images that a call needs on the device: of two windows and the current frame, or of a direct call's parts."""
    needed = 1 + 2 * config.window
    return max(needed, PARTS) if config.loss == "direct" else needed


def new_mapper(
    scene: SceneMap, camera: Intrinsics, config: Config, device: wp.Device, seed: int
) -> Mapper | DirectMapper:
    """The optimiser of `MappingConfig.loss`."""
    if config.mapping.loss == "direct":
        return DirectMapper(scene, camera, config, device, seed)
    return Mapper(scene, camera, config.mapping, config.sampling, device, seed)
