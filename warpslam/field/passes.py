"""Passes through the field: occupancy and colour of samples (Eq. 1-5), rendering (Eq. 6-7), and the adjoint of both."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from types import SimpleNamespace

import warp as wp

from warpslam.field.arrays import EXACT, FieldArrays, Gradients, Thresholds, entries, struct
from warpslam.field.ray_batch import RayBatch
from warpslam.kernels import by_sample, compositing, rays, touched_rows
from warpslam.kernels.compositing import Listed
from warpslam.kernels.decoder.build import decoders_for
from warpslam.kernels.decoder.layout import OUT_32, OUT_64, RUN, WEIGHT_SECTIONS, RowGradient, WeightGradient, Weights
from warpslam.kernels.samples import Span
from warpslam.runtime.launching import Step
from warpslam.runtime.program import run_slices


def query(batch: RayBatch, arrays: FieldArrays, stage: str) -> None:
    """Logit (and colour, in the colour stage) of every sample: `RayBatch.logit`, `RayBatch.color`."""

    def steps(first: int, stop: int, slot: int) -> list[Step]:
        result = [begin_rays(batch, first, stop, slot)]
        result += logits(batch, arrays, stage, first, stop, 0, batch.sample_count, EXACT)
        if stage == "color":
            result.append(_weighty_samples(batch, first, stop, slot, 0.0))
            result.append(color_forward(batch, arrays, first, stop, slot))
        return result

    batch.launcher.slices(batch.count, steps, whole=batch.kernels.by_sample)


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
    if gradients is not None and gradients.grids:
        batch.make_room_for_feature_gradients()
    weigh = _weigh_by_sample if batch.kernels.by_sample else _weigh_by_ray

    def steps(first: int, stop: int, slot: int) -> list[Step]:
        result = [begin_rays(batch, first, stop, slot), *weigh(batch, arrays, stage, first, stop, slot, thresholds)]
        if stage == "color":
            result.append(color_forward(batch, arrays, first, stop, slot, weights))
            inputs = [first, batch.sample_count, batch.keep, batch.color, batch.weight, batch.rgb]
            result.append((compositing.composite_color, stop - first, inputs))
        return result

    batch.launcher.slices(batch.count, steps, whole=batch.kernels.by_sample)
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


def color_list(batch: RayBatch, first: int, slot: int) -> Listed:
    """A slice's samples that need colour."""
    return _listed(batch, first, slot, batch.weighty, batch.weighty_count)


def steep_list(batch: RayBatch, first: int, slot: int) -> Listed:
    """A slice's samples whose logit has a gradient."""
    return _listed(batch, first, slot, batch.steep, batch.steep_count)


def geometry_adjoint(
    batch: RayBatch, arrays: FieldArrays, level: str, gradients: Gradients, first: int, stop: int, slot: int
) -> list[Step]:
    """From the gradient of the logits to that of a level's features, and of the points."""
    listed = steep_list(batch, first, slot)
    dim = batch.kernels.thread_count((stop - first) * batch.sample_count)
    inputs = [listed, batch.rays, arrays.level(level), _weights(batch, arrays, level)]
    scatter = _scatter(batch, arrays, level, gradients, listed, stop - first)
    if level == "coarse":
        inputs += [batch.logit_grad, _grid_gradient(batch, gradients, level), int(gradients.points), batch.point_grad]
        return [(_kernels(batch, arrays).coarse_backward, dim, inputs), *scatter]
    inputs += [OUT_64 if level == "fine" else OUT_32, batch.logit_grad, _grid_gradient(batch, gradients, level)]
    inputs += [int(gradients.points), batch.point_grad]
    return [(_kernels(batch, arrays).geometry_backward, dim, inputs), *scatter]


def color_adjoint(
    batch: RayBatch,
    arrays: FieldArrays,
    gradients: Gradients,
    first: int,
    stop: int,
    slot: int,
    point_grad: wp.array,
) -> list[Step]:
    """From the gradient of the samples' colours to that of the features, of the points, and of the weights."""
    blocks = batch.kernels.color_blocks
    listed = color_list(batch, first, slot)
    weights = _weight_gradient(batch, gradients.color_weights)
    inputs = [listed, blocks, batch.rays, arrays.level("color"), _weights(batch, arrays, "color"), batch.color_grad]
    inputs += [_grid_gradient(batch, gradients, "color"), int(gradients.points), point_grad, weights]
    threads = -(-batch.kernels.thread_count((stop - first) * batch.sample_count) // blocks)
    result: list[Step] = [(_kernels(batch, arrays).color_backward, threads, inputs)]
    result += _scatter(batch, arrays, "color", gradients, listed, stop - first)
    if gradients.color_weights is not None and batch.kernels.by_sample:
        dim = (gradients.color_weights.shape[0], WEIGHT_SECTIONS, 32)
        result.append((_kernels(batch, arrays).color_weights, dim, [listed, batch.rays, batch.color_grad, weights]))
    return result


def collect_rays(batch: RayBatch, gradients: Gradients, first: int, stop: int) -> Step:
    """From the gradient of the points to that of the rays."""
    counts = batch.inlier if gradients.inliers_move else batch.keep
    inputs = [batch.rays, batch.keep, counts, batch.point_grad, batch.origin.grad, batch.direction.grad]
    if batch.kernels.by_sample:
        return (by_sample.collect_ray_gradients, (stop - first, by_sample.PARTS), inputs)
    return (rays.collect_ray_gradients, stop - first, [first, *inputs])


def _scatter(
    batch: RayBatch, arrays: FieldArrays, level: str, gradients: Gradients, listed: Listed, ray_count: int
) -> list[Step]:
    """Where samples store the gradients of their features: bring them to the rows of the grid."""
    if not batch.kernels.by_sample or level not in gradients.grids:
        return []
    inputs = [listed, batch.rays, arrays.lattice(level), _grid_gradient(batch, gradients, level)]
    return [(_kernels(batch, arrays).scatter_features, (-(-ray_count * batch.sample_count // RUN), 32), inputs)]


def begin_rays(batch: RayBatch, first: int, stop: int, slot: int) -> Step:
    """Empty the slice's list of samples that need colour, and mark the rays that are kept."""
    inputs = [
        first,
        color_list(batch, first, slot),
        batch.keep,
        batch.transmittance,
        batch.depth,
        batch.variance,
        batch.rgb,
    ]
    return (compositing.start_rays, stop - first, inputs)


def logits(
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
    kernels, count = _kernels(batch, arrays), (stop - first) * width
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


def _weigh_by_ray(
    batch: RayBatch, arrays: FieldArrays, stage: str, first: int, stop: int, slot: int, thresholds: Thresholds
) -> list[Step]:
    """Weights, depth and variance (Eq. 6-7), and the list of the samples that need colour; group by group of samples,
    until a ray's light is spent.
    """
    samples, ray_count = batch.sample_count, stop - first
    width = batch.kernels.group_size if thresholds.min_transmittance > 0 else samples
    result: list[Step] = []
    for sample in range(0, samples, width):
        group = min(width, samples - sample)
        result += logits(batch, arrays, stage, first, stop, sample, group, thresholds)
        inputs = [first, sample, group, thresholds.min_transmittance, arrays.bound, batch.rays, batch.rendered]
        result.append((compositing.composite, ray_count, [*inputs, batch.transmittance, batch.depth]))
    inputs = [first, batch.rays, batch.keep, batch.weight, batch.depth, batch.variance]
    result.append((compositing.ray_variance, ray_count, inputs))
    if stage == "color":
        result.append(_weighty_samples(batch, first, stop, slot, thresholds.min_weight))
    return result


def _weigh_by_sample(
    batch: RayBatch, arrays: FieldArrays, stage: str, first: int, stop: int, slot: int, thresholds: Thresholds
) -> list[Step]:
    """`_weigh_by_ray` with a thread a sample, all samples at once."""
    samples = batch.sample_count
    result = logits(batch, arrays, stage, first, stop, 0, samples, thresholds)
    min_weight = thresholds.min_weight if stage == "color" else 0.0
    inputs = [arrays.bound, batch.rays, batch.keep, batch.rendered, min_weight]
    result.append((by_sample.weigh_samples, (stop - first) * samples, inputs))
    listed = color_list(batch, first, slot)
    inputs = [listed, batch.rays, batch.keep, batch.weight, int(stage == "color"), min_weight]
    result.append((by_sample.sum_rays, stop - first, [*inputs, batch.depth, batch.variance]))
    return result


def _weighty_samples(batch: RayBatch, first: int, stop: int, slot: int, min_weight: float) -> Step:
    """List the samples of some rays that weigh at least ``min_weight``; the others are black."""
    listed = color_list(batch, first, slot)
    inputs = [first, listed, batch.sample_count, batch.keep, batch.weight, min_weight, batch.color]
    return (compositing.list_weighty, stop - first, inputs)


def color_forward(
    batch: RayBatch, arrays: FieldArrays, first: int, stop: int, slot: int, weight_gradient: wp.array | None = None
) -> Step:
    """Colour (Eq. 5) of the samples that are listed for it."""
    inputs = [color_list(batch, first, slot), batch.rays, arrays.level("color")]
    inputs += [_weights(batch, arrays, "color"), _weight_gradient(batch, weight_gradient), batch.color]
    return (
        _kernels(batch, arrays).color_forward,
        batch.kernels.thread_count((stop - first) * batch.sample_count),
        inputs,
    )


def _adjoint(
    batch: RayBatch, arrays: FieldArrays, stage: str, gradients: Gradients, thresholds: Thresholds
) -> Callable[[], None]:
    """The backward pass of `render` as a function that replays its launches."""
    want_weights = gradients.color_weights is not None

    composited = _composited_backward_by_sample if batch.kernels.by_sample else _composited_backward_by_ray

    def by_samples(first: int, stop: int, slot: int) -> list[Step]:
        return composited(batch, stage, first, stop, slot, thresholds)

    def to_rows(first: int, stop: int, slot: int) -> list[Step]:
        result: list[Step] = []
        levels = {"coarse": ("coarse",), "middle": ("middle",)}.get(stage, ("middle", "fine"))
        for level in levels:
            if gradients.points or level in gradients.grids:
                result += geometry_adjoint(batch, arrays, level, gradients, first, stop, slot)
        if stage == "color" and (gradients.points or want_weights or "color" in gradients.grids):
            result += color_adjoint(batch, arrays, gradients, first, stop, slot, batch.point_grad)
        if gradients.points:
            result.append(collect_rays(batch, gradients, first, stop))
        return result

    return rows_listed_between(batch, arrays, gradients, by_samples, to_rows, min_gradient=thresholds.min_gradient)


def rows_listed_between(
    batch: RayBatch,
    arrays: FieldArrays,
    gradients: Gradients,
    by_samples: Callable[[int, int, int], list[Step]],
    to_rows: Callable[[int, int, int], list[Step]],
    *,
    min_gradient: float = 0.0,
) -> Callable[[], None]:
    """A backward pass as a function that replays its launches: the gradients of the samples, the rows that these touch,
    for levels that want them listed, and from samples to rows and rays.

    by_samples, to_rows: Steps of a slice of the rays, as `Launcher.slices` takes them.
    min_gradient: Of a logit, below which its sample touches nothing.
    """
    commands, whole = batch.launcher.slice_commands, batch.kernels.by_sample
    listing = [level for level in ("fine", "middle", "color") if _lists(gradients, level)]
    if not listing:
        return partial(
            run_slices,
            commands(batch.count, lambda *part: [*by_samples(*part), *to_rows(*part)], whole=whole),
        )

    # A level a thread: each lists its rows alone, and so in the same order every time.
    def list_rows(first: int, stop: int, slot: int) -> list[Step]:
        return _touch(batch, arrays, gradients, listing[first:stop], min_gradient)

    parts = [commands(batch.count, by_samples, whole=whole), commands(len(listing), list_rows)]
    return partial(_run_each, [*parts, commands(batch.count, to_rows, whole=whole)])


def _run_each(parts: list[list[list[wp.Launch]]]) -> None:
    for commands in parts:
        run_slices(commands)


def _lists(gradients: Gradients, level: str) -> bool:
    return level in gradients.grids and gradients.grids[level].touched is not None


def _touch(
    batch: RayBatch, arrays: FieldArrays, gradients: Gradients, levels: list[str], min_gradient: float
) -> list[Step]:
    """List the rows of some levels that get a gradient."""
    result: list[Step] = []
    for level in levels:
        touched = gradients.grids[level].touched
        result.append((touched_rows.clear_touched, 1, [touched]))
        inputs = [touched, arrays.lattices[level], batch.rays]
        if level == "color":
            result.append((touched_rows.touch_colored, batch.count, [*inputs, batch.keep, batch.color_grad]))
        else:
            result.append((touched_rows.touch_steep, batch.count, [*inputs, batch.logit_grad, min_gradient]))
    return result


def _composited_backward_by_ray(
    batch: RayBatch, stage: str, first: int, stop: int, slot: int, thresholds: Thresholds
) -> list[Step]:
    """Adjoint of compositing, and the list of the samples whose logit has a gradient."""
    inputs = [steep_list(batch, first, slot), batch.rays, batch.keep, batch.rendered, int(stage == "color")]
    inputs += [thresholds.min_weight, batch.depth.grad, batch.rgb.grad, batch.logit_grad, batch.color_grad]
    steep = steep_samples(batch, first, stop, slot, thresholds.min_gradient)
    return [(compositing.composite_backward, stop - first, inputs), steep]


def _composited_backward_by_sample(
    batch: RayBatch, stage: str, first: int, stop: int, slot: int, thresholds: Thresholds
) -> list[Step]:
    """`_composited_backward_by_ray` with a thread a sample."""
    listed = steep_list(batch, first, slot)
    inputs = [listed, batch.rays, batch.keep, batch.rendered, int(stage == "color"), thresholds.min_weight]
    inputs += [batch.depth.grad, batch.rgb.grad, batch.logit_grad, batch.color_grad]
    steep = [listed, batch.sample_count, batch.logit_grad, thresholds.min_gradient, batch.depth.grad, batch.rgb.grad]
    return [
        (by_sample.composite_backward, (stop - first) * batch.sample_count, inputs),
        (by_sample.list_steep, stop - first, steep),
    ]


def _kernels(batch: RayBatch, arrays: FieldArrays) -> SimpleNamespace:
    """The decoder kernels for the grids' layout."""
    return batch.kernels if arrays.layout == "dense" else decoders_for(batch.device, arrays.layout)


def _listed(batch: RayBatch, first: int, slot: int, samples: wp.array, counts: wp.array) -> Listed:
    return struct(Listed, start=first * batch.sample_count, slot=slot, samples=samples, counts=counts)


def _weights(batch: RayBatch, arrays: FieldArrays, level: str) -> Weights:
    packed = arrays.decoders[level]
    return struct(Weights, W=packed.weights, T=packed.transposed, bits=batch.bits[level])


def _grid_gradient(batch: RayBatch, gradients: Gradients, level: str) -> RowGradient:
    wanted = gradients.grids.get(level)
    rows = batch.no_rows if wanted is None else wanted.buffers
    return struct(
        RowGradient,
        wanted=int(wanted is not None),
        place=batch.no_places if wanted is None else wanted.place,
        rows=rows,
        by_sample=batch.feature_grad,
        entries=entries(rows),
        entries_by_sample=entries(batch.feature_grad[:, 0]),
    )


def _weight_gradient(batch: RayBatch, rows: wp.array | None) -> WeightGradient:
    return struct(
        WeightGradient,
        wanted=int(rows is not None),
        rows=batch.no_rows if rows is None else rows,
        activations=batch.activations,
        layer_grad=batch.layer_grad,
    )
