"""Pinhole camera. Axes are OpenCV's: x right, y down, z forward. Lengths are metres."""

from __future__ import annotations

from dataclasses import dataclass, replace
from numbers import Real
from typing import Any

import numpy as np

from warpslam.errors import ConfigError, InputError

MAX_IMAGE_SIZE = 16384
"""Largest width and height of an image [px]: what OpenCV warps without trouble."""
MIN_FOCAL, MAX_PIXELS = 1e-2, 1e7
"""Least focal length, and largest one and coordinate of a principal point [px]."""
_ABSURD = 1e300


def is_number(value: Any) -> bool:
    """Whether it is a finite number, and none that is absurd.

    (`numpy.isfinite` raises for what is no number, and for whole ones of more than 64 bits.)
    """
    if not isinstance(value, Real) or isinstance(value, bool):
        return False
    number: Any = value
    return bool(abs(number) < _ABSURD)


@dataclass(frozen=True)
class Intrinsics:
    """Pinhole intrinsics in pixels; pixel centres lie at integer coordinates, as in the authors' released code."""

    fx: float
    """Focal length along a row [px]."""
    fy: float
    """Focal length along a column [px]."""
    cx: float
    """Column of the principal point [px]."""
    cy: float
    """Row of the principal point [px]."""
    width: int
    """Columns of the image."""
    height: int
    """Rows of the image."""

    def __post_init__(self) -> None:
        for name in ("fx", "fy", "cx", "cy", "width", "height"):
            value = getattr(self, name)
            if not is_number(value):
                raise ConfigError(f"camera.{name} = {value!r} must be a finite number")
        for name in ("fx", "fy", "width", "height"):
            value = getattr(self, name)
            if value <= 0:
                raise ConfigError(f"camera.{name} = {value!r} must be a positive number")
        for name in ("width", "height"):
            value = getattr(self, name)
            if value != int(value) or value > MAX_IMAGE_SIZE:
                raise ConfigError(
                    f"camera.{name} = {value!r} must be a whole number of at most {MAX_IMAGE_SIZE} pixels"
                )
            object.__setattr__(self, name, int(value))
        for name in ("fx", "fy"):
            if not MIN_FOCAL <= getattr(self, name) <= MAX_PIXELS:
                raise ConfigError(
                    f"camera.{name} = {getattr(self, name)!r} must be {MIN_FOCAL:g} to {MAX_PIXELS:g} pixels"
                )
        for name in ("cx", "cy"):
            if abs(getattr(self, name)) > MAX_PIXELS:
                raise ConfigError(
                    f"camera.{name} = {getattr(self, name)!r} must be finite, at most {MAX_PIXELS:g} pixels"
                )

    @property
    def matrix(self) -> np.ndarray:
        """Camera matrix K, shape (3, 3), float64."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @classmethod
    def from_matrix(cls, K: np.ndarray, width: int, height: int) -> Intrinsics:
        """Intrinsics of a camera matrix K (3, 3) of images of ``width`` x ``height`` pixels.

        Raises:
            InputError: K is no 3x3 matrix of a pinhole without skew.
            ConfigError: A focal length or a size is not positive.
        """
        K = np.asarray(K, dtype=np.float64)
        if K.shape != (3, 3):
            raise InputError(f"K has shape {K.shape}, expected (3, 3)")
        scale = K[2, 2]
        if abs(scale) < 1e-12 or np.abs(K[2, :2]).max() > 1e-9 * abs(scale):
            raise InputError("K has no last row 0 0 1: is it transposed, or a projection matrix?")
        K = K / scale
        if abs(K[0, 1]) > 1e-3 * abs(K[0, 0]) or abs(K[1, 0]) > 1e-9:
            raise InputError(f"K has skew {K[0, 1]:g}, which no camera of today has; pass a pinhole matrix")
        return cls(float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]), width, height)

    def backproject(self, u: np.ndarray, v: np.ndarray, z: np.ndarray | float) -> np.ndarray:
        """Points [m] in the camera's frame of columns, rows and z-depths [m] of one shape (...), shape (..., 3).

        With z = 1 these are the rays of the pixels.
        """
        x, y = (u - self.cx) / self.fx * z, (v - self.cy) / self.fy * z
        return np.stack([x, y, np.broadcast_to(z, x.shape)], axis=-1)

    def project(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Column and row [px] of points [m] in the camera's frame, given by coordinate; z must not be 0."""
        return self.fx * x / z + self.cx, self.fy * y / z + self.cy

    def scaled(self, width: int, height: int) -> Intrinsics:
        """Intrinsics of the same camera after resizing the image to ``width`` x ``height`` pixels."""
        sx, sy = width / self.width, height / self.height
        return Intrinsics(self.fx * sx, self.fy * sy, self.cx * sx, self.cy * sy, width, height)

    def strided(self, stride: int) -> Intrinsics:
        """Intrinsics of the image that keeps every ``stride``-th row and column, from the first on."""
        width, height = -(-self.width // stride), -(-self.height // stride)
        return Intrinsics(self.fx / stride, self.fy / stride, self.cx / stride, self.cy / stride, width, height)

    def cropped(self, border: int) -> Intrinsics:
        """Intrinsics after cutting ``border`` pixels from every side."""
        return Intrinsics(
            self.fx, self.fy, self.cx - border, self.cy - border, self.width - 2 * border, self.height - 2 * border
        )


MAX_DEPTH_DELAY = 0.2
MAX_READOUT = 0.2


@dataclass(frozen=True)
class SensorTiming:
    """When a camera sees what its images show; all 0 for images whose pixels are taken at one moment, as rendered ones
    are.

    The pose of a frame is that at the middle row of its colour image.
    """

    depth_delay: float = 0.0
    """Time of depth minus that of colour [s], beyond the difference of their stamps: negative if depth is older."""
    readout: float = 0.0
    """Time from the first to the last row, of colour and depth alike [s]; 0 = global shutter."""

    def __post_init__(self) -> None:
        if not is_number(self.depth_delay) or abs(self.depth_delay) > MAX_DEPTH_DELAY:
            raise ConfigError(
                f"camera.depth_delay = {self.depth_delay!r} must be -{MAX_DEPTH_DELAY} to {MAX_DEPTH_DELAY} seconds"
            )
        if not is_number(self.readout) or not 0 <= self.readout <= MAX_READOUT:
            raise ConfigError(f"camera.readout = {self.readout!r} must be 0 to {MAX_READOUT} seconds")

    def depth_offset(self, timestamp: float, depth_timestamp: float | None) -> float:
        """tau = t_depth - t_colour [s] of a frame with these stamps [s]; without a stamp of depth, the delay alone."""
        stamped = 0.0 if depth_timestamp is None else depth_timestamp - timestamp
        return stamped + self.depth_delay

    def since(self, before: SensorTiming) -> TimingChange:
        """What it adds to another timing."""
        return TimingChange(self.depth_delay - before.depth_delay, self.readout - before.readout)


@dataclass(frozen=True)
class TimingChange:
    """Difference of two timings."""

    depth_delay: float
    """[s]."""
    readout: float
    """[s]."""

    @property
    def is_none(self) -> bool:
        """Whether there is none."""
        return self.depth_delay == 0.0 and self.readout == 0.0


MAX_TWIST = 1e3
"""No camera moves faster, [m/s] and [rad/s]."""
MAX_DEPTH_OFFSET = 0.5
"""Depth is taken within this time [s] of its colour image, by the stamps."""

ONE_MOMENT = SensorTiming()
"""All pixels of a frame are taken at once."""


@dataclass(frozen=True)
class FrameMotion:
    """How the camera moved while it took a frame, and for how long it took it."""

    twist: tuple[float, ...] = (0.0,) * 6
    """u = (v, w) in the camera's axes [m/s, rad/s]: T_world_camera(t + dt) = T_world_camera(t) exp(u dt)."""
    depth_offset: float = 0.0
    """tau, time of the depth image minus that of the colour image [s]."""
    readout: float = 0.0
    """Time from the first to the last row [s]."""

    @property
    def is_none(self) -> bool:
        """Whether images show what they would if the camera stood still."""
        return not any(self.twist) or (self.depth_offset == 0.0 and self.readout == 0.0)

    def with_twist(self, twist: np.ndarray) -> FrameMotion:
        """The same frame, taken with another twist (6,) [m/s, rad/s]."""
        return replace(self, twist=tuple(float(value) for value in twist))

    def retimed(self, change: TimingChange) -> FrameMotion:
        """The same frame, taken by a camera of another timing."""
        return replace(self, depth_offset=self.depth_offset + change.depth_delay, readout=self.readout + change.readout)

    @property
    def is_possible(self) -> bool:
        """Whether a camera can have moved so: what a file says must be."""
        return (
            bool((np.abs(self.twist) <= MAX_TWIST).all())
            and abs(self.depth_offset) <= MAX_DEPTH_OFFSET + MAX_DEPTH_DELAY
            and 0 <= self.readout <= MAX_READOUT
        )

    def to_array(self) -> np.ndarray:
        """Twist, depth_offset and readout, float64 (8,)."""
        return np.array([*self.twist, self.depth_offset, self.readout])

    @classmethod
    def from_array(cls, values: np.ndarray) -> FrameMotion:
        """What `to_array` gave."""
        *twist, depth_offset, readout = values.tolist()
        return cls(tuple(twist), depth_offset, readout)


NO_MOTION = FrameMotion()


def check_number(value: float, name: str) -> float:
    """Return ``value`` as a float, NaN and infinity included, or raise `InputError`."""
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{name} = {value!r} is no number") from error
