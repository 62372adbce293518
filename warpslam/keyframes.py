"""Keyframes (Sec. 3.4): their images on the device, insertion, and the choice of the window by overlap."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from warpslam.camera import Intrinsics

OVERLAP_PIXELS = 100
OVERLAP_SAMPLES = 16
OVERLAP_BORDER = 20
SEEN_STRIDE = 4


class ImagePool:
    """RGB-D images on the device, by slot: colour as uint8, depth as uint16 times a scale of its own.

    Slot 0 is the current frame. Depth is kept to 1/131070 of the image's largest depth (0.04 mm at 5 m).
    """

    def __init__(self, camera: Intrinsics, device: wp.Device, capacity: int = 8) -> None:
        self.camera, self.device = camera, device
        self.count = 1
        self._allocate(capacity)

    def _allocate(self, capacity: int) -> None:
        shape = (capacity, self.camera.height, self.camera.width)
        self.rgb = wp.zeros((*shape, 3), dtype=wp.uint8, device=self.device)
        self.depth = wp.zeros(shape, dtype=wp.uint16, device=self.device)
        self.scale = wp.zeros(capacity, dtype=float, device=self.device)

    @property
    def arrays(self) -> tuple[wp.array, wp.array, wp.array]:
        """Colour (slots, H, W, 3), depth (slots, H, W) and its scale (slots,) as the kernels read them."""
        return self.rgb, self.depth, self.scale

    def set(self, slot: int, rgb: np.ndarray, depth: np.ndarray) -> None:
        """Store an image: uint8 (H, W, 3) and float32 (H, W) [m]."""
        scale = float(depth.max()) / 65535.0 or 1.0
        self.rgb[slot].assign(np.ascontiguousarray(rgb))
        self.depth[slot].assign(np.rint(depth / scale).astype(np.uint16))
        self.scale[slot : slot + 1].assign(np.array([scale], np.float32))

    def add(self, rgb: np.ndarray, depth: np.ndarray) -> int:
        """Store an image in a new slot and return the slot."""
        if self.count == self.rgb.shape[0]:
            old = self.arrays
            self._allocate(2 * self.count)
            for source, target in zip(old, self.arrays, strict=True):
                wp.copy(target, source, count=source.size)
        slot = self.count
        self.count += 1
        self.set(slot, rgb, depth)
        return slot

    def restore(self, rgb: np.ndarray, depth: np.ndarray, scale: np.ndarray) -> list[int]:
        """Put back saved slots, slot 0 first; returns the slots."""
        self.count = len(rgb)
        self._allocate(max(2 * self.count, 8))
        for target, source in zip(self.arrays, (rgb, depth, scale), strict=True):
            target[: self.count].assign(np.ascontiguousarray(source))
        return list(range(self.count))

    def depth_image(self, slot: int) -> np.ndarray:
        """Depth [m], float32 (H, W)."""
        return self.depth[slot].numpy().astype(np.float32) * self.scale.numpy()[slot]


@dataclass
class Keyframe:
    """A past frame that stays in play.

    index: Frame number. slot: Its images in the pool. pose: Pose vector (7,), refined by bundle adjustment.
    """

    index: int
    slot: int
    pose: np.ndarray


@dataclass(frozen=True)
class SeenDepth:
    """What a mapped frame saw, kept small: it tells the mesher which space was observed.

    index: Frame number. millimetres: Every 4th row and column of the depth, uint16.
    """

    index: int
    millimetres: np.ndarray

    @classmethod
    def of(cls, index: int, depth: np.ndarray) -> SeenDepth:
        """From a full depth image [m], float32 (H, W)."""
        return cls(index, np.rint(1000.0 * depth[::SEEN_STRIDE, ::SEEN_STRIDE]).astype(np.uint16))

    def depth(self) -> np.ndarray:
        """Depth [m], float32."""
        return self.millimetres.astype(np.float32) / 1000.0


def overlap_fractions(
    depth: np.ndarray,
    T_world_camera: np.ndarray,
    keyframe_poses: list[np.ndarray],
    camera: Intrinsics,
    rng: np.random.Generator,
) -> np.ndarray:
    """Share of points on the current frame's view rays that each keyframe sees, (keyframes,) in [0, 1].

    100 random pixels, 16 points a ray from 0.8 D to D + 0.5 m, projected into every keyframe; the outer 20 pixels of
    the image do
    not count.

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
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(len(u))], axis=1)
    points = (z[..., None] * rays[:, None]).reshape(-1, 3) @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
    fractions = np.zeros(len(keyframe_poses))
    border = OVERLAP_BORDER
    for n, T in enumerate(keyframe_poses):
        q = (points - T[:3, 3]) @ T[:3, :3]
        in_front = q[:, 2] > 1e-5
        depth_safe = np.where(in_front, q[:, 2], 1.0)
        x = camera.fx * q[:, 0] / depth_safe + camera.cx
        y = camera.fy * q[:, 1] / depth_safe + camera.cy
        inside = (x > border) & (x < camera.width - border) & (y > border) & (y < camera.height - border)
        fractions[n] = np.mean(inside & in_front)
    return fractions
