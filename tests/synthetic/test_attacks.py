"""What is done to a sequence to lead a tracker astray, and that its truth stays true."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from warpslam.camera import Intrinsics, SensorTiming
from warpslam.errors import ConfigError, InputError
from warpslam.synthetic import ALTERATIONS, SyntheticSequence, altered
from warpslam.synthetic.attacks import (
    HAND_DISTANCE,
    auto_exposure,
    black_out,
    carry_lamp,
    cover_lens,
    drop_frames,
    freeze,
    half_depth,
    kinect_noise,
    stand_still,
    switch_light,
)

CAMERA = Intrinsics(60.0, 60.0, 39.5, 29.5, 80, 60)


@pytest.fixture(scope="module")
def base() -> SyntheticSequence:
    return SyntheticSequence(0, 130, intrinsics=CAMERA, device="cpu")


@pytest.mark.parametrize("name", ALTERATIONS)
def test_frames_poses_and_times(base, name):
    """Of each: the form of frames, truth that agrees frame by frame, ascending times, and the base left as it was."""
    before = base[64]
    sequence = altered(base, [name])
    truth = sequence.ground_truth()
    assert sequence.name.startswith(base.name + "+") and sequence.mesh is base.mesh
    assert len(sequence) == len(truth) == {"still": 300, "dropped": 30}.get(name, len(base))
    for index in (0, len(sequence) // 2, len(sequence) - 1):
        frame = sequence[index]
        assert frame.index == index and frame.rgb.dtype == np.uint8 and frame.depth.dtype == np.float32
        assert frame.rgb.shape == (60, 80, 3) and frame.depth.shape == (60, 80)
        assert frame.timestamp == sequence.timestamp(index)
        np.testing.assert_array_equal(frame.T_world_camera, truth[index])
        again = sequence[index]
        np.testing.assert_array_equal(again.rgb, frame.rgb)
        np.testing.assert_array_equal(again.depth, frame.depth)
    assert (np.diff([sequence.timestamp(index) for index in range(len(sequence))]) > 0).all()
    np.testing.assert_array_equal(base[64].rgb, before.rgb)
    np.testing.assert_array_equal(base[64].depth, before.depth)
    with pytest.raises(IndexError):
        sequence[len(sequence)]


def test_standing_camera(base):
    """The pose is one and the same, the noise is not."""
    sequence = stand_still(base, at=7, count=20)
    np.testing.assert_array_equal(sequence.ground_truth(), np.repeat(base.ground_truth()[7:8], 20, axis=0))
    difference = sequence[3].rgb.astype(float) - sequence[4].rgb
    assert 1.5 < difference.std() < 3.5 and np.abs(sequence[3].rgb.astype(float) - base[7].rgb).mean() < 3.0


def test_switched_light(base):
    """Half as bright while it is off, to the byte as before and after otherwise."""
    sequence = switch_light(base, at=50, off=10)
    assert sequence[50].rgb.mean() < 0.55 * base[50].rgb.mean()
    for index in (49, 60):
        np.testing.assert_array_equal(sequence[index].rgb, base[index].rgb)
    np.testing.assert_array_equal(sequence[55].depth, base[55].depth)


def test_exposure_drifts(base):
    """An image is a gain and a bias from its original, which change slowly."""
    sequence, gains = auto_exposure(base), []
    for index in range(0, 60, 2):
        x, y = base[index].rgb.ravel().astype(float), sequence[index].rgb.ravel()
        gain, bias = np.polyfit(x, y, 1)
        assert np.abs(gain * x + bias - y).max() < 1.0
        gains.append(gain)
    assert np.ptp(gains) > 0.15 and np.abs(np.diff(gains)).max() < 0.25 and 0.49 < min(gains) and max(gains) <= 1.01


def test_hand_before_the_lens(base):
    """Most of the image is a hand, near and in both images, which moves; around it the scene goes on."""
    sequence = cover_lens(base, at=40, count=5)
    frame, still = sequence[42], base[42]
    hand = np.abs(frame.depth - HAND_DISTANCE) < 0.05
    assert 0.7 < hand.mean() < 1.0
    np.testing.assert_array_equal(frame.rgb[~hand], still.rgb[~hand])
    assert frame.rgb[hand].mean(axis=0).argmax() == 0 and frame.rgb[hand].std() > 1
    assert not np.array_equal(sequence[43].depth, frame.depth)
    for index in (39, 45):
        np.testing.assert_array_equal(sequence[index].depth, base[index].depth)


def test_frozen_image(base):
    """The same image comes again and again while pose and time go on, and then the right one."""
    sequence = freeze(base, at=20, count=6)
    for index in range(20, 26):
        np.testing.assert_array_equal(sequence[index].rgb, base[20].rgb)
        np.testing.assert_array_equal(sequence[index].T_world_camera, base.ground_truth()[index])
        assert sequence[index].timestamp == base.timestamp(index)
    np.testing.assert_array_equal(sequence[26].rgb, base[26].rgb)
    np.testing.assert_array_equal(sequence.ground_truth(), base.ground_truth())


def test_dropped_frames(base):
    """Frames are gone, and the time between their neighbours tells."""
    sequence = drop_frames(base, at=10, count=100)
    assert len(sequence) == 30 and sequence.timestamp(10) - sequence.timestamp(9) == pytest.approx(101 / 30)
    np.testing.assert_array_equal(sequence[10].rgb, base[110].rgb)


def test_black_frames(base):
    """Colour is black for so many frames, depth as it was."""
    sequence = black_out(base, at=5, count=3)
    assert [bool(sequence[index].rgb.any()) for index in range(4, 9)] == [True, False, False, False, True]
    np.testing.assert_array_equal(sequence[6].depth, base[6].depth)


def test_lamp_on_the_camera(base):
    """Light goes by distance and by place in the image: the near is brighter than the far, the middle than the
    rim; nothing is brighter than it was, and half of the light is there everywhere.
    """
    sequence = carry_lamp(base, share=0.5)
    frame, whole = sequence[30], base[30]
    np.testing.assert_array_equal(frame.depth, whole.depth)
    seen = (whole.rgb.min(axis=2) > 40) & (whole.depth > 0)
    light = frame.rgb.mean(axis=2) / np.maximum(whole.rgb.mean(axis=2), 1.0)
    assert light[seen].min() > 0.47 and light[seen].max() < 1.02 and np.ptp(light[seen]) > 0.2
    v, u = np.mgrid[:60, :80]
    rings = (np.hypot(u - CAMERA.cx, v - CAMERA.cy) // 5).astype(int)
    ring = seen & (rings == 4)
    near = whole.depth < np.median(whole.depth[ring])
    assert light[ring & near].mean() > light[ring & ~near].mean() + 0.03
    even = carry_lamp(base, share=0.5, reach=1e6)[30].rgb.mean(axis=2) / np.maximum(whole.rgb.mean(axis=2), 1.0)
    by_ring = [even[seen & (rings == ring)].mean() for ring in range(8)]
    assert (np.diff(by_ring) < 0).all()


def test_half_of_the_depth(base):
    """Half of what was measured is missing, more of the far than of the near, in patches; what is left is exact."""
    sequence = half_depth(base)
    frame, whole = sequence[30], base[30]
    left = frame.depth > 0
    assert left.sum() == pytest.approx(0.5 * (whole.depth > 0).sum(), rel=0.02)
    np.testing.assert_array_equal(frame.depth[left], whole.depth[left])
    assert whole.depth[left].mean() < whole.depth[(whole.depth > 0) & ~left].mean()
    assert (left[:, 1:] != left[:, :-1]).mean() < 0.1  # patches, not salt and pepper


def test_kinect(base):
    """Depth errs by half a step of disparity and the noise, and holes come; colour errs a little."""
    frame, exact = kinect_noise(base)[30], base[30]
    both = (frame.depth > 0) & (exact.depth > 0)
    z, error = exact.depth[both], np.abs(frame.depth - exact.depth)[both]
    step = z**2 / (CAMERA.fx * 0.075) / 8
    assert (error < 0.7 * step + 5 * (0.0012 + 0.0019 * (z - 0.4) ** 2)).mean() > 0.99
    assert np.median(error / step) > 0.1 and both.mean() < (exact.depth > 0).mean()
    assert 0.5 < np.abs(frame.rgb.astype(float) - exact.rgb).mean() < 3.0


def test_times_of_the_sensors_are_those_of_the_base(base):
    """How far depth is from colour in time stays with the image that is shown, and the camera's timing with it."""

    class Stamped(SyntheticSequence):
        timing = SensorTiming(depth_delay=-0.02, readout=0.03)

        def __getitem__(self, index):
            frame = super().__getitem__(index)
            return replace(frame, depth_timestamp=frame.timestamp + 0.001 * (index + 1))

    stamped = Stamped(0, 20, intrinsics=CAMERA, device="cpu")
    frozen = freeze(stamped, at=5, count=4)
    assert frozen.timing == stamped.timing
    for index, shown in ((4, 4), (7, 5), (9, 9)):
        assert frozen[index].depth_timestamp == pytest.approx(stamped.timestamp(index) + 0.001 * (shown + 1))
    assert base[0].depth_timestamp is None and freeze(base)[0].depth_timestamp is None


def test_one_after_another(base):
    """Changes add up in the order of their names."""
    sequence = altered(base, ["frozen", "kinect"])
    assert sequence.name == f"{base.name}+frozen+kinect"
    # New noise on the same image.
    assert not np.array_equal(sequence[66].rgb, sequence[67].rgb)
    np.testing.assert_array_equal(sequence[70].T_world_camera, base.ground_truth()[70])


def test_errors(base):
    """An unknown name names the known ones; a sequence may be too short."""
    with pytest.raises(ConfigError, match="kinect, half, still"):
        altered(base, ["thunder"])
    with pytest.raises(InputError, match="130 frames"):
        freeze(base, at=125, count=10)
    with pytest.raises(InputError, match="130 frames"):
        drop_frames(base, count=200)
