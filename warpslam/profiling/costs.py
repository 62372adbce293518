"""What a kernel launch computes and moves: points, floating-point operations, bytes.

Operations are counted as `warpslam.field.complexity` counts them, two a weight and one a bias; the embedding's p B,
sines, interpolation and compositing are left out, so that rates are a little too low rather than too high. An adjoint
costs two operations a weight for the derivative by its inputs, and two for the derivative by the weights.

Decoder kernels skip points: behind the surface, without weight, without gradient. On the CPU the points that are
computed are counted from the arrays the kernel is about to read; where that can't be done, all of them count and
`Work.counted` says so.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from warpslam.field.complexity import decoder_shapes, flops_per_point
from warpslam.field.decoders import EMBEDDING_SIZE, FEATURE_SIZE, MAX_HIDDEN
from warpslam.kernels.compositing import COUNT_STRIDE
from warpslam.kernels.decoder.layout import OUT_64

ROW_BYTES = 4 * FEATURE_SIZE


@dataclass(frozen=True)
class Work:
    """What one launch does."""

    points: int | None = None
    """Samples (or queried points) it computes; None for kernels that do not work on samples."""
    flop: float = 0.0
    """Floating-point operations, for the decoders only."""
    bytes: float = 0.0
    """Read and written, for kernels that do little else; 0 for the others."""
    counted: bool = True
    """Whether skipped points are left out of ``points``; else it is an upper bound."""


NOTHING = Work()


class Arguments:
    """Arguments of a launch by name, fields of structs as ``argument.field``.

    They are packed for the CPU (``values`` ctypes), or as they were given.
    """

    def __init__(self, kernel: wp.Kernel, values: Sequence[Any], *, readable: bool) -> None:
        self._position = _positions(kernel)
        self._values, self._readable = values, readable

    def number(self, name: str) -> Any:
        """A number."""
        value = self._find(name)
        return value.value if hasattr(value, "value") else value

    def shape(self, name: str) -> Sequence[int]:
        """Shape of an array."""
        return self._find(name).shape

    def floats(self, name: str, first: int, stop: int) -> np.ndarray:
        """Entries ``first`` to ``stop`` of a contiguous float32 array, without a copy.

        Raises:
            KeyError: There is no such argument, or it lies on another device.
        """
        return np.ctypeslib.as_array((ctypes.c_float * max(stop - first, 0)).from_address(self._address(name, first)))

    def integer(self, name: str, index: int) -> int:
        """An entry of a contiguous int32 array.

        Raises:
            KeyError: There is no such argument, or it lies on another device.
        """
        return ctypes.c_int32.from_address(self._address(name, index)).value

    def _address(self, name: str, index: int) -> int:
        value = self._find(name)
        if not self._readable:
            raise KeyError(name)
        return value.data + 4 * index

    def _find(self, name: str) -> Any:
        argument, *fields = name.split(".")
        value = self._values[self._position[argument]]
        for part in fields:
            value = getattr(value, part)
        return value


@cache
def _positions(kernel: wp.Kernel) -> dict[str, int]:
    return {argument.label: n for n, argument in enumerate(kernel.adj.args)}


@cache
def backward_flops(level: str, *, points: bool, weights: bool) -> int:
    """Operations of a decoder's adjoint at one point.

    The derivative by the level's own feature is always formed; what the fine level gets from the middle feature has
    none (see `warpslam.kernels.decoder`).

    Args:
        level: "coarse", "middle", "fine" or "color".
        points: Also by the sample position, through the embedding.
        weights: Also by every weight.
    """
    shapes = {name: shape for name, shape in decoder_shapes(level).items() if name.endswith("weight")}
    hidden = MAX_HIDDEN
    count = 0
    for name, (size_out, size_in) in shapes.items():
        if name.startswith("fc_c"):
            count += size_out * FEATURE_SIZE
        elif name == "pts_linears.0.weight" and level != "coarse":
            count += 0
        elif name == "pts_linears.3.weight" and level != "coarse":
            count += size_out * hidden
        else:
            count += size_out * size_in
    if points and level != "coarse":
        count += 2 * hidden * EMBEDDING_SIZE
    if weights:
        count += sum(math.prod(shape) for shape in shapes.values())
    return 2 * count


def work_of(kernel: wp.Kernel, adjoint: bool, threads: int, arguments: Arguments) -> Work:
    """Work of a launch that is about to happen."""
    model = None if adjoint else _MODELS.get(kernel.key)
    return NOTHING if model is None else model(threads, arguments)


Model = Callable[[int, Arguments], Work]


def _forward(level: str) -> Model:
    each = flops_per_point(level)

    def work(threads: int, arguments: Arguments) -> Work:
        every = arguments.number("span.point_count")
        try:
            points = _points_of_going_rays(every, arguments)
        except KeyError:
            return Work(every, each * every, counted=False)
        return Work(points, each * points)

    return work


def _points_of_going_rays(every: int, arguments: Arguments) -> int:
    """Samples on rays that are not spent yet."""
    first, width = arguments.number("span.first_ray"), arguments.number("span.width")
    transmittance = arguments.floats("transmittance", first, first + every // width)
    return int(np.count_nonzero(transmittance >= arguments.number("min_transmittance"))) * width


def _color_forward(threads: int, arguments: Arguments) -> Work:
    return _listed(flops_per_point("color"), threads, arguments)


def _backward(level: str | None = None) -> Model:
    """Adjoint kernel over listed samples; for colour, those without a gradient are few and count."""

    def work(threads: int, arguments: Arguments) -> Work:
        each = backward_flops(
            level or _level_of(arguments),
            points=bool(_optional(arguments, "want_point")),
            weights=bool(_optional(arguments, "weights.wanted")),
        )
        return _listed(each, threads, arguments)

    return work


def _listed(each: int, threads: int, arguments: Arguments) -> Work:
    """Work on the samples of a list; where its length can't be read, one a thread."""
    try:
        points = arguments.integer("listed.counts", COUNT_STRIDE * arguments.number("listed.slot"))
    except KeyError:
        return Work(threads, each * threads, counted=False)
    return Work(points, each * points)


def _optional(arguments: Arguments, name: str) -> Any:
    try:
        return arguments.number(name)
    except KeyError:
        return 0


def _level_of(arguments: Arguments) -> str:
    return "fine" if arguments.number("output_row") == OUT_64 else "middle"


def _sum_of_color_weights(threads: int, arguments: Arguments) -> Work:
    shapes = decoder_shapes("color").items()
    return _listed(2 * sum(math.prod(shape) for name, shape in shapes if name.endswith("weight")), threads, arguments)


def _samples(name: str) -> Model:
    """One thread a ray, which visits as many samples as the argument ``name`` says."""

    def work(threads: int, arguments: Arguments) -> Work:
        return Work(threads * arguments.number(name), counted=False)

    return work


def _rows(per_thread: int) -> Model:
    """One thread a row of features, which moves that many rows."""

    def work(threads: int, arguments: Arguments) -> Work:
        return Work(bytes=threads * per_thread * ROW_BYTES)

    return work


def _adam_rows(threads: int, arguments: Arguments) -> Work:
    """Reads and clears each slice's gradient; reads and writes both moments and the row."""
    return Work(bytes=threads * (2 * arguments.shape("grad")[0] + 6) * ROW_BYTES)


_MODELS: dict[str, Model] = {
    **{f"{level}_forward": _forward(level) for level in ("coarse", "middle", "fine")},
    "color_forward": _color_forward,
    "geometry_backward": _backward(),
    "coarse_backward": _backward("coarse"),
    "color_backward": _backward("color"),
    "color_weights": _sum_of_color_weights,
    "composite": _samples("width"),
    **{
        name: _samples("rays.sample_count")
        for name in (
            "ray_variance",
            "composite_backward",
            "surface_depth",
            "collect_ray_gradients",
            "ray_derivatives",
            "ray_jacobians",
        )
    },  # fmt: skip
    **{name: _samples("sample_count") for name in ("composite_color", "list_weighty", "list_steep")},
    "adam_rows": _adam_rows,
    "clear_moments": _rows(2),
    "transpose_color_weights": _rows(2),
    "fill_grid": _rows(2),
    "fill_blocks": _rows(2),
}
