"""What a frame tells about its place where depth leaves directions open."""

import math

import numpy as np
import pytest

from tests.tracking.direct.conftest import CAMERA
from warpslam.tracking.direct.aliases import difference_elsewhere

WEIGHTS = (2.0, 1.0)


def difference(bench, grey: np.ndarray, depth: np.ndarray) -> float:
    rgb = np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[..., None], 3, axis=2)
    bench.pool.set(0, rgb, depth.astype(np.float32))
    images, units, scale = bench.pool.arrays
    bench.registrar.load(0, images[0], units[0], scale[:1])
    return difference_elsewhere(bench.registrar, 0, 0, WEIGHTS, 0.1)


@pytest.fixture
def wall():
    """Depth of a wall in front of the camera."""
    return np.full((CAMERA.height, CAMERA.width), 1.2)


def pictures() -> np.ndarray:
    """Grey values of which no part is like another."""
    draws = np.random.default_rng(3).uniform(40, 220, (16, 20))
    return np.kron(draws, np.ones((CAMERA.height // 15, CAMERA.width // 20)))[: CAMERA.height, : CAMERA.width]


def tiles() -> np.ndarray:
    """Joints between equal tiles, 64 pixels (29 cm) apart."""
    grey = np.full((CAMERA.height, CAMERA.width), 170.0)
    for k in (30, 31):
        grey[k::64], grey[:, k::64] = 90.0, 90.0
    return grey


def test_equal_tiles_tell_less_than_pictures(bench, wall):
    assert difference(bench, tiles(), wall) < 0.4
    assert difference(bench, pictures(), wall) > 0.9


def test_depth_that_holds_the_camera_needs_no_pictures(bench, wall):
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    wall[:, u[0] > CAMERA.width // 2] += 0.004 * (u[0][u[0] > CAMERA.width // 2] - CAMERA.width // 2)
    wall[v[:, 0] > 2 * CAMERA.height // 3] -= 0.004 * (v[:, 0][v[:, 0] > 2 * CAMERA.height // 3] - 160)[:, None]
    assert difference(bench, tiles(), wall) == math.inf
