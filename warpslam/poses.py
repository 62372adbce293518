"""Camera poses: rigid transforms (4, 4), and the vectors that the optimiser moves.

A pose ``T_world_camera`` maps camera points to world points [m]. A pose vector is (qw, qx, qy, qz, tx, ty, tz).
"""

from __future__ import annotations

import numpy as np

from warpslam.errors import InputError


def check_transform(T: np.ndarray, name: str = "T_world_camera", *, unknown_is_nan: bool = False) -> np.ndarray:
    """Return ``T`` as a float64 (4, 4) rigid transform or raise `InputError`.

    unknown_is_nan: A matrix that is not finite stands for an unknown pose and is returned as it is.
    """
    try:
        T = np.asarray(T, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} is no matrix of numbers ({error})") from error
    if T.shape != (4, 4):
        raise InputError(f"{name} has shape {T.shape}, expected (4, 4)")
    if not np.isfinite(T).all():
        if unknown_is_nan:
            return T
        raise InputError(f"{name} holds NaN or infinity")
    R = T[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-2 or np.linalg.det(R) < 0:
        raise InputError(f"{name} has no rotation in its upper left 3x3 block (not orthonormal, or a reflection)")
    return T


def orthonormalized(T: np.ndarray) -> np.ndarray:
    """A rigid transform (4, 4), float64, whose rotation is one to the last digits."""
    return pose_from_vector(vector_from_pose(T))


def vector_from_pose(T: np.ndarray) -> np.ndarray:
    """Pose vector (qw, qx, qy, qz, tx, ty, tz), float64, of a (4, 4) transform; the quaternion has unit length and
    qw >= 0.

    Not scipy's `Rotation`: the same to 2e-16, but ten times slower for a single pose, and every frame needs dozens.
    """
    R = np.asarray(T, dtype=np.float64)[:3, :3]
    # The largest of the four candidates keeps the division well conditioned (Shepperd's method).
    trace = np.trace(R)
    candidates = np.array([trace, R[0, 0], R[1, 1], R[2, 2]])
    largest = int(np.argmax(candidates))
    q = np.empty(4)
    if largest == 0:
        q[0] = 1.0 + trace
        q[1:] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    else:
        i = largest - 1
        j, k = (i + 1) % 3, (i + 2) % 3
        q[0] = R[k, j] - R[j, k]
        q[1 + i] = 1.0 + R[i, i] - R[j, j] - R[k, k]
        q[1 + j] = R[j, i] + R[i, j]
        q[1 + k] = R[k, i] + R[i, k]
    q /= np.linalg.norm(q)
    if q[0] < 0:
        q = -q
    return np.concatenate([q, np.asarray(T, dtype=np.float64)[:3, 3]])


def pose_from_vector(vector: np.ndarray) -> np.ndarray:
    """Transform (4, 4), float64, of a pose vector (qw, qx, qy, qz, tx, ty, tz), whose quaternion may have any length.

    Not scipy's `Rotation`, see `vector_from_pose`.
    """
    w, x, y, z, *t = np.asarray(vector, dtype=np.float64)
    s = 2.0 / (w * w + x * x + y * y + z * z)
    T = np.eye(4)
    T[:3, :3] = [
        [1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)],
        [s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)],
        [s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)],
    ]
    T[:3, 3] = t
    return T


def transform_poses(T: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """``T @ pose`` for each pose, shape (N, 4, 4)."""
    return np.einsum("ij,njk->nik", T, poses)


def rotation_angles(R: np.ndarray) -> np.ndarray:
    """Angle [rad] of each rotation, R of shape (..., 3, 3), accurate near 0 and near pi alike."""
    # arccos of the trace loses half the digits near 0 and pi; atan2 of sine and cosine does not.
    x, y, z = R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]
    trace = R[..., 0, 0] + R[..., 1, 1] + R[..., 2, 2]
    return np.arctan2(np.sqrt(x * x + y * y + z * z), trace - 1.0)


def motion_between(a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    """Distance [m] and angle [degrees] between two poses (4, 4)."""
    turn = rotation_angles(a[:3, :3].T @ b[:3, :3])
    return float(np.linalg.norm(a[:3, 3] - b[:3, 3])), float(np.degrees(turn))
