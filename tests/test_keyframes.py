"""Keyframe images and overlap."""

import numpy as np
import pytest
import warp as wp

from warpslam.camera import Intrinsics
from warpslam.keyframes import ImagePool, overlap_fractions

CAMERA = Intrinsics(100.0, 100.0, 79.5, 59.5, 160, 120)


def turned(degrees: float) -> np.ndarray:
    """A camera at the origin turned about its vertical axis."""
    a = np.radians(degrees)
    T = np.eye(4)
    T[:3, :3] = [[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]]
    return T


def test_overlap_falls_with_the_angle():
    """The same view overlaps most (all but the border), a view turned by 50 degrees less, the opposite view not at
    all.
    """
    depth = np.full((120, 160), 2.0, np.float32)
    poses = [turned(0), turned(50), turned(180)]
    same, some, none = overlap_fractions(depth, np.eye(4), poses, CAMERA, np.random.default_rng(0))
    # The border of 20 px leaves (120 x 80) / (160 x 120) = 1/2 of the pixels.
    assert same == pytest.approx(0.5, abs=0.12)
    assert 0 < some < same
    assert none == 0


def test_pool_keeps_images_when_it_grows():
    """Every slot reads back after the pool was enlarged twice; depth to 1/131070 of its largest value, 0 stays 0."""
    pool = ImagePool(CAMERA, wp.get_device("cpu"), capacity=2)
    rng = np.random.default_rng(0)
    stored = []
    for _ in range(5):
        rgb = rng.integers(0, 256, (120, 160, 3)).astype(np.uint8)
        depth = rng.uniform(0.5, 6.0, (120, 160)).astype(np.float32)
        depth[rng.random(depth.shape) < 0.2] = 0.0
        stored.append((pool.add(rgb, depth), rgb, depth))
    for slot, rgb, depth in stored:
        np.testing.assert_array_equal(pool.rgb.numpy()[slot], rgb)
        np.testing.assert_allclose(pool.depth_image(slot), depth, atol=6.0 / 131070 * 1.01)
        assert (pool.depth_image(slot)[depth == 0] == 0).all()
