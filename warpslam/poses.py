"""Camera poses: rigid transforms (4, 4), and the vectors that the optimiser moves.

A pose ``T_world_camera`` maps camera points to world points [m]. A pose vector is (qw, qx, qy, qz, tx, ty, tz).
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from warpslam.errors import InputError

MAX_DISTANCE = 1e4
"""Nothing lies farther from the origin, on any axis [m]: beyond it float32 can't tell two millimetres apart."""


def check_transform(T: np.ndarray, name: str = "T_world_camera", *, unknown_is_nan: bool = False) -> np.ndarray:
    """Return ``T`` as a float64 (4, 4) rigid transform or raise `InputError`; `is_near` tells whether it is near.

    unknown_is_nan: A matrix that is not finite stands for an unknown pose and is returned as it is.
    """
    T = as_numbers(T, name)
    if T.shape != (4, 4):
        raise InputError(f"{name} has shape {T.shape}, expected (4, 4)")
    if not np.isfinite(T).all():
        if unknown_is_nan:
            return T
        raise InputError(f"{name} holds NaN or infinity")
    R = T[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-2 or np.linalg.det(R) < 0:
        raise InputError(f"{name} has no rotation in its upper left 3x3 block (not orthonormal, or a reflection)")
    if np.abs(T[3] - [0.0, 0.0, 0.0, 1.0]).max() > 1e-6:
        raise InputError(f"{name} has {T[3].tolist()} as its last row, expected 0 0 0 1: is it transposed?")
    return T


def as_numbers(values: Any, name: str) -> np.ndarray:
    """An array of real numbers, float64, of what NumPy, torch or Warp hold; or raise `InputError`."""
    try:
        if hasattr(values, "detach"):  # a tensor that is part of a gradient, or on a GPU
            values = values.detach().cpu().numpy()
        elif hasattr(values, "numpy"):
            values = values.numpy()
        array = np.asarray(values)
        if np.iscomplexobj(array):
            raise TypeError("complex numbers")
        return array.astype(np.float64, copy=False)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise InputError(f"{name} is no matrix of numbers ({error})") from error


def is_near(T: np.ndarray) -> bool:
    """Whether the translation of a transform (4, 4), or of all of a stack (N, 4, 4), is within `MAX_DISTANCE`."""
    return bool((np.abs(T[..., :3, 3]) <= MAX_DISTANCE).all())  # NaN is not


def are_rigid(T: np.ndarray) -> bool:
    """Whether all of a stack (N, 4, 4) are finite rigid transforms within `MAX_DISTANCE`."""
    if not (np.isfinite(T).all() and is_near(T)):
        return False
    R = T[:, :3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        is_rotation = np.abs(R @ R.swapaxes(1, 2) - np.eye(3)).max(initial=0.0) <= 1e-2 and (np.linalg.det(R) > 0).all()
    return bool(is_rotation and (np.abs(T[:, 3] - [0.0, 0.0, 0.0, 1.0]) <= 1e-6).all())


def orthonormalized(T: np.ndarray) -> np.ndarray:
    """A rigid transform (4, 4), float64, whose rotation is one to the last digits."""
    return pose_from_vector(vector_from_pose(T))


def vector_from_pose(T: np.ndarray) -> np.ndarray:
    """Pose vector (qw, qx, qy, qz, tx, ty, tz), float64, of a (4, 4) transform; the quaternion has unit length and
    qw >= 0.
    """
    T = np.asarray(T, dtype=np.float64)
    quaternion = _rotation().from_matrix(T[:3, :3]).as_quat(canonical=True, scalar_first=True)
    return np.concatenate([quaternion, T[:3, 3]])


def pose_from_vector(vector: np.ndarray) -> np.ndarray:
    """Transform (4, 4), float64, of a pose vector (qw, qx, qy, qz, tx, ty, tz); the quaternion may have any length."""
    vector = np.asarray(vector, dtype=np.float64)
    T = np.eye(4)
    T[:3, :3] = _rotation().from_quat(vector[:4], scalar_first=True).as_matrix()
    T[:3, 3] = vector[4:]
    return T


def transform_poses(T: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """``T @ pose`` for each pose, shape (N, 4, 4)."""
    return np.einsum("ij,njk->nik", T, poses)


def rotation_angles(R: np.ndarray) -> np.ndarray:
    """Angle [rad] of each rotation, R of shape (3, 3) or (N, 3, 3), accurate near 0 and near pi alike."""
    return _rotation().from_matrix(R).magnitude()


def motion_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Distance [m] and angle [degrees] between two poses (4, 4), or of each pair of two stacks (N, 4, 4).

    Returns:
        float64 (2,) or (N, 2); infinite where one of the two is not finite, as what an optimiser makes of an absurd
        camera may be.
    """
    is_known = np.isfinite(a).all(axis=(-2, -1)) & np.isfinite(b).all(axis=(-2, -1))
    if not np.all(is_known):
        known = is_known[..., None, None]
        motion = motion_between(np.where(known, a, np.eye(4)), np.where(known, b, np.eye(4)))
        return np.where(is_known[..., None], motion, np.inf)
    turn = rotation_angles(np.swapaxes(a[..., :3, :3], -1, -2) @ b[..., :3, :3])
    return np.stack([np.linalg.norm(a[..., :3, 3] - b[..., :3, 3], axis=-1), np.degrees(turn)], axis=-1)


@cache
def _rotation() -> Any:
    """scipy's class of rotations: 30 MB that a program which only names frames or jobs does not need."""
    from scipy.spatial.transform import Rotation

    return Rotation


def inverse(T: np.ndarray) -> np.ndarray:
    """Inverse of a rigid transform (4, 4), or of each of a stack (N, 4, 4)."""
    out = np.zeros_like(T, dtype=np.float64)
    R = np.swapaxes(T[..., :3, :3], -1, -2)
    out[..., :3, :3] = R
    out[..., :3, 3] = -np.einsum("...ij,...j->...i", R, T[..., :3, 3])
    out[..., 3, 3] = 1.0
    return out


def skew(w: np.ndarray) -> np.ndarray:
    """Matrix (3, 3) of the cross product with a vector (3,)."""
    x, y, z = w
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def motion_of(twist: np.ndarray) -> np.ndarray:
    """Rigid transform (4, 4), exp of a twist (v, w) of shape (6,) [m, rad]."""
    v, w = np.asarray(twist[:3], np.float64), np.asarray(twist[3:], np.float64)
    angle, W = float(np.linalg.norm(w)), skew(w)
    a, b, c = 1.0, 0.5, 1.0 / 6.0
    if angle > 1e-8:
        a = np.sin(angle) / angle
        b, c = 2.0 * (np.sin(0.5 * angle) / angle) ** 2, (1.0 - a) / angle**2
    T = np.eye(4)
    T[:3, :3] += a * W + b * W @ W
    T[:3, 3] = (np.eye(3) + b * W + c * W @ W) @ v
    return T


def twist_of(T: np.ndarray) -> np.ndarray:
    """Twist (v, w) (6,) [m, rad] of a rigid transform (4, 4) of less than half a turn; the inverse of `motion_of`."""
    w = _rotation().from_matrix(T[:3, :3]).as_rotvec()
    angle, W = float(np.linalg.norm(w)), skew(w)
    c = 1.0 / 12.0
    if angle > 1e-4:
        c = (1.0 - 0.5 * angle * np.sin(angle) / (1.0 - np.cos(angle))) / angle**2
    v = T[:3, 3] - 0.5 * W @ T[:3, 3] + c * W @ W @ T[:3, 3]
    return np.concatenate([v, w])


def adjoint(T: np.ndarray) -> np.ndarray:
    """Matrix (6, 6) that takes twists (v, w) through a rigid transform: T exp(xi) = exp(adjoint(T) xi) T."""
    A = np.zeros((6, 6))
    A[:3, :3] = A[3:, 3:] = T[:3, :3]
    A[:3, 3:] = skew(T[:3, 3]) @ T[:3, :3]
    return A
