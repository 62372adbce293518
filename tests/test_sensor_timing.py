"""SLAM with a camera whose depth is late and whose rows are read one after the other."""

from __future__ import annotations

import numpy as np
import pytest

from tests.kernels.swept_room import SweptRoom
from warpslam.camera import NO_MOTION, ONE_MOMENT, FrameMotion, Intrinsics, SensorTiming
from warpslam.config import Config
from warpslam.field.decoder_files import load_decoders
from warpslam.poses import motion_of
from warpslam.slam import Slam
from warpslam.trajectory import FrameHistory, Located

CAMERA = Intrinsics(50.0, 50.0, 31.5, 23.5, 64, 48)
TWIST = (0.3, -0.2, 0.2, 0.2, -0.4, 0.2)
RATE = 15.0
TIMING = SensorTiming(-0.02, 0.03)
SETTINGS = [
    "tracking.optimizer=gauss_newton",
    "tracking.pixels=64", "tracking.iterations=4", "tracking.ignore_edge_u=4", "tracking.ignore_edge_v=4",
    "mapping.pixels=100", "mapping.every=2", "mapping.first_iterations=20", "mapping.iterations=6",
    "mapping.coarse_iterations=1", "mapping.bundle_adjustment=false", "keyframes.every=2", "tracking.lost_inliers=0",
    "tracking.lost_depth_error=10",
]  # fmt: skip


def take(index: int, timing: SensorTiming = TIMING):
    """Frame of a camera that moves with `TWIST`: colour, depth, time and pose."""
    pose = motion_of(np.array(TWIST) * index / RATE)
    motion = FrameMotion(TWIST, timing.depth_delay, timing.readout)
    return *SweptRoom().take(CAMERA, pose, motion), index / RATE, pose


def run(count: int, *overrides: str, timing: SensorTiming = TIMING, given: bool = True) -> Slam:
    settings = [*SETTINGS, f"tracking.use_given_poses={str(given).lower()}", *overrides]
    slam = Slam(CAMERA, Config.from_preset("default", settings), "cpu", decoders=load_decoders(), timing=timing)
    for index in range(count):
        rgb, depth, time, pose = take(index)
        slam.step(rgb, depth, time, pose if given or index == 0 else None)
    return slam


def test_what_is_mapped_is_what_a_camera_at_the_pose_would_have_seen():
    """With known poses the current image and the kept ones, once a frame came after each, are free of smear."""
    slam = run(5)
    _, depth, _, _ = take(4, ONE_MOMENT)
    inner = np.s_[4:-4, 4:-4]
    assert np.abs(slam.images.current_depth() - depth)[inner].max() < 0.01
    assert [keyframe.index for keyframe in slam.keyframes] == [0, 2, 4]
    for keyframe in slam.keyframes:
        np.testing.assert_allclose(keyframe.motion.twist, TWIST, atol=1e-9)
        assert (keyframe.motion.depth_offset, keyframe.motion.readout) == (-0.02, 0.03)
        rgb, depth, _, _ = take(keyframe.index, ONE_MOMENT)
        raw_rgb, raw_depth, _, _ = take(keyframe.index)
        (slot,) = slam.images.bring([keyframe.image], [keyframe.motion])
        seen = slam.images.depth.numpy()[slot] * slam.images.scale.numpy()[slot]
        assert np.abs(seen - depth)[inner].mean() < 0.1 * np.abs(raw_depth - depth)[inner].mean()
        seen_rgb = slam.images.rgb.numpy()[slot].astype(int)
        assert np.abs(seen_rgb - rgb)[inner].mean() < 0.5 * np.abs(raw_rgb.astype(int) - rgb)[inner].mean()
    # What the mesher is told of is the same.
    _, depth, _, _ = take(2, ONE_MOMENT)
    seen = {one.index: one.millimetres for one in slam._seen}[2]
    assert np.abs(seen[2:-2, 2:-2] / 1000.0 - depth[::4, ::4][2:-2, 2:-2]).max() < 0.01


def test_stamps_of_depth_come_on_top_of_the_delay():
    """tau is the difference of the stamps plus the constant, frame by frame."""
    slam = run(2)
    rgb, depth, time, pose = take(2)
    slam.step(rgb, depth, time, pose, depth_timestamp=time - 0.011)
    assert slam.images.motion.depth_offset == pytest.approx(-0.031)


@pytest.mark.parametrize("timing", [TIMING, ONE_MOMENT])
def test_switched_off_or_unknown_changes_no_byte(timing):
    """With the setting off, or a camera that tells of nothing, poses and map are those of a run that knows nothing."""
    off = ["sensor_timing=false"] if timing == TIMING else []
    slam, plain = run(4, *off, timing=timing, given=False), run(4, timing=ONE_MOMENT, given=False)
    assert slam.images.motion.is_none and all(keyframe.motion.is_none for keyframe in slam.keyframes)
    np.testing.assert_array_equal(slam.trajectory.poses, plain.trajectory.poses)
    for level, grid in plain.scene.grids.items():
        np.testing.assert_array_equal(slam.scene.grids[level].state().features, grid.state().features)


def test_saved_state_goes_on_exactly(tmp_path):
    """Motions of the current frame and of keyframes are part of what is saved."""
    whole = run(6, given=False)
    run(3, given=False).save(tmp_path / "map.safetensors")
    loaded = Slam.load(tmp_path / "map.safetensors", "cpu")
    assert loaded.timing == TIMING
    other = SensorTiming(0.01, 0.0)
    assert Slam.load(tmp_path / "map.safetensors", "cpu", timing=other).timing == other
    half = run(3, given=False)
    for ours, theirs in zip(loaded.images.arrays, half.images.arrays, strict=True):
        np.testing.assert_array_equal(ours.numpy()[0], theirs.numpy()[0])
    for index in range(3, 6):
        rgb, depth, time, _ = take(index)
        loaded.step(rgb, depth, time)
    np.testing.assert_array_equal(loaded.trajectory.poses, whole.trajectory.poses)
    assert [keyframe.motion for keyframe in loaded.keyframes] == [keyframe.motion for keyframe in whole.keyframes]


def test_overlapped_schedule_maps_the_rectified_image():
    """The mapper beside the tracker sees what the tracker's slot 0 held; the run ends with the same keyframes."""
    slam = run(5, "schedule=overlapped")
    slam.wait()
    assert all(keyframe.motion.twist == pytest.approx(TWIST) for keyframe in slam.keyframes)
    assert slam.trajectory.status == ["OK"] * 5


def test_twist_of_a_history():
    """Over two steps and the true times; one step where there is no more; none where the camera was lost or is new."""
    history = FrameHistory()
    assert not history.twist().any()
    for time in (0.0, 0.05, 0.2):
        history.add(time, Located(motion_of(np.array(TWIST) * time)))
        if len(history) == 1:
            assert not history.twist().any()
        else:
            np.testing.assert_allclose(history.twist(), TWIST, atol=1e-12)
    history.correct(1, np.eye(4))
    np.testing.assert_allclose(history.twist(), TWIST, atol=1e-12)
    assert not np.allclose(history.twist(1), TWIST, atol=0.05)
    history.add(0.3, Located(np.eye(4), why_lost="nothing is seen"))
    assert not history.twist().any()
    history.add(0.4, Located(motion_of(np.array(TWIST) * 0.4)))
    assert not history.twist().any()
    assert NO_MOTION.is_none and FrameMotion(TWIST).is_none and not FrameMotion(TWIST, 0.0, 0.01).is_none
