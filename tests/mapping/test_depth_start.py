"""`warpslam.mapping.depth_start`: the fit against the decoder, and which vertices start from the depth."""

import numpy as np
import pytest
import warp as wp

from warpslam.camera import Intrinsics
from warpslam.field.decoder_files import load_decoders
from warpslam.field.decoders import random_decoders
from warpslam.field.feature_fit import logit_and_derivative
from warpslam.kernels.grid import Vec32
from warpslam.mapping.depth_start import TRUNCATION, DepthStart, fit_signed_distance
from warpslam.mapping.frustum import REACH
from warpslam.scene.feature_grid import FeatureGrid

CAMERA = Intrinsics(fx=50.0, fy=50.0, cx=31.5, cy=23.5, width=64, height=48)
WALL = 2.0  # [m]


def tensors_of(weights) -> dict[str, np.ndarray]:
    return {name: tensor.astype(np.float64) for name, tensor in weights.padded().tensors.items()}


def test_derivatives_by_the_feature():
    """They agree with central differences, through all five layers and the skip."""
    rng = np.random.default_rng(0)
    tensors = tensors_of(random_decoders(3).middle)
    points, features = rng.uniform(-2, 2, (20, 3)), rng.normal(0, 1, (20, 32))
    _, by_feature = logit_and_derivative(tensors, points, features)
    for k in (0, 17, 31):
        step = np.zeros(32)
        step[k] = 1e-6
        high, low = (logit_and_derivative(tensors, points, features + sign * step)[0] for sign in (1, -1))
        np.testing.assert_allclose(by_feature[:, k], (high - low) / 2e-6, atol=1e-6)


def test_decoder_reads_the_signed_distance():
    """Between two fitted features the logit is the distance times the steepness, at points that were not fitted."""
    weights = load_decoders().middle
    base, slope = fit_signed_distance(weights, 8.0, 0.5)
    rng = np.random.default_rng(1)
    points, s = rng.uniform(-5, 5, (500, 3)), rng.uniform(-0.5, 0.5, (500, 1))
    logit, _ = logit_and_derivative(tensors_of(weights), points, base + s * slope)
    error = np.abs(logit - 8.0 * s[:, 0])
    assert np.sqrt(np.mean(error**2)) < 0.5
    # A logit of 0.2 is 2.5 cm.
    assert error[np.abs(s[:, 0]) < 0.05].mean() < 0.2


@pytest.fixture(scope="module")
def start() -> DepthStart:
    return DepthStart(load_decoders().middle, 0.32)


def grid_before_a_wall() -> FeatureGrid:
    grid = FeatureGrid("middle", 0.32, 0.01, 0, wp.get_device("cpu"))
    grid.cover(np.array([-1.0, -1.0, -0.5]), np.array([1.0, 1.0, 3.5]))
    return grid


def applied(start: DepthStart, grid: FeatureGrid, depth: np.ndarray, selected: np.ndarray) -> np.ndarray:
    """Which rows an application changed."""
    before = grid.features.numpy().copy()
    arrays = wp.array(depth.astype(np.float32), device="cpu"), wp.array(selected.astype(np.uint8), device="cpu")
    start.apply(grid, CAMERA, np.eye(4), *arrays)
    return (grid.features.numpy() != before).any(axis=1)


def test_vertices_start_by_their_distance(start):
    """In front of a wall and a little behind it each vertex in view gets the feature of its distance; no other one."""
    grid = grid_before_a_wall()
    selected = np.ones(grid.row_count, bool)
    selected[::3] = False
    changed = applied(start, grid, np.full((48, 64), WALL), selected)
    index = np.stack(np.meshgrid(*(np.arange(n) for n in grid.shape), indexing="ij"), -1).reshape(-1, 3)
    x, y, z = (0.32 * (grid.first + index)).T
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = np.rint(50.0 * x / z + 31.5), np.rint(50.0 * y / z + 23.5)
    seen = (z > 0) & (u >= 0) & (u < 64) & (v >= 0) & (v < 48) & (z - WALL <= REACH * 0.32)
    assert 0 < (seen & selected).sum() < seen.sum()
    np.testing.assert_array_equal(changed, seen & selected)
    np.testing.assert_array_equal(grid.seen.numpy() != 0, seen & selected)
    distance = np.clip(z - WALL, -TRUNCATION * 0.32, TRUNCATION * 0.32)
    expected = start.base + distance[:, None] * start.slope
    np.testing.assert_allclose(grid.features.numpy()[changed], expected[changed], rtol=1e-4, atol=1e-4)


def test_a_started_vertex_is_the_optimisers(start):
    """Neither another depth nor growth starts a vertex again, and one without depth waits."""
    grid = grid_before_a_wall()
    everything = np.ones(grid.row_count, bool)
    holes = np.full((48, 64), WALL)
    holes[:, :32] = 0.0
    first = applied(start, grid, holes, everything)
    second = applied(start, grid, np.full((48, 64), 2.5), everything)
    assert first.any() and second.any() and not (first & second).any()
    kept = grid.features.numpy()[grid.seen.numpy() != 0]
    grid.cover(np.array([-2.0, -1.0, -0.5]), np.array([1.0, 1.0, 4.0]))
    assert grid.seen.numpy().sum() == (first | second).sum()
    np.testing.assert_array_equal(grid.features.numpy()[grid.seen.numpy() != 0], kept)
    assert grid.features.dtype == Vec32
