"""A room whose images are cast by rule, and what registers them."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from tests.kernels.swept_room import SweptRoom
from warpslam.camera import NO_MOTION, FrameMotion, Intrinsics
from warpslam.scene.image_pool import ImagePool
from warpslam.tracking.direct.pyramid import PyramidPlan
from warpslam.tracking.direct.registrar import Floors, Registrar

CAMERA = Intrinsics(262.5, 262.5, 159.5, 119.5, 320, 240)
ROOM = SweptRoom(pillar=0.35, grain=25.0)


class Bench:
    """A registrar with frames of the room, by row."""

    def __init__(self, device: wp.Device) -> None:
        self.plan = PyramidPlan.of(CAMERA)
        self.registrar = Registrar(self.plan, 8, 10.0, Floors(2.0, 0.3), device)
        self.pool = ImagePool(CAMERA, device)

    def load(
        self, row: int, pose: np.ndarray, motion: FrameMotion = NO_MOTION, gain: float = 1.0, room: SweptRoom = ROOM
    ) -> None:
        """Take the frame at a pose and build its pyramid."""
        rgb, depth = room.take(CAMERA, pose, motion)
        self.pool.set(0, np.rint(rgb * gain).astype(np.uint8), depth)
        images, units, scale = self.pool.arrays
        self.registrar.load(row, images[0], units[0], scale[:1])


@pytest.fixture(params=wp.get_devices(), ids=str)
def bench(request) -> Bench:
    """On each device."""
    return Bench(request.param)
