"""Images without delay or rolling shutter from those that a moving camera took; see `warpslam.kernels.rectify`."""

from __future__ import annotations

import numpy as np
import warp as wp

from warpslam.camera import FrameMotion, Intrinsics
from warpslam.field.arrays import camera_struct
from warpslam.kernels import rectify
from warpslam.poses import motion_of

Arrays = tuple[wp.array, wp.array, wp.array]


class Rectifier:
    """Rectifies images on a device, one at a time.

    Args:
        camera: Camera of the images.
        device: Where they are.
    """

    def __init__(self, camera: Intrinsics, device: wp.Device) -> None:
        self.camera, self.device = camera, device
        self._camera = camera_struct(camera)

    def new_image(self) -> Arrays:
        """Room for an image: colour (1, H, W, 3), depth (1, H, W) and its scale (1,)."""
        size = (1, self.camera.height, self.camera.width)
        return (
            wp.zeros((*size, 3), dtype=wp.uint8, device=self.device),
            wp.zeros(size, dtype=wp.uint16, device=self.device),
            wp.zeros(1, dtype=float, device=self.device),
        )

    def rectify(self, raw: Arrays, motion: FrameMotion, target: Arrays) -> None:
        """Rectify the first image of ``raw`` into the first of ``target``, another one."""
        inputs = [raw[0][0], raw[1][0], raw[2], self._camera, sweep_of(motion), target[0][0], target[1][0], target[2]]
        size = (self.camera.height, self.camera.width)
        wp.launch(rectify.rectify, size, inputs, device=self.device, record_tape=False)


def sweep_of(motion: FrameMotion) -> rectify.Sweep:
    """A motion as the kernel takes it."""
    twist = np.array(motion.twist)
    sweep = rectify.Sweep()
    sweep.to_depth = wp.mat44(*motion_of(-motion.depth_offset * twist).ravel().tolist())
    sweep.from_depth = wp.mat44(*motion_of(motion.depth_offset * twist).ravel().tolist())
    sweep.velocity = wp.vec3(*(motion.readout * twist[:3]).tolist())
    sweep.spin = wp.vec3(*(motion.readout * twist[3:]).tolist())
    return sweep
