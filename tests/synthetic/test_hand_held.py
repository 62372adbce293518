"""The path of a camera in the hand."""

from __future__ import annotations

import numpy as np
import pytest

from warpslam.errors import InputError
from warpslam.poses import check_transform
from warpslam.synthetic import hand_held
from warpslam.synthetic.hand_held import steps, turns

WAY = np.array([[0.0, 0.0], [3.0, 0.5], [6.0, -1.0], [9.0, 1.0], [6.0, 3.0], [2.0, 3.0]])


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_pace_and_limits(seed):
    """8 cm and 4 degrees a frame on average, at most 25 cm and 17 degrees, with pauses and quick turns."""
    poses = hand_held(WAY, seed=seed)
    moved, turned = steps(poses), turns(poses)
    assert moved.mean() == pytest.approx(0.08, rel=0.1) and turned.mean() == pytest.approx(4.0, rel=0.1)
    assert 0.15 < moved.max() <= 0.25 and 11.0 < turned.max() <= 17.0
    assert (moved < 0.02).any()


def test_from_the_first_point_to_the_last():
    """Every pose is a rigid transform near the way, at the height of a hand; a shorter path is its beginning."""
    poses = hand_held(WAY, seed=3, eye_height=1.4)
    for pose in poses:
        check_transform(pose)
    np.testing.assert_allclose(poses[[0, -1], :2, 3], WAY[[0, -1]], atol=0.15)
    assert np.abs(poses[:, 2, 3] - 1.4).max() < 0.03
    np.testing.assert_array_equal(hand_held(WAY, seed=3, eye_height=1.4, max_frames=20), poses[:20])
    # Looks ahead and a little down: optical axis along the way at the start, image's y downwards.
    ahead = np.einsum("ni,ni->n", poses[:-1, :2, 2], np.diff(poses[:, :2, 3], axis=0))
    assert np.median(ahead) > 0 and (poses[:, 2, 1] < 0).all() and np.median(poses[:, 2, 2]) < 0


def test_seeds_differ():
    """Another seed is another walk along the same way."""
    first, second = (hand_held(WAY, seed=seed) for seed in (0, 1))
    assert not np.allclose(first[10], second[10])


@pytest.mark.parametrize("way", [[[0.0, 0.0]], [[0.0, 0.0], [0.0, 0.0]]])
def test_no_way(way):
    """One point, or the same one twice, is no way."""
    with pytest.raises(InputError, match="two waypoints"):
        hand_held(np.array(way))
