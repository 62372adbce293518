"""Which pixels a batch of rays was drawn from."""

from __future__ import annotations

import numpy as np

from warpslam.camera import Intrinsics
from warpslam.field.ray_batch import RayBatch


def pixels_of(batch: RayBatch, camera: Intrinsics) -> tuple[np.ndarray, np.ndarray]:
    """Columns and rows of the rays."""
    direction = batch.direction_camera.numpy()[: batch.count]
    u = np.rint(direction[:, 0] * camera.fx + camera.cx).astype(int)
    v = np.rint(direction[:, 1] * camera.fy + camera.cy).astype(int)
    return u, v
