"""What a pass through the field reads and which gradients it is asked for."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp

from warpslam.camera import Intrinsics
from warpslam.field.packing import PackedDecoder
from warpslam.kernels import dense
from warpslam.kernels.compositing import Box
from warpslam.kernels.grid import Lattice, Level, Vec32
from warpslam.kernels.pixels import Camera
from warpslam.kernels.touched_rows import Touched
from warpslam.runtime.cores import slice_count


@dataclass(frozen=True)
class Thresholds:
    """Work that is skipped; zeros are exact.

    min_weight: Samples that weigh less get no colour: rgb errs by less than samples * min_weight.
    min_gradient: Derivatives of the loss by a logit up to this are dropped.
    min_transmittance: A ray ends where less is left: depth errs by less than this * z_max, and rgb by less than this *
        the brightest colour.
    """

    min_weight: float = 0.0
    min_gradient: float = 0.0
    min_transmittance: float = 0.0


EXACT = Thresholds()


@dataclass
class FieldArrays:
    """What a query of the field reads.

    lattices, features: by level; features are arrays of `Vec32`, one row a vertex.
    decoders: packed weights by level.
    seen: uint8, one a vertex of the colour level: 1 where a mapped frame has measured what is there; None = everywhere.
    low, high: the map's bound [m]; samples on or beyond it are opaque and constant.
    """

    lattices: dict[str, Lattice]
    features: dict[str, wp.array]
    decoders: dict[str, PackedDecoder]
    low: wp.vec3
    high: wp.vec3
    seen: wp.array | None = None

    @property
    def bound(self) -> Box:
        """The map's bound as the kernels take it."""
        return struct(Box, low=self.low, high=self.high)

    @property
    def layout(self) -> str:
        """How the rows are laid out, "dense" or "blocks", which tells the decoder kernels that read them."""
        return "blocks" if any(lattice.shared for lattice in self.lattices.values()) else "dense"

    def lattice(self, name: str) -> Lattice | dense.Lattice:
        """A lattice as the decoder kernels take it."""
        lattice = self.lattices[name]
        if self.layout == "blocks":
            return lattice
        parts = {part: getattr(lattice, part) for part in ("origin", "inverse_spacing", "shape")}
        return struct(dense.Lattice, **parts)

    def level(self, name: str) -> Level | dense.Level:
        """A grid as the decoder kernels take it."""
        kind = Level if self.layout == "blocks" else dense.Level
        return struct(kind, lattice=self.lattice(name), features=self.features[name])


@dataclass
class GridGradient:
    """Gradient of one level: ``buffers`` (slices, places) of `Vec32`, and the ``place`` of each row in them, int
    (rows,), -1 for rows that get none.

    touched: Where the rows that get a gradient are listed in the adjoint, which gives them their places; None = places
        are given.
    """

    buffers: wp.array
    place: wp.array
    touched: Touched | None = None


@dataclass
class Gradients:
    """Which gradients an iteration wants; everything absent is never computed.

    grids: by level.
    points: sample positions, and through them rays and poses.
    color_weights: (slices, rows) buffers of `Vec32` for the colour decoder, or None.
    inliers_move: only those rays reach the poses that `warpslam.field.objectives.choose_inliers` chooses after the
        rendering.
    """

    grids: dict[str, GridGradient] = field(default_factory=dict)
    points: bool = False
    color_weights: wp.array | None = None
    inliers_move: bool = False


def gradient_buffers(row_count: int, device: wp.Device, count: int | None = None) -> wp.array:
    """Zeroed buffers (``count``, row_count) of `Vec32` for the gradient of a grid or of decoder weights; one a slice by
    default.
    """
    return wp.zeros((count or slice_count(device), row_count), dtype=Vec32, device=device)


def lazy_zeros(shape: tuple[int, ...], device: wp.Device) -> wp.array:
    """Zeros of `Vec32`; on the CPU memory is taken where it is written to first, and most rows never are."""
    if device.is_cuda or not all(shape):
        return wp.zeros(shape, dtype=Vec32, device=device)
    return wp.array(np.zeros((*shape, 32), np.float32), dtype=Vec32, device=device, copy=False)


def entries(rows: wp.array) -> wp.array:
    """The same memory with the 32 numbers of a `Vec32` as another axis; it must not outlive ``rows``."""
    return wp.array(ptr=rows.ptr, dtype=float, shape=(*rows.shape, 32), device=rows.device, copy=False)


def struct(kind: Any, **fields: Any) -> Any:
    """A `wp.struct` with these fields. It holds the arrays as they are now: one that is reallocated needs a new one."""
    result = kind()
    for name, value in fields.items():
        setattr(result, name, value)
    return result


def camera_struct(camera: Intrinsics) -> Camera:
    """Focal lengths and principal point [px], as the kernels take them."""
    return struct(Camera, focal=wp.vec2(camera.fx, camera.fy), center=wp.vec2(camera.cx, camera.cy))


def projection(camera: Intrinsics, T_world_camera: np.ndarray) -> list[wp.mat44 | Camera]:
    """What brings world points into an image, as the kernels take it: T_camera_world of a pose (4, 4), and
    `camera_struct`.
    """
    return [wp.mat44(np.linalg.inv(T_world_camera).astype(np.float32)), camera_struct(camera)]
