"""Keyframes (Sec. 3.4): their images on the device, insertion, and the choice of the window by overlap."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np

from warpslam.camera import NO_MOTION, FrameMotion, Intrinsics

OVERLAP_PIXELS = 100
OVERLAP_SAMPLES = 16
OVERLAP_BORDER = 20


@dataclass
class Keyframe:
    """A past frame that stays in play."""

    index: int
    """Frame number."""
    image: int
    """Its number in the pool."""
    pose: np.ndarray
    """T_world_camera, float64 (4, 4), refined by bundle adjustment."""
    motion: FrameMotion = NO_MOTION
    """How the camera moved meanwhile: its image is rectified by it when it is brought, anew if this has changed."""


@dataclass(frozen=True)
class PlacedImage:
    """An image and where it was taken."""

    slot: int
    """Of the image."""
    T_world_camera: np.ndarray
    """Its pose (4, 4)."""
    name: Hashable = None
    """What the image is known by again; None: it is another one each time."""


def placed(keyframes: Sequence[Keyframe], slots: Sequence[int]) -> list[PlacedImage]:
    """Keyframes whose images are in these slots."""
    return [PlacedImage(slot, one.pose, (one.image, one.motion)) for one, slot in zip(keyframes, slots, strict=True)]


def overlap_fractions(
    depth: np.ndarray,
    T_world_camera: np.ndarray,
    keyframe_poses: list[np.ndarray],
    camera: Intrinsics,
    rng: np.random.Generator,
) -> np.ndarray:
    """Share of points on the current frame's view rays that each keyframe sees, (keyframes,) in [0, 1].

    100 random pixels, 16 points a ray from 0.8 D to D + 0.5 m, projected into every keyframe; the outer 20 pixels of
    the image do not count.

    Args:
        depth: Current depth image [m], (H, W), 0 = missing.
        T_world_camera: Current pose (4, 4).
        keyframe_poses: Keyframe poses (4, 4).
        camera: Intrinsics of both.
        rng: Chooses the pixels.
    """
    v = rng.integers(0, camera.height, OVERLAP_PIXELS)
    u = rng.integers(0, camera.width, OVERLAP_PIXELS)
    d = depth[v, u].astype(np.float64)
    s = np.linspace(0.0, 1.0, OVERLAP_SAMPLES)
    z = 0.8 * d[:, None] * (1 - s) + (d[:, None] + 0.5) * s
    rays = camera.backproject(u, v, 1.0)
    points = (z[..., None] * rays[:, None]).reshape(-1, 3) @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
    fractions = np.zeros(len(keyframe_poses))
    border = OVERLAP_BORDER
    for n, T in enumerate(keyframe_poses):
        q = (points - T[:3, 3]) @ T[:3, :3]
        in_front = q[:, 2] > 1e-5
        x, y = camera.project(q[:, 0], q[:, 1], np.where(in_front, q[:, 2], 1.0))
        inside = (x > border) & (x < camera.width - border) & (y > border) & (y < camera.height - border)
        fractions[n] = np.mean(inside & in_front)
    return fractions
