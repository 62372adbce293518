"""Conversions of poses, by the formulas written out."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from warpslam.poses import motion_between, pose_from_vector, rotation_angles, vector_from_pose
from warpslam.tracking.direct.joint_rows import is_elsewhere, is_far

COUNT = 1000


@pytest.fixture(scope="module")
def rotations() -> Rotation:
    """Random ones, and some by next to nothing or next to half a turn."""
    axes = np.random.default_rng(1).normal(size=(24, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    angles = np.concatenate([10.0 ** -np.arange(1, 13), np.pi - 10.0 ** -np.arange(1, 13)])
    special = Rotation.from_rotvec(axes * angles[:, None])
    return Rotation.concatenate([Rotation.random(COUNT, rng=np.random.default_rng(0)), special])


def matrix(q: np.ndarray) -> np.ndarray:
    """Rotation of a quaternion (w, x, y, z) of any length, by the formula."""
    w, x, y, z = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def test_conversions_agree_with_the_formula(rotations):
    """Matrix of a quaternion of any length, and back to the quaternion of length 1 with qw >= 0, to 1e-15."""
    lengths = np.random.default_rng(2).uniform(0.2, 5.0, len(rotations))
    for rotation, length in zip(rotations, lengths, strict=True):
        x, y, z, w = length * rotation.as_quat()
        T = pose_from_vector(np.array([w, x, y, z, 1.0, -2.0, 3.0]))
        np.testing.assert_allclose(T[:3, :3], matrix(np.array([w, x, y, z])), atol=1e-15)
        np.testing.assert_array_equal(T[:, 3], [1, -2, 3, 1])
        vector = vector_from_pose(T)
        assert vector[0] >= 0 and vector[4:].tolist() == [1, -2, 3]
        assert np.linalg.norm(vector[:4]) == pytest.approx(1.0, abs=1e-15)
        np.testing.assert_allclose(matrix(vector[:4]), T[:3, :3], atol=1e-15)


def test_angles_are_accurate(rotations):
    """Near nothing and near half a turn alike, against atan2 of sine and cosine."""
    R = rotations.as_matrix()
    axis = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1)
    expected = np.arctan2(np.linalg.norm(axis, axis=1), np.trace(R, axis1=1, axis2=2) - 1.0)
    angles = rotation_angles(R)
    np.testing.assert_allclose(angles, expected, rtol=1e-12, atol=1e-15)
    assert rotation_angles(R[5]) == pytest.approx(angles[5], rel=1e-15)


def test_poses_that_are_not_finite_are_far_apart():
    """NaN and infinity anywhere in one of the two, alone or in a stack; the others are what they were."""
    rng = np.random.default_rng(0)
    poses = np.array([pose_from_vector(rng.normal(size=7)) for _ in range(6)])
    usual = motion_between(poses[0], poses)
    for value in (np.nan, np.inf, -np.inf):
        for at in np.ndindex(4, 4):
            broken = poses.copy()
            broken[(2, *at)] = value
            assert (motion_between(broken[2], np.eye(4)) == np.inf).all()
            assert (motion_between(np.eye(4), broken[2]) == np.inf).all()
            motion = motion_between(poses[0], broken)
            assert (motion[2] == np.inf).all()
            np.testing.assert_array_equal(np.delete(motion, 2, 0), np.delete(usual, 2, 0))
            assert is_elsewhere(broken[2], poses[2]) and is_far(poses[2], broken[2])


def test_motion_between_poses():
    """Distance in metres and angle in degrees, also of a turn that the cosine can't tell from none."""
    for degrees in (1e-7, 1.0, 179.999):
        half = np.radians(degrees) / 2
        a = pose_from_vector(np.array([0.3, -0.5, 0.1, 0.8, 1.0, 2.0, 3.0]))
        b = a @ pose_from_vector(np.array([np.cos(half), 0, np.sin(half), 0, 0.0, 0.3, 0.4]))
        assert motion_between(a, b) == pytest.approx((0.5, degrees), rel=1e-6)
