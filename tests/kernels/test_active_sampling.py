"""Rays that go where the map errs."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from tests.kernels.drawn_pixels import pixels_of
from warpslam.camera import Intrinsics
from warpslam.config import GridConfig, SamplingConfig
from warpslam.field.decoder_files import load_decoders
from warpslam.field.ray_batch import RayBatch
from warpslam.kernels import pixels
from warpslam.mapping.active_sampling import CELLS, LARGEST_ERROR, CellErrors
from warpslam.poses import vector_from_pose
from warpslam.runtime.launching import Launcher
from warpslam.scene.image_pool import ImagePool
from warpslam.scene.scene_map import SceneMap

CAMERA = Intrinsics(80.0, 80.0, 79.5, 59.5, 160, 120)
CELL_COUNT = CELLS[0] * CELLS[1]
RAYS = 6000


def cells(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Which cell a pixel belongs to, by the definition of `CELLS`."""
    return v * CELLS[1] // CAMERA.height * CELLS[0] + u * CELLS[0] // CAMERA.width


@pytest.fixture(scope="module")
def images(device):
    """An image pool with a wall at 1 m in slot 0 and one at 2 m in slot 1."""
    pool = ImagePool(CAMERA, device)
    rgb = np.full((CAMERA.height, CAMERA.width, 3), 128, np.uint8)
    pool.set(0, rgb, np.full((CAMERA.height, CAMERA.width), 1.0, np.float32))
    assert pool.bring([pool.add(rgb, np.full((CAMERA.height, CAMERA.width), 2.0, np.float32))]) == [1]
    return pool


def drawn(images, device, share: float, error: np.ndarray) -> RayBatch:
    """Rays of the pool's two images for errors (2, cells)."""
    batch = RayBatch(2 * RAYS, 4, device)
    batch.set_seeds([3])
    cumulative = wp.array(np.cumsum(error, axis=1), dtype=float, device=device)
    window = wp.array([0, 1], dtype=int, device=device)
    batch.draw(images.arrays, window, RAYS, CAMERA, active=(share, CELLS, cumulative))
    return batch


def test_rays_follow_the_error_of_their_own_image(images, device):
    """Cells get rays in proportion to their error, cells without error none, each image by its own errors."""
    error = np.zeros((2, CELL_COUNT))
    error[0, 17], error[0, 250] = 3.0, 1.0
    error[1, CELL_COUNT - 1] = 0.2
    batch = drawn(images, device, 1.0, error)
    where, frame = cells(*pixels_of(batch, CAMERA)), batch.frame.numpy()
    counts = [np.bincount(where[frame == f], minlength=CELL_COUNT) for f in range(2)]
    assert set(np.flatnonzero(counts[0])) == {17, 250} and set(np.flatnonzero(counts[1])) == {CELL_COUNT - 1}
    # Three standard deviations of a binomial share of 3/4 of 6000.
    assert counts[0][17] / RAYS == pytest.approx(0.75, abs=0.017)


def test_rays_fall_anywhere_in_their_cell(images, device):
    """Every pixel of a chosen cell is drawn."""
    error = np.zeros((2, CELL_COUNT))
    error[:, 42] = 1.0
    u, v = pixels_of(drawn(images, device, 1.0, error), CAMERA)
    width, height = CAMERA.width // CELLS[0], CAMERA.height // CELLS[1]
    assert len(set(zip(u, v, strict=True))) == width * height


def test_the_share_of_active_rays(images, device):
    """The others are uniform."""
    error = np.zeros((2, CELL_COUNT))
    error[:, 5] = 1.0
    where = cells(*pixels_of(drawn(images, device, 0.4, error), CAMERA))
    assert np.mean(where == 5) == pytest.approx(0.4 + 0.6 / CELL_COUNT, abs=0.014)
    assert len(set(where)) > 0.95 * CELL_COUNT
    where = cells(*pixels_of(drawn(images, device, 0.0, error), CAMERA))
    assert np.mean(where == 5) < 0.01


def test_errors_of_the_map(images, device):
    """Running sums of |D - D^|, capped; the pose counts; a missing depth counts nothing."""
    scene = SceneMap(load_decoders(), GridConfig(layout="dense"), device, seed=1)
    scene.cover(np.full(3, -2.5), np.full(3, 3.0))
    rgb, depth = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8), images.depth[1].numpy() * images.scale.numpy()[1]
    depth[:, : CAMERA.width // 2] = 0.0
    half = images.bring([images.add(rgb, depth)])[0]
    errors = CellErrors(2, 0.5, SamplingConfig(), device, Launcher(device))
    poses = wp.array(np.stack([vector_from_pose(np.eye(4))] * 2).astype(np.float32), dtype=float, device=device)
    window = wp.array([half, 0], dtype=int, device=device)
    errors.measure(scene.arrays(), images.arrays, window, poses, CAMERA, seed=9)
    cumulative = errors.cumulative.numpy()
    each = np.diff(cumulative, axis=1, prepend=0.0).reshape(2, CELLS[1], CELLS[0])
    assert each.min() >= 0.0 and each.max() <= LARGEST_ERROR + 1e-4
    # Nothing is known yet: a random map errs somewhere.
    assert each[1].max() > 0.02 and each[0, :, CELLS[0] // 2 :].max() > 0.02
    assert each[0, :, : CELLS[0] // 2].max() < 1e-4


def test_without_any_error_all_cells_are_alike(device):
    """A perfect map leaves no division by nothing."""
    depth = wp.full(2 * CELL_COUNT, 1.0, dtype=float, device=device)
    keep = wp.full(2 * CELL_COUNT, 1, dtype=int, device=device)
    cumulative = wp.zeros((2, CELL_COUNT), dtype=float, device=device)
    wp.launch(pixels.accumulate_errors, 2, [CELL_COUNT, LARGEST_ERROR, keep, depth, depth], [cumulative], device=device)
    steps = np.diff(cumulative.numpy(), axis=1)
    np.testing.assert_allclose(steps, steps.mean(), rtol=1e-2)
    assert steps.min() > 0.0
