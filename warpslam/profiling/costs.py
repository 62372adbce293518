"""What a kernel launch computes and moves: points, floating-point operations, bytes.

Operations are counted as `warpslam.complexity` counts them, two a weight and one a bias; the embedding's p B,
sines, interpolation and compositing are left out, so that rates are a little too low rather than too high. An adjoint
costs two operations a weight for the derivative by its inputs, and two for the derivative by the weights.

Decoder kernels skip points: behind the surface, without weight, without gradient. (On the CPU they compute blocks of
four where one is wanted; the others are no useful work and do not count.) On the CPU the points that are
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

from warpslam.complexity import decoder_shapes, flops_per_point
from warpslam.decoders import EMBEDDING_SIZE, FEATURE_SIZE, MAX_HIDDEN

ROW_BYTES = 4 * FEATURE_SIZE


@dataclass(frozen=True)
class Work:
    """What one launch does.

    points: Samples (or queried points) it computes; None for kernels that do not work on samples.
    flop: Floating-point operations, for the decoders only.
    bytes: Read and written, for kernels that do little else; 0 for the others.
    counted: Whether skipped points are left out of ``points``; else it is an upper bound.
    """

    points: int | None = None
    flop: float = 0.0
    bytes: float = 0.0
    counted: bool = True


NOTHING = Work()


class Arguments:
    """Arguments of a launch by name, either packed for the CPU (``values`` ctypes) or as they were given."""

    def __init__(self, kernel: wp.Kernel, values: Sequence[Any], *, readable: bool) -> None:
        self._position = _positions(kernel)
        self._values, self._readable = values, readable

    def number(self, name: str) -> Any:
        """A number."""
        value = self._values[self._position[name]]
        return value.value if hasattr(value, "value") else value

    def shape(self, name: str) -> Sequence[int]:
        """Shape of an array."""
        return self._values[self._position[name]].shape

    def floats(self, name: str, first: int, stop: int, components: int = 1) -> np.ndarray:
        """Rows ``first`` to ``stop`` of a contiguous float array, float32 (rows, components), without a copy.

        Raises:
            KeyError: There is no such argument, or it lies on another device.
        """
        position = self._position[name]
        if not self._readable:
            raise KeyError(name)
        rows = max(stop - first, 0)
        address = self._values[position].data + 4 * components * first
        return np.ctypeslib.as_array((ctypes.c_float * (rows * components)).from_address(address)).reshape(
            rows, components
        )


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
        every = arguments.number("point_count")
        try:
            points = _forward_points(every, arguments, level == "color")
        except KeyError:
            return Work(every, each * every, counted=False)
        return Work(points, each * points)

    return work


def _forward_points(every: int, arguments: Arguments, weighted: bool) -> int:
    """Samples on rays that are not spent yet, and for colour those that weigh something."""
    first, width = arguments.number("first_ray"), arguments.number("width")
    rays = every // width
    transmittance = arguments.floats("transmittance", first, first + rays)
    going = transmittance[:, 0] >= arguments.number("min_transmittance")
    if not weighted:
        return int(np.count_nonzero(going)) * width
    count, sample = arguments.number("sample_count"), arguments.number("first_sample")
    weight = arguments.floats("weight", first * count, (first + rays) * count).reshape(rays, count)
    weight = weight[going, sample : sample + width]
    return int(np.count_nonzero(weight >= arguments.number("min_weight")))


def _backward(gradient: str, components: int, level: str | None = None) -> Model:
    """Adjoint kernel that skips points whose ``gradient`` is not above "min_gradient" (0 if it has none)."""

    def work(threads: int, arguments: Arguments) -> Work:
        each = backward_flops(
            level or _level_of(arguments),
            points=bool(_optional(arguments, "want_point")),
            weights=bool(_optional(arguments, "want_weights")),
        )
        every = arguments.number("point_count")
        try:
            start = arguments.number("start")
            values = arguments.floats(gradient, start, start + every, components)
            points = int(np.count_nonzero((np.abs(values) > _optional(arguments, "min_gradient")).any(axis=1)))
        except KeyError:
            return Work(every, each * every, counted=False)
        return Work(points, each * points)

    return work


def _optional(arguments: Arguments, name: str) -> Any:
    try:
        return arguments.number(name)
    except KeyError:
        return 0


def _level_of(arguments: Arguments) -> str:
    from warpslam.kernels.decoder import OUT_64

    return "fine" if arguments.number("output_row") == OUT_64 else "middle"


def _sum_of_color_weights(threads: int, arguments: Arguments) -> Work:
    points = arguments.number("point_count")
    shapes = decoder_shapes("color").items()
    each = 2 * sum(math.prod(shape) for name, shape in shapes if name.endswith("weight"))
    return Work(points, each * points, counted=False)


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
    **{f"{level}_forward": _forward(level) for level in ("coarse", "middle", "fine", "color")},
    "geometry_backward": _backward("logit_grad", 1),
    "coarse_backward": _backward("logit_grad", 1, "coarse"),
    "color_backward": _backward("color_grad", 3, "color"),
    "color_weights": _sum_of_color_weights,
    "composite": _samples("width"),
    **{
        name: _samples("sample_count")
        for name in (
            "ray_variance",
            "composite_color",
            "composite_backward",
            "surface_depth",
            "collect_ray_gradients",
            "ray_derivatives",
            "ray_jacobians",
        )
    },  # fmt: skip
    "adam_rows": _adam_rows,
    "clear_moments": _rows(2),
    "transpose_color_weights": _rows(2),
    "fill_grid": _rows(2),
}
