"""Pictures leave out samples in free space: which cells are free, which samples remain, and what that changes."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

import warpslam
from warpslam import Config, Intrinsics, Slam
from warpslam.config import GridConfig
from warpslam.evaluation import psnr
from warpslam.field.arrays import struct
from warpslam.field.decoders import random_decoders
from warpslam.field.ray_batch import RayBatch
from warpslam.kernels.free_space import Looks
from warpslam.scene.scene_map import SceneMap
from warpslam.synthetic import SyntheticSequence

CAMERA = Intrinsics(80.0, 80.0, 47.5, 35.5, 96, 72)
RAYS, SAMPLES, LIMIT = 60, 20, -0.5
LOW, HIGH = np.array([-1.0, -0.8, -0.6]), np.array([1.0, 0.9, 1.1])


@pytest.fixture
def scene_map(device) -> SceneMap:
    """A box of random features."""
    scene_map = SceneMap(random_decoders(0), GridConfig(fine_spacing=0.16, color_spacing=0.16, layout="dense"), device)
    scene_map.cover(LOW, HIGH)
    return scene_map


def random_batch(device: wp.Device, rng: np.random.Generator) -> tuple[RayBatch, np.ndarray]:
    """Rays through the box with ascending samples, some not kept, and where the samples lie (rays, samples, 3)."""
    batch = RayBatch(RAYS, SAMPLES, device)
    batch.count, batch.sample_count = RAYS, SAMPLES
    origin = rng.uniform(LOW, HIGH, (RAYS, 3)).astype(np.float32)
    direction = rng.normal(size=(RAYS, 3)).astype(np.float32)
    z = np.sort(rng.uniform(0.0, 0.8, (RAYS, SAMPLES)).astype(np.float32), axis=1)
    batch.origin.assign(origin)
    batch.direction.assign(direction)
    batch.z.assign(z.ravel())
    batch.keep.assign((rng.random(RAYS) < 0.8).astype(np.int32))
    return batch, origin[:, None] + z[..., None] * direction[:, None]


def cells_of(points: np.ndarray, scene_map: SceneMap) -> np.ndarray:
    """Lowest corner of the cell of each point, clamped to the lattice, as `find_cell` does."""
    lattice = scene_map.grids["fine"].lattice
    u = (points - np.array(lattice.origin)) * np.array(lattice.inverse_spacing)
    return np.clip(np.floor(u).astype(int), 0, np.array(lattice.shape) - 2)


def test_samples_that_remain_are_those_outside_of_free_space(scene_map, device):
    """Against the definition in numpy: looked at, and no sample beyond the limit in the cell or the 26 about it."""
    rng = np.random.default_rng(0)
    arrays = scene_map.arrays()
    shape = tuple(scene_map.grids["fine"].lattice.shape)
    batch, points = random_batch(device, rng)
    logit = np.where(rng.random((RAYS, SAMPLES)) < 0.02, 0.3, -1.0).astype(np.float32)
    logit[3, 4] = np.nan  # what can't be told is not free
    batch.keep[3:4].assign(np.ones(1, np.int32))
    batch.logit.assign(logit.ravel())
    count = scene_map.grids["fine"].features.shape[0]
    looks = struct(Looks, **{n: wp.zeros(count, dtype=wp.uint8, device=device) for n in ("looked", "occupied")})
    batch.look(arrays, LIMIT, looks)

    kept = batch.keep.numpy() != 0
    free, occupied = np.zeros(shape, bool), np.zeros(shape, bool)
    cells = cells_of(points, scene_map)
    free[tuple(cells[kept].reshape(-1, 3).T)] = True
    for i, j, k in cells[kept][~(logit[kept] <= LIMIT)]:
        occupied[max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2, max(k - 1, 0) : k + 2] = True
    free &= ~occupied
    assert 0.02 < free.mean() < 0.9

    more, points = random_batch(device, rng)
    z = more.z.numpy().reshape(RAYS, SAMPLES).copy()
    wanted = ~free[tuple(np.moveaxis(cells_of(points, scene_map), -1, 0))]
    wanted[:, -1] = True
    more.leave_out_free(arrays, looks)
    kept = more.keep.numpy() != 0
    assert 0.2 < wanted[kept].mean() < 0.95 and more.sample_count == wanted[kept].sum(axis=1).max()
    found = more.z.numpy()[: RAYS * more.sample_count].reshape(RAYS, more.sample_count)
    for ray in np.flatnonzero(kept):
        left = z[ray, wanted[ray]]
        expected = np.concatenate([left, np.full(more.sample_count - len(left), z[ray, -1])])
        np.testing.assert_array_equal(found[ray], expected)


@pytest.mark.parametrize("layout", ["dense", "blocks"])
def test_pictures_stay_what_they_are(layout):
    """Of a mapped room: two thirds of the samples at most, in a small image, and the same picture."""
    frames = SyntheticSequence(1, 4, intrinsics=CAMERA)
    settings = [f"grid.layout={layout}", "mapping.first_iterations=40", "mapping.pixels=400", "mapping.every=1"]
    slam = Slam(CAMERA, Config.from_preset("default", settings), "cpu")
    for n in range(4):
        frame = frames[n]
        slam.step(frame.rgb, frame.depth, frame.timestamp, frame.T_world_camera)
    pose, views, points = frames[2].T_world_camera, {}, {}
    sampling = slam.config.sampling
    for limit in (0.0, sampling.min_occupancy):
        slam.config = slam.config.model_copy(update={"sampling": sampling.model_copy(update={"min_occupancy": limit})})
        with warpslam.profile() as profile:
            views[limit] = slam.render(pose)
        points[limit] = sum(row.points for row in profile.report.kernels if row.kernel == "fine_forward")
    exact, fast = views.values()
    assert psnr(fast.rgb, (255 * exact.rgb).round().astype(np.uint8)) > 35
    # The little that free space absorbs draws the mean depth of a young map to the camera.
    assert np.median(np.abs(fast.depth - exact.depth)) < 0.01
    assert np.mean(np.abs(fast.depth - exact.depth) > 0.1) < 0.01
    assert np.median(np.abs(fast.depth - frames[2].depth)) < 0.01
    assert 3 * points[sampling.min_occupancy] < 2 * points[0.0]
