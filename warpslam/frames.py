"""What may be wrong with one frame: arrays in, images that the map can take out, or the reason why the frame is no use.

Misuse and bad data are told apart. Misuse is what holds for every call alike (no array, integer depth without its
unit) and raises `InputError`; a bad frame is what a camera, a disk or a network can do to a single frame, and raises
`FrameError`, which `Slam.step` turns into the status SKIPPED.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from warpslam.camera import Intrinsics, check_number
from warpslam.errors import FrameError, InputError

MIN_DEPTH_PIXELS = 100
BLANK_SHARE = 0.99
"""An image is black or over-exposed if this share of its pixels is."""
DARKEST, BRIGHTEST = 2, 253


def read_images(
    rgb: Any,
    depth: Any,
    intrinsics: Intrinsics,
    max_depth: float,
    depth_scale: float | None = None,
    *,
    colored: bool = True,
) -> tuple[np.ndarray, np.ndarray]:
    """Images of a frame in the form that the kernels take.

    Args:
        rgb: Colour (H, W, 3): uint8, or float in [0, 1]. NumPy, torch or Warp array.
        depth: z-depth (H, W): float [m], or integer with ``depth_scale``.
        intrinsics: Camera, for the size that the images should have.
        max_depth: Larger depth counts as missing [m].
        depth_scale: Units per metre of integer depth.
        colored: Whether colour is used; if not, a black image is no fault.

    Returns:
        uint8 (H, W, 3) and float32 (H, W) [m] with 0 for everything that is no measurement.

    Raises:
        InputError: Not called with arrays, or with integer depth and no usable ``depth_scale``.
        FrameError: This frame is no use; the message says why.
    """
    rgb, depth = _to_numpy(rgb, "rgb"), _to_numpy(depth, "depth")
    size = (intrinsics.height, intrinsics.width)
    if depth_scale is not None:
        depth_scale = check_number(depth_scale, "depth_scale")
        if not (math.isfinite(depth_scale) and depth_scale > 0):
            raise InputError(f"depth_scale = {depth_scale!r} must be positive: units per metre (for example 1000)")
    if rgb.shape != (*size, 3):
        raise FrameError(f"rgb has shape {rgb.shape}, expected {(*size, 3)} from the intrinsics")
    if depth.shape != size:
        raise FrameError(f"depth has shape {depth.shape}, expected {size} from the intrinsics")
    rgb = _color(rgb)
    fault = exposure_fault(rgb) if colored else None
    if fault is not None:
        raise FrameError(fault)
    return rgb, _metres(depth, depth_scale, max_depth)


def _to_numpy(array: Any, name: str) -> np.ndarray:
    if isinstance(array, np.ndarray):
        return array
    try:
        if hasattr(array, "detach"):
            return np.asarray(array.detach().cpu().numpy())
        if hasattr(array, "numpy"):
            return np.asarray(array.numpy())
    except (TypeError, ValueError, RuntimeError) as error:  # a layout or type that NumPy does not know
        raise FrameError(f"{name} has no counterpart in NumPy ({error})") from error
    raise InputError(f"{name}: expected a NumPy, torch or Warp array, got {type(array).__name__}")


def _color(rgb: np.ndarray) -> np.ndarray:
    if rgb.dtype == np.uint8:
        return rgb
    if not np.issubdtype(rgb.dtype, np.floating):
        raise FrameError(f"rgb has dtype {rgb.dtype}, expected uint8 or float in [0, 1]")
    values = np.nan_to_num(rgb, nan=0.0, posinf=0.0, neginf=0.0)
    # Interpolation may overshoot a little; 0..255 stored as float would pass for an over-exposed image.
    if values.size and values.max() > 2.0:
        raise FrameError(f"rgb is {rgb.dtype} with values up to {values.max():.4g}, expected [0, 1] or uint8")
    return np.rint(np.clip(values, 0.0, 1.0) * 255.0).astype(np.uint8)


def exposure_fault(rgb: np.ndarray) -> str | None:
    """Why a uint8 image (H, W, 3) shows nothing: "black" or "over-exposed", with the share; None if it shows something.

    Every fourth pixel of both directions is looked at.
    """
    sample = rgb[::4, ::4].reshape(-1, 3)
    for name, pixels in (("black", sample.max(axis=1) <= DARKEST), ("over-exposed", sample.min(axis=1) >= BRIGHTEST)):
        share = float(pixels.mean()) if pixels.size else 0.0
        if share >= BLANK_SHARE:
            return f"the colour image is {name} ({share:.0%} of its pixels)"
    return None


def _metres(depth: np.ndarray, depth_scale: float | None, max_depth: float) -> np.ndarray:
    if np.issubdtype(depth.dtype, np.integer):
        if depth_scale is None:
            raise InputError(f"depth is {depth.dtype}: pass depth_scale, the units per metre (for example 1000)")
        depth = depth / np.float32(depth_scale)
    elif not np.issubdtype(depth.dtype, np.floating):
        raise FrameError(f"depth has dtype {depth.dtype}, expected float [m] or uint16 with depth_scale")
    with np.errstate(over="ignore"):
        depth = depth.astype(np.float32)
    usable = np.isfinite(depth) & (depth > 0) & (depth <= max_depth)
    count = np.count_nonzero(usable)
    if count < MIN_DEPTH_PIXELS:
        within = f" within {max_depth:g} m" if math.isfinite(max_depth) else ""
        raise FrameError(f"fewer than {MIN_DEPTH_PIXELS} pixels have depth{within} (only {count} of {depth.size})")
    return np.where(usable, depth, np.float32(0.0))


@dataclass(frozen=True)
class FrameResult:
    """What `Slam.step` returns.

    index: Frame number from 0. timestamp: [s].
    T_world_camera: Estimated pose, float64 (4, 4); of a frame that is not OK, that of the last one that was.
    status: "OK"; "LOST" (the pose was not found, the map is untouched); "SKIPPED" (nothing usable in the frame).
    losses: Mean loss per ray: "tracking", and of the stages of mapping that was done by then.
    inliers: Share of the depth rays into what the map has seen that agree with it, in [0, 1].
    depth_error: Mean |measured - rendered depth| of the inliers [m].
    timings: Seconds by phase: "tracking", "mapping" (overlapped: waiting for it and taking it over), "keyframe".
    message: Why the frame is not OK.
    """

    index: int
    timestamp: float
    T_world_camera: np.ndarray
    status: str = "OK"
    losses: dict[str, float] = field(default_factory=dict)
    inliers: float = 1.0
    depth_error: float = 0.0
    timings: dict[str, float] = field(default_factory=dict)
    message: str = ""
