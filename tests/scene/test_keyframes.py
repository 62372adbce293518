"""Keyframe images and overlap."""

import zlib

import numpy as np
import pytest
import warp as wp

from warpslam.camera import Intrinsics
from warpslam.errors import MapSizeError
from warpslam.scene.image_pool import CompactImage, ImagePool
from warpslam.scene.keyframes import overlap_fractions

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


def stored_depth(pool: ImagePool, slot: int) -> np.ndarray:
    """Depth of a slot as the kernels read it [m]."""
    return pool.depth[slot].numpy().astype(np.float32) * pool.scale.numpy()[slot]


def random_images(count: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Colour and depth without any structure, a fifth of it missing."""
    rng = np.random.default_rng(0)
    images = []
    for _ in range(count):
        depth = rng.uniform(0.5, 6.0, (120, 160)).astype(np.float32)
        depth[rng.random(depth.shape) < 0.2] = 0.0
        images.append((rng.integers(0, 256, (120, 160, 3)).astype(np.uint8), depth))
    return images


@pytest.mark.parametrize("slots", [3, 100])
def test_pool_gives_back_every_image(slots):
    """Whether all images fit on the device or only two beside the current one, each is brought back as it was; depth to
    1/131070 of its largest value, 0 stays 0.
    """
    pool = ImagePool(CAMERA, wp.get_device("cpu"), slots * 5 * 120 * 160 / 1e9, capacity=2)
    images = random_images(5)
    numbers = [pool.add(*image) for image in images]
    for pair in ((0, 1), (1, 2), (4, 3), (2, 2), (0, 4)):
        for n, slot in zip(pair, pool.bring([numbers[n] for n in pair]), strict=True):
            rgb, depth = images[n]
            assert slot > 0
            np.testing.assert_array_equal(pool.rgb.numpy()[slot], rgb)
            np.testing.assert_allclose(stored_depth(pool, slot), depth, atol=6.0 / 131070 * 1.01)
            assert (stored_depth(pool, slot)[depth == 0] == 0).all()
    assert pool.rgb.shape[0] <= slots


def test_pool_says_what_it_needs():
    """More images at a time than the budget has room for: what is needed, what there is, and the setting."""
    pool = ImagePool(CAMERA, wp.get_device("cpu"), 3.9 * 5 * 120 * 160 / 1e9)
    numbers = [pool.add(*image) for image in random_images(3)]
    with pytest.raises(MapSizeError, match="needs 4 images.*0.0004 GB.*max_gigabytes has room for 3"):
        pool.bring(numbers)


def test_compact_images_are_smaller_and_exact():
    """Smooth images shrink to less than a third; what does not hold an image is refused, whatever it inflates to."""
    v, u = np.mgrid[:120, :160]
    rgb = np.stack([u, v, u + v], -1).astype(np.uint8)
    image = CompactImage.of(rgb, (100 * v + u).astype(np.uint16), 0.001)
    assert len(image.rgb) + len(image.depth) < 5 * 120 * 160 / 3
    for back, original in zip(image.unpack(CAMERA), (rgb, 100 * v + u, 0.001), strict=True):
        np.testing.assert_array_equal(back, original)
    bomb = CompactImage(zlib.compress(bytes(10**7)), image.depth, 1.0)
    with pytest.raises(ValueError, match="compressed image"):
        bomb.unpack(CAMERA)
