"""Pairs of features without a guess of the motion: by optical flow, by descriptors alone; the pose of such pairs."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from warpslam.camera import Intrinsics

FLOW_WINDOW = (21, 21)
FLOW_LEVELS = 5
"""Of the image pyramid, beyond the image itself."""
FLOW_RETURN = 1.0
"""Flow forth and back ends within this of where it began [px]."""
DESCRIPTOR_LIMIT = 70
"""Bits that descriptors may differ by."""
DESCRIPTOR_RATIO = 0.85


def flow_pairs(before: np.ndarray, after: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Follow pixels from one image to another by pyramidal Lucas-Kanade, and back (Bouguet 2000).

    Args:
        before: uint8 (H, W).
        after: uint8 (H, W).
        pixels: Columns and rows in ``before``, float32 (n, 2).

    Returns:
        Where they are in ``after``, float32 (n, 2), and which were followed, bool (n,).
    """
    start = np.ascontiguousarray(pixels, np.float32)[:, None]

    def flow(a: np.ndarray, b: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        nowhere: Any = None
        there, found, _ = cv2.calcOpticalFlowPyrLK(a, b, points, nowhere, winSize=FLOW_WINDOW, maxLevel=FLOW_LEVELS)
        return there, found

    moved, forth = flow(before, after, start)
    back, returned = flow(after, before, moved)
    moved, gap = moved.reshape(-1, 2), np.linalg.norm((back - start).reshape(-1, 2), axis=1)
    height, width = after.shape
    followed = (forth.ravel() > 0) & (returned.ravel() > 0) & (gap < FLOW_RETURN)
    followed &= (moved > 1.0).all(axis=1) & (moved[:, 0] < width - 2) & (moved[:, 1] < height - 2)
    return moved, followed


def descriptor_pairs(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of descriptors, uint8 (n, 32) and (m, 32): nearest with a ratio test, one of ``a`` for one of ``b``.

    Returns:
        Indices into ``a`` and ``b``, int (k,).
    """
    none = np.zeros(0, np.int64)
    if len(a) == 0 or len(b) < 2:
        return none, none
    bits, nearest = cv2.batchDistance(a, b, cv2.CV_32S, normType=cv2.NORM_HAMMING, K=2)
    good = (bits[:, 0] < DESCRIPTOR_LIMIT) & (bits[:, 0] < DESCRIPTOR_RATIO * bits[:, 1])
    i = np.flatnonzero(good)
    j = nearest[i, 0].astype(np.int64)
    order = np.lexsort((i, bits[i, 0], j))
    first = np.ones(len(order), bool)
    first[1:] = j[order][1:] != j[order][:-1]
    keep = np.sort(order[first])
    return i[keep], j[keep]


def ransac_pose(
    points: np.ndarray, pixels: np.ndarray, camera: Intrinsics, *, error: float, iterations: int, confidence: float
) -> tuple[np.ndarray, int] | None:
    """Pose from points [m] (n, 3) and where they are seen [px] (n, 2): AP3P in RANSAC, whose draws are always the same.

    Args:
        points: In any axes.
        pixels: Columns and rows.
        camera: That sees them.
        error: Distance of an inlier [px].
        iterations: Draws, at most.
        confidence: With which a good draw is among them.

    Returns:
        T_camera_points (4, 4) and the number of inliers; None if there is no pose.
    """
    if len(points) < 4:
        return None
    found, turn, shift, inliers = cv2.solvePnPRansac(
        np.ascontiguousarray(points, np.float64),
        np.ascontiguousarray(pixels, np.float64),
        camera.matrix,
        None,
        iterationsCount=iterations,
        reprojectionError=error,
        confidence=confidence,
        flags=cv2.SOLVEPNP_AP3P,
    )
    if not found or inliers is None:
        return None
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
    return (T, len(inliers)) if np.isfinite(T).all() else None
