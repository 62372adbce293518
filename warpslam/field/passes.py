"""Passes through the field: occupancy and colour of samples (Eq. 1-5), rendering (Eq. 6-7), and the adjoint of both."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import warp as wp

from warpslam.field.arrays import EXACT, FieldArrays, Gradients, Thresholds, struct
from warpslam.field.ray_batch import RayBatch
from warpslam.kernels import compositing, rays
from warpslam.kernels.compositing import Listed
from warpslam.kernels.decoder.layout import COLOR_WEIGHT_ROWS, OUT_32, OUT_64, RowGradient, WeightGradient, Weights
from warpslam.kernels.samples import Span
from warpslam.runtime.launching import Step
from warpslam.runtime.program import run_slices


def query(batch: RayBatch, arrays: FieldArrays, stage: str) -> None:
    """Logit (and colour, in the colour stage) of every sample: `RayBatch.logit`, `RayBatch.color`."""

    def steps(first: int, stop: int, slot: int) -> list[Step]:
        result = [_start(batch, first, stop, slot)]
        result += _logits(batch, arrays, stage, first, stop, 0, batch.sample_count, EXACT)
        if stage == "color":
            result += _colors(batch, arrays, first, stop, slot, 0.0)
        return result

    batch.launcher.slices(batch.count, steps)


def render(
    batch: RayBatch,
    arrays: FieldArrays,
    stage: str,
    gradients: Gradients | None = None,
    tape: wp.Tape | None = None,
    *,
    thresholds: Thresholds = EXACT,
) -> None:
    """Depth, colour and variance of every ray (Eq. 6-7).

    gradients, tape: What to differentiate, and the tape that gets the adjoint; both or neither.
    """
    if gradients is not None and tape is None:
        raise ValueError("gradients are recorded on a tape: pass the active one")
    weights = None if gradients is None else gradients.color_weights
    if weights is not None:
        batch.make_room_for_activations()
    samples = batch.sample_count
    width = batch.kernels.group_size if thresholds.min_transmittance > 0 else samples

    def steps(first: int, stop: int, slot: int) -> list[Step]:
        ray_count = stop - first
        result = [_start(batch, first, stop, slot)]
        for sample in range(0, samples, width):
            group = min(width, samples - sample)
            result += _logits(batch, arrays, stage, first, stop, sample, group, thresholds)
            inputs = [first, sample, group, thresholds.min_transmittance, arrays.bound, batch.rays, batch.rendered]
            result.append((compositing.composite, ray_count, [*inputs, batch.transmittance, batch.depth]))
        inputs = [first, batch.rays, batch.keep, batch.weight, batch.depth, batch.variance]
        result.append((compositing.ray_variance, ray_count, inputs))
        if stage == "color":
            result += _colors(batch, arrays, first, stop, slot, thresholds.min_weight, weights)
            inputs = [first, samples, batch.keep, batch.color, batch.weight, batch.rgb]
            result.append((compositing.composite_color, ray_count, inputs))
        return result

    batch.launcher.slices(batch.count, steps)
    if gradients is not None and tape is not None:
        tape.record_func(_adjoint(batch, arrays, stage, gradients, thresholds), [batch.depth, batch.rgb])


def take_surface_depth(batch: RayBatch, min_occupancy: float) -> None:
    """After `render`: replace the mean depth of each ray by that of its first sample with ``min_occupancy``."""
    inputs = [batch.rays, batch.keep, batch.rendered, min_occupancy, batch.depth]
    batch.launcher.launch(compositing.surface_depth, batch.count, inputs)


def steep_samples(batch: RayBatch, first: int, stop: int, slot: int, min_gradient: float) -> Step:
    """List the samples of some rays whose logit has a gradient beyond ``min_gradient``."""
    inputs = [first, steep_list(batch, first, slot), batch.sample_count, batch.logit_grad, min_gradient]
    return (compositing.list_steep, stop - first, inputs)


def steep_list(batch: RayBatch, first: int, slot: int) -> Listed:
    """A slice's samples whose logit has a gradient."""
    return _listed(batch, first, slot, batch.steep, batch.steep_count)


def geometry_adjoint(
    batch: RayBatch, arrays: FieldArrays, level: str, gradients: Gradients, first: int, stop: int, slot: int
) -> Step:
    """From the gradient of the logits to that of a level's features, and of the points."""
    dim = batch.kernels.thread_count((stop - first) * batch.sample_count)
    inputs = [steep_list(batch, first, slot), batch.rays, arrays.level(level), _weights(batch, arrays, level)]
    if level == "coarse":
        inputs += [batch.logit_grad, _grid_gradient(batch, gradients, level)]
        return (batch.kernels.coarse_backward, dim, inputs)
    inputs += [OUT_64 if level == "fine" else OUT_32, batch.logit_grad, _grid_gradient(batch, gradients, level)]
    return (batch.kernels.geometry_backward, dim, [*inputs, int(gradients.points), batch.point_grad])


def color_adjoint(
    batch: RayBatch,
    arrays: FieldArrays,
    gradients: Gradients,
    first: int,
    stop: int,
    slot: int,
    point_grad: wp.array,
) -> Step:
    """From the gradient of the samples' colours to that of the features, of the points, and of the weights."""
    blocks = batch.kernels.color_blocks
    inputs = [_listed(batch, first, slot, batch.weighty, batch.weighty_count), blocks, batch.rays]
    inputs += [arrays.level("color"), _weights(batch, arrays, "color"), batch.color_grad]
    inputs += [_grid_gradient(batch, gradients, "color"), int(gradients.points), point_grad]
    inputs += [_weight_gradient(batch, gradients.color_weights)]
    threads = -(-batch.kernels.thread_count((stop - first) * batch.sample_count) // blocks)
    return (batch.kernels.color_backward, threads, inputs)


def _start(batch: RayBatch, first: int, stop: int, slot: int) -> Step:
    listed = _listed(batch, first, slot, batch.weighty, batch.weighty_count)
    inputs = [first, listed, batch.keep, batch.transmittance, batch.depth, batch.variance, batch.rgb]
    return (compositing.start_rays, stop - first, inputs)


def _logits(
    batch: RayBatch,
    arrays: FieldArrays,
    stage: str,
    first: int,
    stop: int,
    sample: int,
    width: int,
    thresholds: Thresholds,
) -> list[Step]:
    """Occupancy logits (Eq. 1-3) of some samples of the rays ``first`` to ``stop``."""
    kernels, count = batch.kernels, (stop - first) * width
    dim = kernels.thread_count(count)
    span = struct(Span, point_count=count, first_ray=first, first_sample=sample, width=width)
    points = [span, thresholds.min_transmittance, batch.transmittance, batch.rays]
    weights = partial(_weights, batch, arrays)
    if stage == "coarse":
        return [(kernels.coarse_forward, dim, [*points, arrays.level("coarse"), weights("coarse"), batch.logit])]
    inputs = [*points, arrays.level("middle"), weights("middle"), batch.logit]
    steps: list[Step] = [(kernels.middle_forward, dim, inputs)]
    if stage != "middle":
        inputs = [*points, arrays.level("fine"), arrays.level("middle"), weights("fine"), batch.logit]
        steps.append((kernels.fine_forward, dim, inputs))
    return steps


def _colors(
    batch: RayBatch,
    arrays: FieldArrays,
    first: int,
    stop: int,
    slot: int,
    min_weight: float,
    weight_gradient: wp.array | None = None,
) -> list[Step]:
    """Colour (Eq. 5) of the samples that weigh at least ``min_weight``."""
    samples = batch.sample_count
    dim = batch.kernels.thread_count((stop - first) * samples)
    listed = _listed(batch, first, slot, batch.weighty, batch.weighty_count)
    choose = [first, listed, samples, batch.keep, batch.weight, min_weight, batch.color]
    inputs = [listed, batch.rays, arrays.level("color"), _weights(batch, arrays, "color")]
    inputs += [_weight_gradient(batch, weight_gradient), batch.color]
    return [(compositing.list_weighty, stop - first, choose), (batch.kernels.color_forward, dim, inputs)]


def _adjoint(
    batch: RayBatch, arrays: FieldArrays, stage: str, gradients: Gradients, thresholds: Thresholds
) -> Callable[[], None]:
    """The backward pass of `render` as a function that replays its launches."""
    want_weights = gradients.color_weights is not None

    def steps(first: int, stop: int, slot: int) -> list[Step]:
        inputs = [first, steep_list(batch, first, slot), batch.rays, batch.keep, batch.rendered, int(stage == "color")]
        inputs += [thresholds.min_weight, batch.depth.grad, batch.rgb.grad, batch.logit_grad, batch.color_grad]
        result: list[Step] = [(compositing.composite_backward, stop - first, inputs)]
        result.append(steep_samples(batch, first, stop, slot, thresholds.min_gradient))
        levels = {"coarse": ("coarse",), "middle": ("middle",)}.get(stage, ("middle", "fine"))
        for level in levels:
            if gradients.points or level in gradients.grids:
                result.append(geometry_adjoint(batch, arrays, level, gradients, first, stop, slot))
        if stage == "color" and (gradients.points or want_weights or "color" in gradients.grids):
            result.append(color_adjoint(batch, arrays, gradients, first, stop, slot, batch.point_grad))
        if gradients.points:
            counts = batch.inlier if gradients.inliers_move else batch.keep
            inputs = [first, batch.rays, batch.keep, counts, batch.point_grad]
            inputs += [batch.origin.grad, batch.direction.grad]
            result.append((rays.collect_ray_gradients, stop - first, inputs))
        return result

    commands = batch.launcher.slice_commands(batch.count, steps)
    last: list[wp.Launch] = []
    if want_weights and stage == "color" and batch.kernels.sums_weights_apart:
        chunk, points = 256, batch.count * batch.sample_count
        inputs = [points, chunk, batch.rays, _weights(batch, arrays, "color"), batch.color_grad]
        inputs.append(_weight_gradient(batch, gradients.color_weights))
        dim = (-(-points // chunk), COLOR_WEIGHT_ROWS)
        last.append(batch.launcher.command(batch.kernels.color_weights, dim, inputs))

    def run() -> None:
        run_slices(commands)
        for command in last:
            command.launch()

    return run


def _listed(batch: RayBatch, first: int, slot: int, samples: wp.array, counts: wp.array) -> Listed:
    return struct(Listed, start=first * batch.sample_count, slot=slot, samples=samples, counts=counts)


def _weights(batch: RayBatch, arrays: FieldArrays, level: str) -> Weights:
    packed = arrays.decoders[level]
    return struct(Weights, W=packed.weights, T=packed.transposed, bits=batch.bits[level])


def _grid_gradient(batch: RayBatch, gradients: Gradients, level: str) -> RowGradient:
    wanted = gradients.grids.get(level)
    if wanted is None:
        return struct(RowGradient, wanted=0, selected=batch.no_selection, rows=batch.no_rows)
    return struct(RowGradient, wanted=1, selected=wanted.selected, rows=wanted.buffers)


def _weight_gradient(batch: RayBatch, rows: wp.array | None) -> WeightGradient:
    return struct(
        WeightGradient,
        wanted=int(rows is not None),
        rows=batch.no_rows if rows is None else rows,
        activations=batch.activations,
        layer_grad=batch.layer_grad,
        layer_inputs=batch.layer_inputs,
    )
