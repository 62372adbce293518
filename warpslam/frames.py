"""Frames at the door: what comes in, what may be wrong with it, and what is said of it afterwards.

Misuse and bad data are told apart. Misuse is what holds for every call alike (no array, integer depth without its
unit) and raises `InputError`; a bad frame is what a camera, a disk or a network can do to a single frame, and is
admitted with its fault, which `Slam.step` turns into the status SKIPPED.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np

from warpslam.camera import MAX_DEPTH_OFFSET, ONE_MOMENT, Intrinsics, SensorTiming, check_number
from warpslam.config import Config
from warpslam.errors import ConfigError, FrameError, InputError
from warpslam.poses import MAX_DISTANCE, check_transform, is_near, orthonormalized

MIN_DEPTH_PIXELS = 100
BLANK_SHARE = 0.99
"""An image is black or over-exposed if this share of its pixels is."""
DARKEST, BRIGHTEST = 2, 253
DEFAULT_RATE = 30.0
"""Frames a second where no times are given."""


class FrameStatus(StrEnum):
    """What became of a frame."""

    OK = "OK"
    """Its pose is known."""
    LOST = "LOST"
    """Its pose was not found; the map is untouched."""
    SKIPPED = "SKIPPED"
    """There is nothing usable in it; the map is untouched."""


@dataclass(frozen=True)
class FrameResult:
    """What `Slam.step` returns."""

    index: int
    """Frame number from 0."""
    timestamp: float
    """[s]."""
    T_world_camera: np.ndarray
    """Estimated pose, float64 (4, 4); of a frame that is not OK, that of the last one that was."""
    status: FrameStatus = FrameStatus.OK
    """OK, LOST or SKIPPED."""
    losses: dict[str, float] = field(default_factory=dict)
    """Mean loss per ray: "tracking" (with direct tracking the robust cost per point), and of the stages of mapping that
    was done by then.
    """
    inliers: float = math.nan
    """Share of the depth rays into what the map has seen that agree with it, in [0, 1]; NaN where nothing was compared,
    as in the first frame.
    """
    depth_error: float = math.nan
    """Mean ``|measured - rendered depth|`` of the inliers [m]; NaN where nothing was compared."""
    correlation: float | None = None
    """Of grey values with the keyframe that the frame was registered to, in [-1, 1]; None with other tracking."""
    covariance: np.ndarray | None = None
    """Of the pose, float64 (6, 6): T_world_camera is uncertain by exp(xi) on its right, xi = (v, w) [m, rad],
    against the keyframe."""
    timings: dict[str, float] = field(default_factory=dict)
    """Seconds by phase: "tracking", "loops", "mapping" (overlapped: waiting for it and taking it over), "keyframe"."""
    message: str = ""
    """Why the frame is not OK."""
    reference: int | None = None
    """Frame of the keyframe that correlation and covariance are against; None with other tracking."""
    sensor_timing: dict[str, float] = field(default_factory=dict)
    """What this frame completed the estimate of, used from the next frame on: "depth_delay" and "readout" as in
    `SensorTiming`, and "depth_delay_sigma" and "readout_sigma", their standard deviations [s]. Else empty.
    """

    @property
    def sigma(self) -> tuple[float, float]:
        """Standard deviation of the pose in the direction that is least certain [m], and of the turn [degrees]; NaN
        where there is no covariance.
        """
        if self.covariance is None:
            return math.nan, math.nan
        shift, turn = (
            max(float(np.linalg.eigvalsh(self.covariance[k : k + 3, k : k + 3])[-1]), 0.0) ** 0.5 for k in (0, 3)
        )
        return shift, math.degrees(turn)


@dataclass(frozen=True, eq=False)
class AdmittedFrame:
    """A frame in the form that the algorithm takes, or the reason why it is no use."""

    index: int
    """Frame number from 0."""
    timestamp: float
    """[s]; of a frame whose time is no number, that of the frame before."""
    rgb: np.ndarray
    """Colour, uint8 (H, W, 3); empty where there is a fault."""
    depth: np.ndarray
    """z-depth [m], float32 (H, W), 0 where nothing was measured; empty where there is a fault."""
    given_pose: np.ndarray | None = None
    """Known T_world_camera, float64 (4, 4)."""
    depth_offset: float = 0.0
    """tau, time of the depth image minus that of the colour image [s]."""
    fault: str = ""
    """Why the frame can't be used; empty if it can."""


def admit(
    index: int,
    rgb: Any,
    depth: Any,
    timestamp: float | None,
    T_world_camera: np.ndarray | None,
    *,
    depth_scale: float | None,
    last_timestamp: float,
    intrinsics: Intrinsics,
    config: Config,
    depth_timestamp: float | None = None,
    timing: SensorTiming = ONE_MOMENT,
    colored: bool = True,
) -> AdmittedFrame:
    """Take in what was passed to `Slam.step`, whose arguments these are.

    Args:
        index: Frame number.
        rgb: As in `Slam.step`.
        depth: As in `Slam.step`.
        timestamp: As in `Slam.step`.
        T_world_camera: As in `Slam.step`.
        depth_scale: As in `Slam.step`.
        last_timestamp: Time of the frame before [s].
        intrinsics: Camera, for the size that the images should have.
        config: Settings.
        depth_timestamp: As in `Slam.step`.
        timing: When the camera's pixels are taken.
        colored: Whether colour is used; if not, a black image is no fault.

    Raises:
        InputError: Misuse, which no other frame would mend.
    """
    time = index / DEFAULT_RATE if timestamp is None else check_number(timestamp, "timestamp")
    depth_time = None if depth_timestamp is None else check_number(depth_timestamp, "depth_timestamp")
    if depth_time is not None and timestamp is None:
        raise InputError(f"frame {index}: depth_timestamp = {depth_time!r} needs the timestamp of the colour image")
    given = None if T_world_camera is None else check_transform(T_world_camera, unknown_is_nan=True)
    needs_pose = config.tracking.use_given_poses
    if needs_pose and given is None:
        raise InputError(f"frame {index}: tracking.use_given_poses is on, but step() got no T_world_camera")
    try:
        rgb, depth = read_images(rgb, depth, intrinsics, config.grid.max_depth, depth_scale, colored=colored)
        if not math.isfinite(time):
            raise FrameError(f"its timestamp is {time}")
        offset = timing.depth_offset(time, depth_time)
        if not abs(offset) <= MAX_DEPTH_OFFSET:
            raise FrameError(
                f"its depth is {offset:.3g} s from its colour image (depth_timestamp); at most {MAX_DEPTH_OFFSET} s "
                "are accepted"
            )
        if given is not None and not np.isfinite(given).all():
            if needs_pose:
                raise FrameError("its T_world_camera holds NaN or infinity, and tracking.use_given_poses is on")
            given = None
        if given is not None and not is_near(given):
            raise FrameError(
                f"its T_world_camera is farther than {MAX_DISTANCE:g} m from the origin; shift the origin of the poses"
            )
    except FrameError as error:
        time = time if math.isfinite(time) else last_timestamp
        nothing = np.zeros((0, 0, 3), np.uint8), np.zeros((0, 0), np.float32)
        return AdmittedFrame(index, time, *nothing, fault=str(error))
    pose = None if given is None else orthonormalized(given)
    return AdmittedFrame(index, time, rgb, depth, pose, offset)


def skipped(frame: AdmittedFrame, last_pose: np.ndarray) -> FrameResult:
    """What is said of a frame with a fault."""
    status = FrameStatus.SKIPPED
    return FrameResult(frame.index, frame.timestamp, last_pose.copy(), status, message=frame.fault)


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
    _check_layout(rgb, depth, size)
    if rgb.shape != (*size, 3):
        raise FrameError(f"rgb has shape {rgb.shape}, expected {(*size, 3)} from the intrinsics")
    if depth.shape != size:
        raise FrameError(f"depth has shape {depth.shape}, expected {size} from the intrinsics")
    rgb = _color(rgb)
    fault = exposure_fault(rgb) if colored else None
    if fault is not None:
        raise FrameError(fault)
    return rgb, _metres(depth, depth_scale, max_depth)


def _check_layout(rgb: np.ndarray, depth: np.ndarray, size: tuple[int, int]) -> None:
    """Refuse images whose axes are in another order, or that have one too many: no other frame would mend that.

    Raises:
        InputError: Names the order.
    """
    height, width = size
    others = {
        (3, height, width): "(3, H, W)",
        (1, height, width, 3): "(1, H, W, 3)",
        (1, 3, height, width): "(1, 3, H, W)",
    }
    if rgb.shape in others:
        raise InputError(
            f"rgb has shape {rgb.shape}, which is {others[rgb.shape]}: pass (H, W, 3), for example "
            f"{'rgb.transpose(1, 2, 0)' if rgb.ndim == 3 else 'rgb[0]'}"
        )
    if depth.ndim > 2 and depth.size == height * width and {1, height, width} == set(depth.shape):
        raise InputError(f"depth has shape {depth.shape}: pass (H, W), for example depth.squeeze()")
    if (width, height) in (rgb.shape[:2], depth.shape) and width != height:
        name, image = ("rgb", rgb) if rgb.shape[:2] == (width, height) else ("depth", depth)
        raise InputError(f"{name} has shape {image.shape}: the first axis is the row, so pass (H, W) = {size}")
    if rgb.dtype.kind == "f" and rgb.size:
        largest = float(np.nan_to_num(rgb, nan=0.0, posinf=0.0, neginf=0.0).max())
        if 2.0 < largest <= 255.5 and rgb.shape == (*size, 3):
            raise InputError(
                f"rgb is {rgb.dtype} with values up to {largest:.4g}: pass uint8, or float in [0, 1] (rgb / 255)"
            )


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
    # A channel at a time: NumPy is slow at sums over an axis of three.
    red, green, blue = (rgb[::4, ::4, channel] for channel in range(3))
    black = (red <= DARKEST) & (green <= DARKEST) & (blue <= DARKEST)
    blown = (red >= BRIGHTEST) & (green >= BRIGHTEST) & (blue >= BRIGHTEST)
    for name, pixels in (("black", black), ("over-exposed", blown)):
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
        depth = depth.astype(np.float32, copy=False)
    usable = (depth > 0) & (depth <= max_depth)  # NaN is neither
    if max_depth > MAX_DISTANCE:
        usable &= depth <= MAX_DISTANCE
    count = np.count_nonzero(usable)
    if count < MIN_DEPTH_PIXELS:
        within = f" within {max_depth:g} m" if math.isfinite(max_depth) else ""
        beyond = depth[np.isfinite(depth) & (depth > max_depth)]
        if beyond.size > MIN_DEPTH_PIXELS and (median := float(np.median(beyond))) > 100.0:
            raise FrameError(f"median depth is {median:.0f} m: is it in millimetres? Depth is in metres (depth / 1000)")
        raise FrameError(f"fewer than {MIN_DEPTH_PIXELS} pixels have depth{within} (only {count} of {depth.size})")
    return np.where(usable, depth, np.float32(0.0))


def check_settings(camera: Intrinsics, config: Config) -> None:
    """Whether settings fit the camera and one another.

    Raises:
        InputError: They leave nothing of an image.
        ConfigError: They contradict one another.
    """
    tracking = config.tracking
    if camera.width <= 2 * tracking.ignore_edge_u or camera.height <= 2 * tracking.ignore_edge_v:
        fit_u, fit_v = camera.width // 16, camera.height // 12
        raise InputError(
            f"tracking.ignore_edge_u = {tracking.ignore_edge_u} and ignore_edge_v = {tracking.ignore_edge_v} "
            f"leave nothing of a {camera.width} x {camera.height} image: lower them, for example with "
            f"--set tracking.ignore_edge_u={fit_u} tracking.ignore_edge_v={fit_v}"
        )
    if tracking.use_given_poses and config.keyframes.policy == "information_gain":
        raise ConfigError("keyframes.policy = information_gain needs tracking; use interval with given poses")
    if not tracking.use_given_poses:
        _check_tracking_loss(config)


def _check_tracking_loss(config: Config) -> None:
    """Whether the other settings have what the terms of Eq. 11-12 need.

    Raises:
        ConfigError: They have not.
    """
    tracking, mapping = config.tracking, config.mapping
    if tracking.coarse_term and tracking.optimizer != "adam":
        raise ConfigError(
            f"tracking.coarse_term is a term of the paper's loss, which tracking.optimizer = {tracking.optimizer} does "
            "not descend: --set tracking.optimizer=adam"
        )
    if tracking.coarse_term and mapping.enabled and not (mapping.coarse and mapping.loss == "rendering"):
        raise ConfigError(
            "tracking.coarse_term needs the coarse level while the camera moves, and here it is formed at the end or "
            "not at all: --set mapping.loss=rendering mapping.coarse=true"
        )
    if tracking.filter_by == "loss" and tracking.optimizer == "direct":
        raise ConfigError("tracking.filter_by = loss needs tracking.optimizer = adam or gauss_newton")
