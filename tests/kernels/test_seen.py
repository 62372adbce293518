"""Which vertices a frame measures, and which rays end where one was measured."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import warp as wp

from warpslam.camera import Intrinsics
from warpslam.config import GridConfig
from warpslam.field.arrays import FieldArrays
from warpslam.field.decoders import random_decoders
from warpslam.field.ray_batch import RayBatch
from warpslam.mapping.frustum import REACH, mark_seen
from warpslam.poses import vector_from_pose
from warpslam.scene.image_pool import ImagePool
from warpslam.scene.scene_map import SceneMap

CAMERA = Intrinsics(50.0, 50.0, 31.5, 23.5, 64, 48)
WALL = 2.0  # [m]
HOLE = np.s_[:, 40:]  # columns without depth
RAYS = 3000


@pytest.fixture
def scene_map(device) -> SceneMap:
    """A box around a wall, of which nothing was seen."""
    scene_map = SceneMap(random_decoders(0), GridConfig(fine_spacing=0.16, color_spacing=0.16, layout="dense"), device)
    scene_map.cover(np.array([-2.0, -1.5, -0.2]), np.array([2.0, 1.5, 2.5]))
    return scene_map


def wall_with_hole() -> np.ndarray:
    depth = np.full((CAMERA.height, CAMERA.width), WALL, np.float32)
    depth[HOLE] = 0.0
    return depth


def mark(scene_map: SceneMap, depth: np.ndarray) -> np.ndarray:
    """Mark what a camera at the origin measures; returns which colour vertices are marked, bool (rows,)."""
    grid = scene_map.grids["color"]
    image = wp.array(depth, dtype=float, device=grid.device)
    mark_seen(grid, CAMERA, np.eye(4), image)
    return grid.seen.numpy() != 0


def kept(
    arrays: FieldArrays, device: wp.Device, depth: np.ndarray, *, unseen: bool = False
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rays of a camera at the origin: which are kept (n,), their measured depth (n,), and where they meet the wall.

    unseen: Keep those that are otherwise left out.
    """
    pool = ImagePool(CAMERA, device)
    pool.set(0, np.full((CAMERA.height, CAMERA.width, 3), 128, np.uint8), depth)
    batch = RayBatch(RAYS, 4, device)
    batch.set_seeds([5])
    batch.draw(pool.arrays, wp.zeros(1, dtype=int, device=device), RAYS, CAMERA)
    batch.cast(wp.array(vector_from_pose(np.eye(4))[None], dtype=float, device=device))
    batch.bound(arrays)
    assert batch.keep.numpy().all()
    (batch.keep_unseen if unseen else batch.drop_unseen)(arrays)
    return batch.keep.numpy() != 0, batch.measured_depth.numpy(), WALL * batch.direction.numpy()


def test_what_a_frame_measures(scene_map):
    """Vertices in view before the wall and a little behind it, but none where depth is missing; marks add up."""
    seen = mark(scene_map, wall_with_hole())
    grid = scene_map.grids["color"]
    index = np.stack(np.meshgrid(*(np.arange(n) for n in grid.shape), indexing="ij"), -1).reshape(-1, 3)
    x, y, z = (grid.spacing * (grid.first + index)).T
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = np.rint(50.0 * x / z + 31.5), np.rint(50.0 * y / z + 23.5)
    in_view = (z > 0) & (u >= 0) & (u < 64) & (v >= 0) & (v < 48) & (z - WALL <= REACH * grid.spacing)
    np.testing.assert_array_equal(seen, in_view & (u < 40))
    assert (in_view & ~seen).any()
    np.testing.assert_array_equal(mark(scene_map, np.full_like(wall_with_hole(), WALL)), in_view)


def test_rays_into_what_nobody_measured_are_left_out(scene_map, device):
    """Where the whole cell at its end was measured a ray stays, and without depth, too; the others go."""
    full = np.full_like(wall_with_hole(), WALL)
    arrays = scene_map.arrays()
    assert not kept(arrays, device, full)[0].any()
    mark(scene_map, wall_with_hole())
    keep, _, point = kept(arrays, device, full)
    # The last measured column meets the wall at x = 0.3: the cell there, up to 0.32, was not measured whole.
    assert keep[(point[:, 0] > -1.0) & (point[:, 0] < 0.15) & (np.abs(point[:, 1]) < 0.7)].all()
    assert not keep[point[:, 0] > 0.33].any()
    keep, depth, _ = kept(arrays, device, wall_with_hole())
    assert keep[depth == 0].all() and (depth == 0).any()


def test_rays_of_the_coarse_term_are_those_left_out(scene_map, device):
    """Every ray with depth is kept for one of both purposes; a map that was seen everywhere leaves none."""
    mark(scene_map, wall_with_hole())
    arrays, full = scene_map.arrays(), np.full_like(wall_with_hole(), WALL)
    seen, unseen = (kept(arrays, device, full, unseen=unseen)[0] for unseen in (False, True))
    assert seen.any() and unseen.any()
    np.testing.assert_array_equal(seen, ~unseen)
    keep, depth, _ = kept(arrays, device, wall_with_hole(), unseen=True)
    assert keep.any() and not keep[depth == 0].any()
    assert not kept(dataclasses.replace(arrays, seen=None), device, full, unseen=True)[0].any()


def test_growth_keeps_what_was_seen(scene_map):
    """A larger map has the same marked vertices, and the arrays that kernels read are the new ones."""
    count = mark(scene_map, wall_with_hole()).sum()
    old = scene_map.arrays()
    scene_map.cover(np.array([-4.0, -1.5, -0.2]), np.array([2.0, 1.5, 4.5]))
    arrays = scene_map.arrays()
    assert arrays.seen.shape[0] > old.seen.shape[0]
    assert arrays.seen.numpy().sum() == count
