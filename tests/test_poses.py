"""Poses against scipy's rotations, which are slower and do the same."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from warpslam.poses import motion_between, pose_from_vector, rotation_angles, vector_from_pose

COUNT = 1000


@pytest.fixture(scope="module")
def rotations() -> Rotation:
    """Random ones, and some by next to nothing or next to half a turn."""
    axes = np.random.default_rng(1).normal(size=(24, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    angles = np.concatenate([10.0 ** -np.arange(1, 13), np.pi - 10.0 ** -np.arange(1, 13)])
    special = Rotation.from_rotvec(axes * angles[:, None])
    return Rotation.concatenate([Rotation.random(COUNT, rng=np.random.default_rng(0)), special])


def test_conversions_agree_with_scipy(rotations):
    """Matrix of a quaternion of any length, and the quaternion with qw >= 0 of a matrix, to 1e-15."""
    lengths = np.random.default_rng(2).uniform(0.2, 5.0, len(rotations))
    for rotation, length in zip(rotations, lengths, strict=True):
        x, y, z, w = length * rotation.as_quat()
        T = pose_from_vector(np.array([w, x, y, z, 1.0, -2.0, 3.0]))
        np.testing.assert_allclose(T[:3, :3], rotation.as_matrix(), atol=1e-15)
        np.testing.assert_array_equal(T[:, 3], [1, -2, 3, 1])
        vector = vector_from_pose(T)
        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True)
        # Half a turn has two axes.
        sign = np.sign(vector[:4] @ [w, x, y, z]) if abs(w) < 1e-12 else 1.0
        np.testing.assert_allclose(vector[:4], sign * np.array([w, x, y, z]), atol=1e-15)
        assert vector[0] >= 0 and vector[4:].tolist() == [1, -2, 3]


def test_angles_agree_with_scipy(rotations):
    """One at a time or all at once, near nothing and near half a turn alike."""
    angles = rotation_angles(rotations.as_matrix())
    np.testing.assert_allclose(angles, rotations.magnitude(), rtol=1e-12, atol=1e-15)
    assert rotation_angles(rotations.as_matrix()[5]) == angles[5]


def test_motion_between_poses():
    """Distance in metres and angle in degrees, also of a turn that the cosine can't tell from none."""
    for degrees in (1e-7, 1.0, 179.999):
        half = np.radians(degrees) / 2
        a = pose_from_vector(np.array([0.3, -0.5, 0.1, 0.8, 1.0, 2.0, 3.0]))
        b = a @ pose_from_vector(np.array([np.cos(half), 0, np.sin(half), 0, 0.0, 0.3, 0.4]))
        assert motion_between(a, b) == pytest.approx((0.5, degrees), rel=1e-6)
