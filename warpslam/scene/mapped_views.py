"""What mapped frames saw: kept small while a run goes on, and as evidence for the mesh and for figures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warpslam.camera import Intrinsics
from warpslam.errors import InputError
from warpslam.poses import check_transform

SEEN_STRIDE = 4


@dataclass(frozen=True)
class SeenDepth:
    """What a mapped frame saw, kept small: it tells the mesher which space was observed."""

    index: int
    """Frame number."""
    millimetres: np.ndarray
    """Every 4th row and column of the depth, uint16."""

    @classmethod
    def of(cls, index: int, depth: np.ndarray) -> SeenDepth:
        """From a full depth image [m], float32 (H, W)."""
        return cls(index, np.rint(1000.0 * depth[::SEEN_STRIDE, ::SEEN_STRIDE]).astype(np.uint16))

    def depth(self) -> np.ndarray:
        """Depth [m], float32."""
        return self.millimetres.astype(np.float32) / 1000.0

    def view(self, camera: Intrinsics, T_world_camera: np.ndarray) -> ObservedView:
        """As evidence, from the camera of the full image and the pose (4, 4) that the frame has by now."""
        return ObservedView(self.depth(), camera.strided(SEEN_STRIDE), T_world_camera)


@dataclass(frozen=True)
class ObservedView:
    """A depth image and where it was taken: the evidence for what has been seen.

    Raises:
        InputError: The depth is no image of the camera's size, or the transform is not rigid.
    """

    depth: np.ndarray
    """z-depth [m], float32 (H, W); zero, negative and non-finite pixels count as missing."""
    intrinsics: Intrinsics
    """Camera of exactly this image (`Intrinsics.scaled` for a downsampled one)."""
    T_world_camera: np.ndarray
    """Camera-to-world transform (4, 4), OpenCV axes."""

    def __post_init__(self) -> None:
        depth = np.asarray(self.depth, dtype=np.float32)
        size = (self.intrinsics.height, self.intrinsics.width)
        if depth.shape != size or min(size) < 2:
            raise InputError(
                f"ObservedView.depth has shape {depth.shape}, the camera's image {size}, and 2 x 2 is the least; "
                "for a resized image pass intrinsics.scaled(width, height)"
            )
        valid = np.isfinite(depth) & (depth > 0)
        object.__setattr__(self, "depth", np.where(valid, depth, np.float32(0.0)))
        object.__setattr__(self, "T_world_camera", check_transform(self.T_world_camera, "ObservedView.T_world_camera"))

    def points(self) -> np.ndarray:
        """World points [m] of the pixels with depth, float64, shape (N, 3)."""
        v, u = np.nonzero(self.depth)
        z = self.depth[v, u].astype(np.float64)
        return self.intrinsics.backproject(u, v, z) @ self.T_world_camera[:3, :3].T + self.T_world_camera[:3, 3]
