"""Rectification against rays cast row by row: what a moving camera took becomes what it would have taken at once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from tests.kernels.swept_room import SweptRoom
from warpslam.camera import NO_MOTION, FrameMotion, Intrinsics
from warpslam.poses import motion_of
from warpslam.scene.image_pool import ImagePool
from warpslam.scene.rectification import Rectifier

CAMERA = Intrinsics(190.0, 190.0, 119.5, 89.5, 240, 180)
POSE = motion_of(np.array([0.1, -0.1, -0.4, 0.25, 0.3, -0.1]))
MOTION = FrameMotion((0.35, -0.2, 0.3, 0.5, -0.7, 0.4), -0.025, 0.03)
INNER = np.s_[12:-12, 12:-12]


def rectified(device, images, motion) -> tuple[np.ndarray, np.ndarray]:
    """Colour as int (H, W, 3) and depth [m] (H, W) that slot 0 holds."""
    pool = ImagePool(CAMERA, device)
    pool.set(0, *images)
    pool.rectify_current(motion)
    return pool.rgb.numpy()[0].astype(int), pool.current_depth()


def errors(device, room, motion, told) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors of depth [m] and colour inside the image, and which of these pixels have depth."""
    true_rgb, true_depth = room.take(CAMERA, POSE, NO_MOTION)
    rgb, depth = rectified(device, room.take(CAMERA, POSE, motion), told)
    known = depth[INNER] > 0
    return np.abs(depth - true_depth)[INNER], np.abs(rgb - true_rgb.astype(int))[INNER], known


@pytest.mark.parametrize(
    "motion",
    [
        replace(MOTION, readout=0.0),
        replace(MOTION, depth_offset=0.0),
        MOTION,
        replace(MOTION, depth_offset=0.04),
        FrameMotion((0.8, 0.0, 0.0, 0.0, 0.0, 0.0), -0.03, 0.03),
        FrameMotion((0.0, 0.0, 0.0, 0.0, 0.0, 2.0), -0.03, 0.03),
    ],
)
def test_moving_camera_sees_the_room_as_one_that_stands_still(device, motion):
    """Depth and colour of walls are those of the pose at the middle row; unrectified they are far off."""
    depth_error, rgb_error, known = errors(device, SweptRoom(), motion, motion)
    raw_depth, raw_rgb, _ = errors(device, SweptRoom(), motion, NO_MOTION)
    assert known.mean() > 0.995
    depth_error = depth_error[known]
    assert np.percentile(depth_error, 99) < 0.002 and depth_error.max() < 0.02
    assert depth_error.mean() < 0.1 * raw_depth.mean()
    assert np.percentile(rgb_error, 99.9) <= 4
    if motion.readout:
        assert rgb_error.mean() < 0.3 * raw_rgb.mean()


def test_wrong_sign_is_worse_than_nothing(device):
    """The twist turned round: the test above can tell directions apart."""
    wrong = MOTION.with_twist(-np.array(MOTION.twist))
    there, _, _ = errors(device, SweptRoom(), MOTION, wrong)
    nothing, _, _ = errors(device, SweptRoom(), MOTION, NO_MOTION)
    assert there.mean() > 1.5 * nothing.mean()


def test_outlines_are_not_mixed(device):
    """Before a column every depth is that of the column, whose side is seen at a grazing angle, or of the wall a metre
    behind it; none lies between them. Where the outline hides what should be seen there is none.
    """
    room = SweptRoom(pillar=0.15)
    _, true_depth = room.take(CAMERA, POSE, NO_MOTION)
    _, depth = rectified(device, room.take(CAMERA, POSE, MOTION), MOTION)
    known = (depth > 0)[INNER]
    # The nearest true depth among the pixel and its neighbours: outlines may be a pixel off.
    shifts = [np.roll(true_depth, (a, b), (0, 1)) for a in (-1, 0, 1) for b in (-1, 0, 1)]
    error = np.min(np.abs(np.array(shifts) - depth), axis=0)[INNER][known]
    assert 0.95 < known.mean() < 1.0
    assert (error < 0.02).mean() > 0.998 and error.max() < 0.3
    assert np.abs(np.diff(true_depth, axis=1)).max() > 1.0


def test_missing_depth_stays_missing_and_takes_its_colour_by_rotation(device):
    """Where nothing was measured there is no depth, and colour is that of a turn alone."""
    turn = FrameMotion((0.0, 0.0, 0.0, 0.6, -0.8, 0.3), -0.02, 0.03)
    rgb, depth = SweptRoom().take(CAMERA, POSE, turn)
    true_rgb, _ = SweptRoom().take(CAMERA, POSE, NO_MOTION)
    depth[60:120, 80:160] = 0.0
    new_rgb, new_depth = rectified(device, (rgb, depth), turn)
    assert (new_depth[70:110, 90:150] == 0).all() and (new_depth[:50, 12:-12] > 0).mean() > 0.9
    assert np.percentile(np.abs(new_rgb - true_rgb.astype(int))[INNER], 99.9) <= 4


@pytest.mark.parametrize("motion", [NO_MOTION, MOTION.with_twist(np.zeros(6)), FrameMotion(MOTION.twist)])
def test_nothing_to_correct_changes_no_byte(device, motion):
    """No twist, or neither delay nor readout: the images stay what they are."""
    rng = np.random.default_rng(0)
    size = (CAMERA.height, CAMERA.width)
    images = rng.integers(0, 256, (*size, 3)).astype(np.uint8), rng.uniform(0, 5, size).astype(np.float32)
    pool = ImagePool(CAMERA, device)
    pool.set(0, *images)
    before = [array.numpy().copy() for array in pool.arrays]
    pool.rectify_current(motion)
    for array, was in zip(pool.arrays, before, strict=True):
        np.testing.assert_array_equal(array.numpy(), was)


def test_the_kernel_alone_is_exact_at_rest(device):
    """Even if it is run, it gives back every colour, and depth to the new unit."""
    rgb, depth = SweptRoom(pillar=0.15).take(CAMERA, POSE, NO_MOTION)
    rectifier = Rectifier(CAMERA, device)
    raw, new = rectifier.new_image(), rectifier.new_image()
    raw[0].assign(rgb[None])
    raw[1].assign(np.rint(depth / 1e-4).astype(np.uint16)[None])
    raw[2].assign(np.array([1e-4], np.float32))
    rectifier.rectify(raw, FrameMotion(MOTION.twist), new)
    np.testing.assert_array_equal(new[0].numpy()[0], rgb)
    np.testing.assert_allclose(new[1].numpy()[0] * new[2].numpy()[0], depth, atol=3e-4)
    assert new[2].numpy()[0] == pytest.approx(1.25e-4)


def test_what_was_farthest_may_be_farther(device):
    """A flat wall that the camera leaves: all of it is farther than the farthest that was measured."""
    size = (CAMERA.height, CAMERA.width)
    images = np.full((*size, 3), 90, np.uint8), np.full(size, 1.0, np.float32)
    _, depth = rectified(device, images, FrameMotion((0.0, 0.0, -1.0, 0.0, 0.0, 0.0), -0.05, 0.0))
    np.testing.assert_allclose(depth[INNER], 1.05, atol=1e-4)


def test_pool_rectifies_again_when_the_motion_changes(device):
    """From the image as it was taken, in slot 0 and in the others; both hold the same for the same motion."""
    images = SweptRoom().take(CAMERA, POSE, MOTION)
    pool = ImagePool(CAMERA, device)
    pool.set(0, *images)
    raw = [array[:1].numpy().copy() for array in pool.arrays]
    other = MOTION.with_twist(0.5 * np.array(MOTION.twist))
    image = pool.keep_current()  # taken as it is
    pool.rectify_current(other)
    pool.rectify_current(MOTION)
    current = [array[0].numpy() if array.ndim > 1 else array.numpy()[0] for array in pool.arrays]
    kept = pool.keep_current()
    for number in (image, kept):
        for motion in (other, MOTION):
            (slot,) = pool.bring([number], [motion])
            same = np.array_equal(pool.depth.numpy()[slot], current[1])
            assert same == (motion == MOTION)
        np.testing.assert_array_equal(pool.rgb.numpy()[slot], current[0])
        assert pool.scale.numpy()[slot] == current[2]
    np.testing.assert_array_equal(pool.current()[0], images[0])
    (slot,) = pool.bring([kept])
    for array, was in zip(pool.arrays, raw, strict=True):
        np.testing.assert_array_equal(array.numpy()[slot], was[0])
    pool.rectify_current(NO_MOTION)
    for array, was in zip(pool.arrays, raw, strict=True):
        np.testing.assert_array_equal(array.numpy()[0], was[0])


def test_a_copy_of_the_pool_holds_the_rectified_image(device):
    """What a mapper beside the tracker sees: the slot, the motion, and the image as it was taken."""
    images = SweptRoom().take(CAMERA, POSE, MOTION)
    pool = ImagePool(CAMERA, device)
    pool.set(0, *images)
    pool.rectify_current(MOTION)
    beside = pool.fork()
    beside.copy_current(pool)
    pool.set(0, *SweptRoom().take(CAMERA, np.eye(4), NO_MOTION))
    assert beside.motion == MOTION and pool.motion == NO_MOTION
    _, expected = rectified(device, images, MOTION)
    np.testing.assert_array_equal(beside.current_depth(), expected)
    np.testing.assert_array_equal(beside.current()[0], images[0])
    wp.synchronize_device(device)
