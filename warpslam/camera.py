"""Pinhole camera and camera poses.

Axes are OpenCV's: x right, y down, z forward. ``T_world_camera`` maps camera points to world points. Lengths are
metres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warpslam.errors import ConfigError, InputError


@dataclass(frozen=True)
class Intrinsics:
    """Pinhole intrinsics in pixels; pixel centres at integer coordinates (SPEC of the paper's code: no half-pixel
    offset).
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    def __post_init__(self) -> None:
        for name in ("fx", "fy", "width", "height"):
            value = getattr(self, name)
            if not np.isfinite(value) or value <= 0:
                raise ConfigError(f"camera.{name} = {value!r} must be a positive number")
        for name in ("cx", "cy"):
            if not np.isfinite(getattr(self, name)):
                raise ConfigError(f"camera.{name} = {getattr(self, name)!r} must be finite")

    @property
    def matrix(self) -> np.ndarray:
        """Camera matrix K, shape (3, 3), float64."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def scaled(self, width: int, height: int) -> Intrinsics:
        """Intrinsics of the same camera after resizing the image to ``width`` x ``height`` pixels."""
        sx, sy = width / self.width, height / self.height
        return Intrinsics(self.fx * sx, self.fy * sy, self.cx * sx, self.cy * sy, width, height)

    def strided(self, stride: int) -> Intrinsics:
        """Intrinsics of the image that keeps every ``stride``-th row and column, from the first on."""
        width, height = -(-self.width // stride), -(-self.height // stride)
        return Intrinsics(self.fx / stride, self.fy / stride, self.cx / stride, self.cy / stride, width, height)

    def cropped(self, border: int) -> Intrinsics:
        """Intrinsics after cutting ``border`` pixels from every side."""
        return Intrinsics(
            self.fx, self.fy, self.cx - border, self.cy - border, self.width - 2 * border, self.height - 2 * border
        )


def check_number(value: float, name: str) -> float:
    """Return ``value`` as a float, NaN and infinity included, or raise `InputError`."""
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{name} = {value!r} is no number") from error


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


def vector_from_pose(T: np.ndarray) -> np.ndarray:
    """Pose vector (qw, qx, qy, qz, tx, ty, tz), float64, of a (4, 4) transform; the quaternion has unit length, qw >=
    0.
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
    """Transform (4, 4), float64, of a pose vector (qw, qx, qy, qz, tx, ty, tz); the quaternion need not have unit
    length.
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
