"""The coarse level (Sec. 3.1), which forecasts what was not seen: depth loss only, without guidance by depth."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import warp as wp

from warpslam.camera import Intrinsics
from warpslam.config import MappingConfig, SamplingConfig
from warpslam.field.arrays import Gradients
from warpslam.field.objectives import mapping_loss
from warpslam.field.passes import render
from warpslam.field.ray_batch import RayBatch
from warpslam.runtime.launching import Launcher
from warpslam.scene.image_pool import ImagePool
from warpslam.scene.optimizers import GridOptimizer
from warpslam.scene.scene_map import SceneMap


def optimize_coarse(
    scene: SceneMap,
    optimizer: GridOptimizer,
    images: ImagePool,
    slots: wp.array,
    poses: wp.array,
    camera: Intrinsics,
    config: MappingConfig,
    sampling: SamplingConfig,
    batch: RayBatch,
    launcher: Launcher,
    seeds: Sequence[int],
    rate: float,
) -> None:
    """Optimise the coarse features.

    Args:
        scene: The map.
        optimizer: Of its coarse level, in a call that has begun.
        images: Images of the frames.
        slots: Of these images, int (frames,).
        poses: Pose vectors of the frames, float (frames, 7).
        camera: Intrinsics.
        config: How many rays, and whether their losses are added or averaged.
        sampling: Samples along a ray.
        batch: Room for that many rays.
        launcher: Of the iterations, with no record of others of this kind.
        seeds: Of the rays, one an iteration.
        rate: Learning rate.
    """
    gradients = Gradients(grids={"coarse": optimizer.wanted()})

    def iterate() -> None:
        arrays = scene.arrays()
        with launcher.tape() as tape:
            batch.draw(images.arrays, slots, max(config.pixels // slots.shape[0], 1), camera)
            batch.cast(poses)
            batch.bound(arrays, use_depth=False)
            batch.place_samples(sampling.stratified, 0, use_depth=False, jitter=sampling.jitter)
            render(batch, arrays, "coarse", gradients, tape)
            mapping_loss(batch, 0.0, 1.0 / batch.count if config.loss_reduction == "mean" else 1.0)
        launcher.call(partial(tape.backward, batch.loss))
        optimizer.update(scene.grids["coarse"].features, rate)
        batch.next_iteration()

    batch.set_seeds(list(seeds))
    for _ in seeds:
        launcher.iterate("coarse", (), iterate)
