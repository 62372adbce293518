"""Odometry by features alone, on a rendered room and on real frames."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from warpslam.evaluation.trajectory_errors import ate
from warpslam.sequences import open_sequence
from warpslam.tracking.features.detection import SensorTiming
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


def kinect_error(data_dir, frames, timing=None) -> float:
    """ATE RMSE [m] on the start of a real recording, of which no frame may be lost."""
    sequence = open_sequence(data_dir / "tum_fr1_xyz")
    odometry = FeatureOdometry(sequence.intrinsics, "cpu", timing=timing)
    poses, truth = [], []
    for n in frames:
        frame = sequence[n]
        depth = np.where(np.isfinite(frame.depth), frame.depth, 0.0).astype(np.float32)
        grey = cv2.cvtColor(np.ascontiguousarray(frame.rgb), cv2.COLOR_RGB2GRAY)
        step = odometry.step(grey, depth, frame.timestamp)
        assert step.is_ok
        poses.append(step.T_world_camera)
        truth.append(frame.T_world_camera)
    return ate(np.array(poses), np.array(truth)).rmse


def test_follows_a_kinect(data_dir):
    """The start of a real recording, to a centimetre."""
    assert kinect_error(data_dir, range(30)) < 0.01


@pytest.mark.slow
def test_follows_a_kinect_and_its_timing(data_dir):
    """Every second frame, and all; depth that is 30 ms old, and rows read over 26 ms, put right."""
    assert kinect_error(data_dir, range(0, 200, 2)) < 0.012
    plain = kinect_error(data_dir, range(200))
    timed = kinect_error(data_dir, range(200), SensorTiming(depth_delay=-0.03, readout=0.026))
    assert plain < 0.012 and timed < 0.9 * plain
