"""A room with a smooth pattern on its walls, cast row by row: what a moving camera with a rolling shutter takes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warpslam.camera import FrameMotion, Intrinsics
from warpslam.poses import motion_of


@dataclass(frozen=True)
class SweptRoom:
    """An axis-aligned box around the origin, seen from inside; ``pillar`` [m] is the half width of a column in it, and
    ``grain`` the size [grey values] of a texture whose cells are 5 cm wide.
    """

    half: tuple[float, float, float] = (2.0, 1.4, 2.6)
    pillar: float = 0.0
    grain: float = 0.0

    def take(
        self, camera: Intrinsics, T_world_camera: np.ndarray, motion: FrameMotion
    ) -> tuple[np.ndarray, np.ndarray]:
        """Colour uint8 (H, W, 3) and depth [m] float32 (H, W); the pose is that at colour's middle row."""
        rgb = np.zeros((camera.height, camera.width, 3), np.uint8)
        depth = np.zeros((camera.height, camera.width), np.float32)
        u = np.arange(camera.width, dtype=np.float64)
        twist = np.array(motion.twist)
        for row in range(camera.height):
            late = (row / camera.height - 0.5) * motion.readout
            rays = camera.backproject(u, np.full_like(u, row), 1.0)
            points, _ = self._hit(T_world_camera @ motion_of(late * twist), rays)
            rgb[row] = np.rint(self._pattern(points))
            _, depth[row] = self._hit(T_world_camera @ motion_of((motion.depth_offset + late) * twist), rays)
        return rgb, depth

    def _hit(self, T: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """World points (n, 3) and z-depths (n,) where rays of the camera meet a wall or the column."""
        d, origin = rays @ T[:3, :3].T, T[:3, 3]
        with np.errstate(divide="ignore"):
            z = np.min((np.sign(d) * self.half - origin) / d, axis=1)
            if self.pillar:
                center = np.array([0.2, 0.0, 1.3])
                a, b = ((center + side * self.pillar - origin) / d for side in (-1.0, 1.0))
                a, b = np.minimum(a, b)[:, [0, 2]], np.maximum(a, b)[:, [0, 2]]
                enter, leave = a.max(axis=1), b.min(axis=1)
                z = np.where((enter < leave) & (enter > 0), np.minimum(z, enter), z)
        return origin + z[:, None] * d, z

    def _pattern(self, points: np.ndarray) -> np.ndarray:
        x, y, z = 3.0 * points.T
        waves = [np.sin(3 * x + 2 * y) * np.cos(2 * z), np.sin(4 * y - 2 * z) * np.cos(x), np.cos(2 * x + 3 * z + y)]
        smooth = 127.5 + (100.0 - self.grain) * np.stack(waves, axis=-1)
        cell = np.floor(points / 0.05 + 0.5) @ [12.9898, 78.233, 37.719]
        return smooth + self.grain * np.sin(1e4 * np.sin(cell))[:, None]
