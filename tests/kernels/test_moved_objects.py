"""Rays of earlier frames that the current depth image contradicts."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from tests.kernels.drawn_pixels import pixels_of
from warpslam.camera import Intrinsics
from warpslam.field.ray_batch import RayBatch
from warpslam.poses import vector_from_pose
from warpslam.scene.image_pool import ImagePool

CAMERA = Intrinsics(80.0, 80.0, 79.5, 59.5, 160, 120)
RAYS = 4000
MARGIN = 0.1  # [m]
BOX = np.s_[30:90, 40:110]
WALL = np.full((CAMERA.height, CAMERA.width), 2.0, np.float32)


def kept(device, earlier: np.ndarray, current: np.ndarray, shift: float = 0.0):
    """Draw rays of an earlier frame and of the current one, whose camera is ``shift`` to the right [m].

    Returns: of the earlier frame's rays, which were kept (n,) and their pixels (2, n). No ray of the current one may be
    dropped.
    """
    pool = ImagePool(CAMERA, device)
    rgb = np.full((CAMERA.height, CAMERA.width, 3), 128, np.uint8)
    pool.set(0, rgb, current)
    assert pool.bring([pool.add(rgb, earlier)]) == [1]
    T = np.eye(4)
    T[0, 3] = shift
    poses = wp.array(np.stack([vector_from_pose(np.eye(4)), vector_from_pose(T)]), dtype=float, device=device)
    batch = RayBatch(2 * RAYS, 4, device)
    batch.set_seeds([3])
    batch.draw(pool.arrays, wp.array([1, 0], dtype=int, device=device), RAYS, CAMERA)
    batch.cast(poses)
    batch.bound_to(wp.vec3(-9.0, -9.0, -9.0), wp.vec3(9.0, 9.0, 9.0))
    batch.drop_contradicted(pool.arrays, 1, T, CAMERA, MARGIN)
    keep, frame = batch.keep.numpy() != 0, batch.frame.numpy()
    assert keep[frame == 1].all()
    return keep[frame == 0], np.stack(pixels_of(batch, CAMERA))[:, frame == 0]


def in_box(pixels: np.ndarray, border: int = 0) -> np.ndarray:
    """Which pixels (2, n) lie in `BOX`, ``border`` [px] wider or, negative, narrower."""
    u, v = pixels
    rows, columns = BOX
    return (
        (v >= rows.start - border) & (v < rows.stop + border)
        & (u >= columns.start - border) & (u < columns.stop + border)
    )  # fmt: skip


def with_box(depth: float) -> np.ndarray:
    """The wall with a box in front of it or a niche in it."""
    image = WALL.copy()
    image[BOX] = depth
    return image


@pytest.mark.parametrize("shift", [0.0, 0.15])
def test_what_stands_still_contradicts_nothing(device, shift):
    """A wall seen twice, also from elsewhere; and what a frame measured a little off, within the margin."""
    assert kept(device, WALL, WALL, shift)[0].all()
    assert kept(device, with_box(2.0 - 0.8 * MARGIN), WALL)[0].all()


def test_what_has_gone_is_left_out(device):
    """The current frame sees through what the earlier one measured: those rays go, but for its outline."""
    keep, pixels = kept(device, with_box(1.0), WALL)
    np.testing.assert_array_equal(keep, ~in_box(pixels))


def test_what_has_come_is_left_out(device):
    """Earlier rays through what stands there now go, but for those near its outline, where one can't tell."""
    keep, pixels = kept(device, WALL, with_box(1.0))
    np.testing.assert_array_equal(keep, ~in_box(pixels, -1))


def test_what_an_earlier_frame_saw_behind_a_surface_stays(device):
    """A camera 0.8 m to the right has a box at 1 m before part of the wall that the earlier frame saw past the box."""
    keep, pixels = kept(device, WALL, with_box(1.0), 0.8)
    at_wall, at_box = (np.stack([pixels[0] - 0.8 * CAMERA.fx / z, pixels[1]]) for z in (2.0, 1.0))
    hidden = in_box(at_wall, -3) & ~in_box(at_box, 8)
    assert hidden.sum() > 100
    assert keep[hidden].mean() > 0.9


def test_missing_depth_says_nothing(device):
    """Neither a hole in the current image nor one in the earlier one drops a ray."""
    assert kept(device, with_box(1.0), np.zeros_like(WALL))[0].all()
    assert kept(device, with_box(0.0), WALL)[0].all()
