"""Odometry by features alone, on a rendered room and on real frames."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from warpslam.evaluation.trajectory_errors import ate
from warpslam.sequences import open_sequence
from warpslam.tracking.features.odometry import FeatureOdometry


def test_follows_a_walk_through_a_room(room, grey):
    """Within a pixel (13 mm at the walls), with none lost, and the same twice to the byte."""
    sequence, frames = room
    runs = []
    for _ in range(2):
        odometry = FeatureOdometry(sequence.intrinsics, "cpu")
        steps = [odometry.step(grey(frame), frame.depth) for frame in frames]
        assert all(step.is_ok for step in steps)
        runs.append(np.array([step.T_world_camera for step in steps]))
    truth = np.array([frame.T_world_camera for frame in frames])
    assert ate(runs[0], truth).rmse < 0.013
    assert runs[0].tobytes() == runs[1].tobytes()


def test_a_covered_lens_is_lost_and_then_found_again(room, grey):
    """A black frame has no pose; the next one is located against the frame before it."""
    sequence, frames = room
    odometry = FeatureOdometry(sequence.intrinsics, "cpu")
    for frame in frames[:4]:
        odometry.step(grey(frame), frame.depth)
    dark = odometry.step(np.zeros_like(grey(frames[4])), frames[4].depth)
    assert not dark.is_ok and dark.witness is None
    after = odometry.step(grey(frames[5]), frames[5].depth)
    expected = np.linalg.inv(frames[0].T_world_camera) @ frames[5].T_world_camera
    assert after.is_ok and np.linalg.norm(after.T_world_camera[:3, 3] - expected[:3, 3]) < 0.02


@pytest.mark.parametrize(
    ("frames", "limit"), [(range(30), 0.01), pytest.param(range(200), 0.012, marks=pytest.mark.slow)], ids=["30", "200"]
)
def test_follows_a_kinect(data_dir, frames, limit):
    """The start of a real recording, and all of it."""
    sequence = open_sequence(data_dir / "tum_fr1_xyz")
    odometry = FeatureOdometry(sequence.intrinsics, "cpu")
    poses, truth = [], []
    for n in frames:
        frame = sequence[n]
        depth = np.where(np.isfinite(frame.depth), frame.depth, 0.0).astype(np.float32)
        step = odometry.step(cv2.cvtColor(np.ascontiguousarray(frame.rgb), cv2.COLOR_RGB2GRAY), depth)
        assert step.is_ok
        poses.append(step.T_world_camera)
        truth.append(frame.T_world_camera)
    assert ate(np.array(poses), np.array(truth)).rmse < limit
