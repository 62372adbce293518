"""Depth noise like that of a structured-light camera."""

from __future__ import annotations

import numpy as np

from warpslam.camera import Intrinsics


def sensor_noise(
    depth: np.ndarray,
    rng: np.random.Generator,
    intrinsics: Intrinsics,
    *,
    axial: float = 0.0019,
    baseline: float = 0.075,
    disparity_step: float = 1 / 8,
    edge: float = 0.04,
    grazing: float = 80.0,
    max_depth: float = 8.0,
) -> np.ndarray:
    """Add noise, quantisation and holes to an exact depth image.

    The axial noise is sigma(z) = 0.0012 + ``axial`` (z - 0.4)^2 (Nguyen, Izadi, Lovell 2012, Eq. 2), and disparity
    f ``baseline`` / z comes in steps of ``disparity_step`` pixels, as in a Kinect.

    Args:
        depth: z-depth [m], shape (H, W), 0 = missing.
        axial: Noise growth [1/m].
        baseline: Distance of projector and camera [m]; 0 switches quantisation off.
        edge: Neighbouring pixels whose depths differ by more than this fraction lose their depth half of the time.
        grazing: Surfaces seen at more than this angle from their normal [deg] lose their depth half of the time.
        max_depth: Range of the sensor [m].

    Returns:
        z-depth [m], float32, shape (H, W), 0 = missing.
    """
    depth = np.asarray(depth, dtype=np.float64)
    hit = depth > 0
    noisy = depth + rng.normal(size=depth.shape) * (0.0012 + axial * np.maximum(depth - 0.4, 0.0) ** 2)
    if baseline > 0:
        disparity = intrinsics.fx * baseline / np.where(hit, np.maximum(noisy, 1e-3), 1.0)
        disparity = np.round(disparity / disparity_step) * disparity_step
        noisy = intrinsics.fx * baseline / np.maximum(disparity, disparity_step)
    doubtful = _at_edge(depth, edge) | _at_grazing_angle(depth, intrinsics, grazing)
    lost = doubtful & (rng.uniform(size=depth.shape) < 0.5)
    return np.where(hit & ~lost & (noisy > 0) & (noisy < max_depth), noisy, 0.0).astype(np.float32)


def _at_edge(depth: np.ndarray, fraction: float) -> np.ndarray:
    result = np.zeros(depth.shape, dtype=bool)
    for axis in (0, 1):
        before, after = _pairs(depth, axis)
        jump = np.abs(before - after) > fraction * np.minimum(before, after)
        # Both sides of a jump, as the projector's shadow widens it.
        first, second = _pairs(result, axis)
        first |= jump
        second |= jump
    return result


def _pairs(image: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Views of an image without its last and without its first row (or column)."""
    return (image[:-1], image[1:]) if axis == 0 else (image[:, :-1], image[:, 1:])


def _at_grazing_angle(depth: np.ndarray, k: Intrinsics, limit: float) -> np.ndarray:
    i, j = np.meshgrid(np.arange(k.width), np.arange(k.height))
    points = k.backproject(i, j, depth)
    normals = np.cross(np.gradient(points, axis=1), np.gradient(points, axis=0))
    size = np.linalg.norm(normals, axis=-1) * np.linalg.norm(points, axis=-1)
    cosine = np.abs((normals * points).sum(axis=-1)) / np.maximum(size, 1e-12)
    return cosine < np.cos(np.radians(limit))
