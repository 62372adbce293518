"""Do poses and depth images belong together? Points of one frame are carried into another one and compared with it.

A pose file that holds world-to-camera matrices, or OpenGL axes, is read without complaint and makes every error figure
meaningless. Only the motion from frame i to frame j tells: with the right reading of the matrices, the points that
frame i measured lie on what frame j measured.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from warpslam.camera import Intrinsics
from warpslam.errors import DatasetError
from warpslam.poses import pose_from_vector, rotation_angles, vector_from_pose
from warpslam.sequences.base import RgbdSequence
from warpslam.sequences.registration import axis_depth
from warpslam.spread import spread

OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])

OPENCV, OPENGL = "camera-to-world, OpenCV axes", "camera-to-world, OpenGL axes"
CONVENTIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    OPENCV: lambda T: T,
    OPENGL: lambda T: T @ OPENGL_FROM_OPENCV,
    "world-to-camera, OpenCV axes": lambda T: np.linalg.inv(T),
    "world-to-camera, OpenGL axes": lambda T: np.linalg.inv(OPENGL_FROM_OPENCV @ T),
}
"""How a stored matrix may be meant: T_world_camera in OpenCV axes from the stored one."""
EXPECTED = next(iter(CONVENTIONS))
W_FIRST = "camera-to-world with the quaternion's w first"
_MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])


def _w_first(T: np.ndarray) -> np.ndarray:
    """The pose whose quaternion was stored as qw qx qy qz and read as qx qy qz qw."""
    qw, qx, qy, qz, *t = vector_from_pose(T)
    return pose_from_vector(np.array([qx, qy, qz, qw, *t]))


READINGS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    **CONVENTIONS,
    W_FIRST: _w_first,
    "camera-to-world of a mirrored world (y up, as ICL-NUIM's)": lambda T: _MIRROR @ T @ _MIRROR,
}
"""`CONVENTIONS`, and what else may have become of a pose on its way into a file."""

TOLERANCE = 0.04
"""Two depths agree if they differ by less than this share."""
MIN_OVERLAP = 0.3
_MIN_ANGLE, _MAX_ANGLE = np.radians(8.0), np.radians(45.0)
_MIN_SHIFT = 0.2  # [m]
_POINT_COUNT = 5000


@dataclass(frozen=True)
class DepthView:
    """What one frame measured, and from where."""

    depth: np.ndarray
    """z-depth [m], (H, W), 0 = missing."""
    pose: np.ndarray
    """Matrix as stored, (4, 4)."""


Pairs = list[tuple[DepthView, DepthView]]


def moving_pairs(poses: np.ndarray, count: int) -> list[tuple[int, int]]:
    """Pairs of frames far enough apart to tell one convention from another, and near enough to overlap.

    Args:
        poses: Matrices as stored, (N, 4, 4), NaN where unknown.
        count: Pairs wanted, spread over the sequence.

    Returns:
        Positions (i, j), i < j; fewer than ``count`` if the camera hardly moves.
    """
    known = np.isfinite(poses).all(axis=(1, 2))
    pairs = []
    for first in spread(len(poses) - 1, count):
        if not known[first]:
            continue
        later = np.flatnonzero(known[first + 1 :]) + first + 1
        angle = rotation_angles(poses[first, :3, :3].T @ poses[later, :3, :3])
        shift = np.linalg.norm(poses[later, :3, 3] - poses[first, :3, 3], axis=1)
        enough = later[((angle > _MIN_ANGLE) | (shift > _MIN_SHIFT)) & (angle < _MAX_ANGLE)]
        if len(enough):
            pairs.append((int(first), int(enough[0])))
    return pairs


def posed_pairs(
    sequence: RgbdSequence, poses: np.ndarray, frames: Sequence[int] | None = None, count: int = 6
) -> Pairs:
    """Pairs of frames of a moving camera with their depth, up to ``count``; frames that can't be read are passed over.

    Args:
        sequence: The sequence.
        poses: Matrices as stored, (N, 4, 4), NaN where unknown.
        frames: Numbers of the N frames in the sequence; 0, 1, 2, ... if None.
        count: Pairs wanted.
    """
    frames = range(len(poses)) if frames is None else frames
    pairs: Pairs = []
    for i, j in moving_pairs(poses, 2 * count):
        if len(pairs) == count:
            break
        try:
            a, b = (DepthView(sequence[frames[k]].depth, poses[k]) for k in (i, j))
        except DatasetError:
            continue
        pairs.append((a, b))
    return pairs


def on_axis(view: DepthView, camera: Intrinsics) -> DepthView:
    """The view, if its depth was measured along the rays."""
    return DepthView(axis_depth(view.depth, camera), view.pose)


def agreement(
    pairs: list[tuple[DepthView, DepthView]], camera: Intrinsics, convention: str = EXPECTED, depth_factor: float = 1.0
) -> float:
    """Share of the points carried from one frame into another that lie on what the other measured, in [0, 1].

    Args:
        pairs: Frames and their stored matrices.
        camera: Camera of the depth images.
        convention: One of `READINGS`.
        depth_factor: Depth is multiplied by this first.
    """
    read = READINGS[convention]
    agreeing = compared = 0.0
    for a, b in pairs:
        T_b_a = np.linalg.inv(read(b.pose)) @ read(a.pose)
        points = _points(a.depth * depth_factor, camera) @ T_b_a[:3, :3].T + T_b_a[:3, 3]
        z = points[:, 2]
        ahead = z > 1e-6
        u, v = map(np.rint, camera.project(*points[ahead].T))
        inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        measured = b.depth[v[inside].astype(int), u[inside].astype(int)] * depth_factor
        valid = measured > 0
        close = np.abs(z[ahead][inside] - measured) < TOLERANCE * measured
        agreeing += np.count_nonzero(close & valid)
        # Points that leave the image prove nothing, but a convention that throws nearly all out has not won.
        compared += max(float(np.count_nonzero(valid)), MIN_OVERLAP * len(points))
    return agreeing / compared if compared else 0.0


def _points(depth: np.ndarray, camera: Intrinsics) -> np.ndarray:
    """Points (N, 3) [m] of a depth image in its camera's frame, about `_POINT_COUNT` of them."""
    stride = max(1, int(np.sqrt(depth.size / _POINT_COUNT)))
    v, u = np.nonzero(depth[::stride, ::stride])
    z = depth[::stride, ::stride][v, u].astype(np.float64)
    return camera.backproject(u * stride, v * stride, z)
