"""The sequence with lost frames: which are lost, and where the camera comes back."""

from __future__ import annotations

import numpy as np
import pytest

from warpslam.camera import Intrinsics
from warpslam.errors import InputError
from warpslam.synthetic import GapSequence
from warpslam.synthetic.gap import there_and_back

CAMERA = Intrinsics(50.0, 50.0, 31.5, 23.5, 64, 48)


@pytest.fixture(scope="module")
def black() -> GapSequence:
    return GapSequence(1, 220, intrinsics=CAMERA)


@pytest.fixture(scope="module")
def absent() -> GapSequence:
    return GapSequence(1, 220, intrinsics=CAMERA, kind="absent")


def test_lost_frames_are_black_and_keep_their_pose(black):
    """The 100 frames of the gap show nothing; their pose and time are known, and the others are whole."""
    assert len(black) == 220 and black.gap == range(60, 160)
    assert np.flatnonzero(black.is_lost).tolist() == list(black.gap)
    for index in (60, 110, 159):
        frame = black[index]
        assert not frame.rgb.any() and not frame.depth.any()
        assert np.isfinite(frame.T_world_camera).all() and frame.timestamp == pytest.approx(index / 30)
    for index in (59, 160):
        assert (black[index].depth > 0).mean() > 0.99


def test_absent_frames_leave_a_hole_in_time(black, absent):
    """Without the lost frames the others are the same, with the same times and consecutive numbers."""
    assert len(absent) == 120 and not absent.is_lost.any()
    assert absent[60].timestamp - absent[59].timestamp == pytest.approx(101 / 30)
    for here, there in ((59, 59), (60, 160), (119, 219)):
        a, b = absent[here], black[there]
        assert a.index == here and a.timestamp == b.timestamp
        np.testing.assert_array_equal(a.depth, b.depth)
        np.testing.assert_array_equal(a.T_world_camera, b.T_world_camera)


@pytest.mark.parametrize("seed", range(4))
def test_the_camera_comes_back_elsewhere_on_known_ground(seed):
    """After the gap it is far from where it was lost, and near a place, and a direction of view, of before."""
    poses = GapSequence(seed, 220, intrinsics=CAMERA, path_seed=seed).ground_truth()
    before, after = poses[:60], poses[160]
    assert np.linalg.norm(after[:3, 3] - before[-1, :3, 3]) > 0.25
    nearest = np.argmin(np.linalg.norm(before[:, :3, 3] - after[:3, 3], axis=1))
    assert np.linalg.norm(before[nearest, :3, 3] - after[:3, 3]) < 0.1
    assert before[nearest, :3, 2] @ after[:3, 2] > np.cos(np.radians(6.0))
    # All through the gap it moves like a hand-held camera.
    assert np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).max() < 0.02


def test_progress_turns_round_in_the_first_half_of_the_gap():
    """One frame's way a frame before the gap, back to its start at half time, and one frame's way back from there."""
    progress = there_and_back(220, range(60, 160))
    np.testing.assert_allclose(np.diff(progress)[:60], 1.0)
    np.testing.assert_allclose(np.diff(progress)[110:], -1.0)
    assert progress[110] == pytest.approx(60.0, abs=1e-9)
    assert progress[160] == pytest.approx(10.0, abs=1e-9)


@pytest.mark.parametrize("options", [{"gap_start": 0}, {"gap_length": 0}, {"gap_start": 130}])
def test_a_gap_needs_frames_on_both_sides(options):
    """Otherwise there is nothing to come back to, or no coming back."""
    with pytest.raises(InputError, match="gap"):
        GapSequence(0, 220, **options)


def test_unknown_kind():
    """The message lists the kinds."""
    with pytest.raises(InputError, match="absent, black"):
        GapSequence(0, 220, kind="white")
