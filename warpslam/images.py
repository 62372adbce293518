"""RGB-D images as a method takes them in: from what a caller has to uint8 colour and depth in metres."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from warpslam.camera import Intrinsics
from warpslam.errors import InputError


def read_images(
    rgb: Any, depth: Any, intrinsics: Intrinsics, max_depth: float, depth_scale: float | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Check and convert an image pair: uint8 (H, W, 3), and float32 (H, W) [m] with 0 for what is no measurement.

    Args:
        rgb: Colour (H, W, 3): uint8, or float in [0, 1]. NumPy, torch or Warp array.
        depth: z-depth (H, W): float in metres, or integer with ``depth_scale``.
        intrinsics: Camera, for the expected size.
        max_depth: Measurements beyond this are none [m].
        depth_scale: Units per metre of integer depth.

    Raises:
        InputError: an array has the wrong shape or type.
    """
    rgb, depth = _to_numpy(rgb), _to_numpy(depth)
    size = (intrinsics.height, intrinsics.width)
    if rgb.shape != (*size, 3):
        raise InputError(f"rgb has shape {rgb.shape}, expected {(*size, 3)} from the intrinsics")
    if depth.shape != size:
        raise InputError(f"depth has shape {depth.shape}, expected {size} from the intrinsics")
    if np.issubdtype(rgb.dtype, np.floating):
        rgb = np.rint(np.clip(np.nan_to_num(rgb), 0.0, 1.0) * 255.0).astype(np.uint8)
    elif rgb.dtype != np.uint8:
        raise InputError(f"rgb has dtype {rgb.dtype}, expected uint8 or float in [0, 1]")
    if np.issubdtype(depth.dtype, np.integer):
        if depth_scale is None or not depth_scale > 0:
            raise InputError(f"depth is {depth.dtype}: pass depth_scale, the units per metre (for example 1000)")
        depth = depth / np.float32(depth_scale)
    elif not np.issubdtype(depth.dtype, np.floating):
        raise InputError(f"depth has dtype {depth.dtype}, expected float [m] or uint16 with depth_scale")
    depth = depth.astype(np.float32)
    usable = np.isfinite(depth) & (depth > 0) & (depth <= max_depth)
    return rgb, np.where(usable, depth, np.float32(0.0))


def _to_numpy(array: Any) -> np.ndarray:
    if isinstance(array, np.ndarray):
        return array
    if isinstance(array, wp.array):
        return array.numpy()
    if hasattr(array, "detach"):
        return array.detach().cpu().numpy()
    raise InputError(f"expected a NumPy, torch or Warp array, got {type(array).__name__}")
