"""Depth and colour of two cameras brought into one, and depth along the ray brought onto the optical axis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warpslam.camera import Intrinsics

_MAX_SPLAT = 4  # [px] of the target that one depth pixel covers at most, in a row and in a column


@dataclass(frozen=True)
class ColorCamera:
    """The camera of the stored colour images, where it is another one than that of depth."""

    intrinsics: Intrinsics
    """Of the stored colour images."""
    distortion: tuple[float, ...] = ()
    """OpenCV coefficients (k1, k2, p1, p2, k3, ...); empty = none."""
    T_color_depth: tuple[float, ...] = tuple(np.eye(4).ravel().tolist())
    """Takes points of the depth camera into that of colour [m], row-major, 16 numbers."""

    @property
    def transform(self) -> np.ndarray:
        """T_color_depth, float64 (4, 4)."""
        return np.array(self.T_color_depth).reshape(4, 4)

    @property
    def shares_centre(self) -> bool:
        """Whether both cameras are in one place and look the same way: then no depth is needed to go from one to the
        other.
        """
        return bool(np.allclose(self.transform, np.eye(4), atol=1e-6))

    def at_resolution_of(self, depth: Intrinsics) -> Intrinsics:
        """The colour camera with images as wide as those of depth, or as it is if it is no larger."""
        camera = self.intrinsics
        if camera.width <= depth.width:
            return camera
        return camera.scaled(depth.width, max(1, round(camera.height * depth.width / camera.width)))


def axis_depth(depth: np.ndarray, camera: Intrinsics) -> np.ndarray:
    """z-depth (H, W) of depth that is measured along the rays of the pixels: z = d / |K^-1 (u, v, 1)|."""
    return (depth / ray_lengths(camera)).astype(np.float32)


def ray_lengths(camera: Intrinsics) -> np.ndarray:
    """|K^-1 (u, v, 1)| of each pixel, float32 (H, W)."""
    v, u = np.mgrid[: camera.height, : camera.width]
    return np.linalg.norm(camera.backproject(u, v, 1.0), axis=-1).astype(np.float32)


def color_at_depth(rgb: np.ndarray, color: Intrinsics, depth: Intrinsics) -> tuple[np.ndarray, np.ndarray]:
    """Colour (H, W, 3) in the pixels of a depth camera that shares its centre and axes, and which of them it sees."""
    import cv2

    # Pixel (u, v) of depth is pixel s (u - c) + c' of colour, the inverse map that OpenCV asks for.
    su, sv = color.fx / depth.fx, color.fy / depth.fy
    matrix = np.array([[su, 0.0, color.cx - su * depth.cx], [0.0, sv, color.cy - sv * depth.cy]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    size = (depth.width, depth.height)
    v, u = np.mgrid[: depth.height, : depth.width]
    column, row = su * u + matrix[0, 2], sv * v + matrix[1, 2]
    seen = (column > -0.5) & (row > -0.5) & (column < rgb.shape[1] - 0.5) & (row < rgb.shape[0] - 0.5)
    return cv2.warpAffine(rgb, matrix, size, flags=flags, borderMode=cv2.BORDER_REPLICATE), seen


def register_depth(
    depth: np.ndarray, camera: Intrinsics, target: Intrinsics, T_target_camera: np.ndarray
) -> np.ndarray:
    """z-depth (H, W) as another camera sees it, the nearest surface in front.

    A depth pixel covers the rectangle of the target that its corners span, so that no gaps open where the target has
    the longer focal length.

    Args:
        depth: z-depth [m], shape (H, W), 0 = missing.
        camera: Its camera.
        target: The camera wanted.
        T_target_camera: Takes points of the camera into the target's axes, (4, 4).

    Returns:
        float32 (H', W') of the target, 0 = missing.
    """
    v, u = np.nonzero(depth > 0)
    z = depth[v, u].astype(np.float64)
    corners, far = [], np.zeros(len(z))
    for shift in (-0.5, 0.5):
        points = camera.backproject(u + shift, v + shift, z) @ T_target_camera[:3, :3].T + T_target_camera[:3, 3]
        far += 0.5 * points[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            corners.append(np.stack(target.project(*points.T), axis=-1))
    low, high = np.minimum(*corners), np.maximum(*corners)
    seen = (far > 1e-6) & np.isfinite(low).all(axis=1) & np.isfinite(high).all(axis=1)
    seen &= (high >= -1).all(axis=1) & (low <= (target.width, target.height)).all(axis=1)
    # A pixel of the target belongs to the rectangle if its centre does: ceil(low) <= pixel < high.
    first, end, far = np.ceil(low[seen]).astype(int), np.ceil(high[seen]).astype(int), far[seen]
    end = np.minimum(np.maximum(end, first + 1), first + _MAX_SPLAT)
    registered = np.full((target.height, target.width), np.inf, np.float32)
    size = end - first
    for dv in range(int(size[:, 1].max(initial=0))):
        for du in range(int(size[:, 0].max(initial=0))):
            column, row = first[:, 0] + du, first[:, 1] + dv
            inside = (du < size[:, 0]) & (dv < size[:, 1]) & (column >= 0) & (row >= 0)
            inside &= (column < target.width) & (row < target.height)
            np.minimum.at(registered, (row[inside], column[inside]), far[inside].astype(np.float32))
    return np.where(np.isfinite(registered), registered, np.float32(0))
