"""The rays of an iteration of the rendering loss, as mapping and its final refinement draw them."""

from __future__ import annotations

import numpy as np
import warp as wp

from warpslam.camera import Intrinsics
from warpslam.config import MappingConfig, SamplingConfig
from warpslam.field.arrays import FieldArrays, Thresholds
from warpslam.field.ray_batch import RayBatch
from warpslam.mapping.active_sampling import CellErrors
from warpslam.scene.image_pool import ImagePool


def draw_rays(
    batch: RayBatch,
    arrays: FieldArrays,
    images: ImagePool,
    slots: wp.array,
    poses: wp.array,
    pose: np.ndarray,
    camera: Intrinsics,
    config: MappingConfig,
    sampling: SamplingConfig,
    errors: CellErrors | None,
    *,
    differentiate: bool = False,
) -> tuple[float, Thresholds]:
    """Rays of a window and their samples. Returns the weight of a ray in the loss, and what is left out of it.

    Args:
        batch: Gets them.
        arrays: The map.
        images: Images of the window.
        slots: Of these images, the current frame's last, int (frames,).
        poses: Pose vectors of the frames, float (frames, 7).
        pose: T_world_camera of the current frame (4, 4).
        camera: Intrinsics.
        config: Settings of mapping.
        sampling: Samples along a ray.
        errors: Where a share of the rays goes; None: all are uniform.
        differentiate: Whether poses get a gradient.
    """
    active = errors.active if errors is not None else None
    batch.draw(images.arrays, slots, max(config.pixels // slots.shape[0], 1), camera, active=active)
    batch.cast(poses, differentiate=differentiate)
    batch.bound(arrays)
    current = slots.shape[0] - 1
    if config.moved_margin > 0 and current > 0:
        batch.drop_contradicted(images.arrays, current, pose, camera, config.moved_margin)
    batch.place_samples(sampling.stratified, sampling.surface, jitter=sampling.jitter)
    scale = 1.0 / batch.count if config.loss_reduction == "mean" else 1.0
    return scale, Thresholds(sampling.min_weight, sampling.min_gradient * scale, sampling.min_transmittance)
