"""The direct loss of mapping over a batch of rays: every sample against the measured depth, without rendering.

An iteration reads

    with launcher.tape() as tape:
        batch.cast(poses)
        batch.bound(arrays)
        place_band(batch, band, images, window, camera)
        supervise(batch, arrays, target, gradients, tape)
    launcher.call(lambda: tape.backward(batch.loss))

See `warpslam.kernels.supervision` for the equations.
"""

from __future__ import annotations

from collections.abc import Callable

import warp as wp

from warpslam.camera import Intrinsics
from warpslam.field.arrays import EXACT, FieldArrays, Gradients, camera_struct
from warpslam.field.passes import (
    begin_rays,
    collect_rays,
    color_adjoint,
    color_forward,
    color_list,
    geometry_adjoint,
    logits,
    rows_listed_between,
    steep_list,
    steep_samples,
)
from warpslam.field.ray_batch import RayBatch, image_struct
from warpslam.kernels import supervision
from warpslam.kernels.supervision import Band, Target
from warpslam.runtime.launching import Step

GEOMETRY = ("middle", "fine")


def place_band(
    batch: RayBatch, band: Band, images: tuple[wp.array, wp.array, wp.array], window: wp.array, camera: Intrinsics
) -> None:
    """Samples of rays that `RayBatch.draw` drew from the ``window`` of ``images``; those without depth are left out."""
    batch.sample_count = band.free + band.near + 1
    inputs = [batch.draws, band, camera_struct(camera), window, image_struct(images), batch.pixels, batch.keep, batch.z]

    def steps(first: int, stop: int, slot: int) -> list[Step]:
        return [(supervision.place_band, stop - first, [first, *inputs])]

    batch.launcher.slices(batch.count, steps, whole=batch.kernels.by_sample)


def query_geometry(batch: RayBatch, arrays: FieldArrays) -> None:
    """Logit of every sample of the kept rays (Eq. 1-3)."""

    def steps(first: int, stop: int, slot: int) -> list[Step]:
        return [
            begin_rays(batch, first, stop, slot),
            *logits(batch, arrays, "fine", first, stop, 0, batch.sample_count, EXACT),
        ]

    batch.launcher.slices(batch.count, steps, whole=batch.kernels.by_sample)


def supervise(
    batch: RayBatch,
    arrays: FieldArrays,
    target: Target,
    gradients: Gradients,
    tape: wp.Tape,
    *,
    with_color: bool = True,
) -> None:
    """The direct loss into `RayBatch.loss`, its adjoint onto the tape.

    with_color: Whether colours have terms; else only geometry has.
    """
    weights = gradients.color_weights
    if weights is not None:
        batch.make_room_for_activations()
    batch.make_room_for_feature_gradients()

    def steps(first: int, stop: int, slot: int) -> list[Step]:
        result = [begin_rays(batch, first, stop, slot)]
        result += logits(batch, arrays, "fine", first, stop, 0, batch.sample_count, EXACT)
        if with_color:
            inputs = [color_list(batch, first, slot), batch.rays, batch.measured_depth, batch.keep, target.color_reach]
            result.append((supervision.list_colored, stop - first, [first, *inputs]))
            result.append(color_forward(batch, arrays, first, stop, slot, weights))
        return result

    launcher = batch.launcher
    launcher.slices(batch.count, steps, whole=batch.kernels.by_sample)
    launcher.call(batch.loss.zero_)
    inputs = [target, int(with_color), batch.rays, batch.pixels, batch.keep, batch.logit, batch.color, batch.loss]
    launcher.launch(supervision.direct_loss, batch.count, inputs)
    tape.record_func(_adjoint(batch, arrays, target, gradients, with_color), [batch.loss])


def _adjoint(
    batch: RayBatch, arrays: FieldArrays, target: Target, gradients: Gradients, with_color: bool
) -> Callable[[], None]:
    """The backward pass of `supervise` as a function that replays its launches: by samples, by rows that these touch,
    and from samples to rows and rays.
    """

    def by_samples(first: int, stop: int, slot: int) -> list[Step]:
        inputs = [steep_list(batch, first, slot), target, int(with_color), batch.rays, batch.pixels, batch.keep]
        inputs += [batch.logit, batch.color, batch.loss.grad, batch.logit_grad, batch.color_grad]
        backward = (supervision.direct_loss_backward, stop - first, [first, *inputs])
        return [backward, steep_samples(batch, first, stop, slot, 0.0)]

    def to_rows(first: int, stop: int, slot: int) -> list[Step]:
        result: list[Step] = []
        for level in GEOMETRY:
            if gradients.points or level in gradients.grids:
                result += geometry_adjoint(batch, arrays, level, gradients, first, stop, slot)
        if with_color and (gradients.points or gradients.color_weights is not None or "color" in gradients.grids):
            result += color_adjoint(batch, arrays, gradients, first, stop, slot, batch.point_grad)
        if gradients.points:
            result.append(collect_rays(batch, gradients, first, stop))
        return result

    return rows_listed_between(batch, arrays, gradients, by_samples, to_rows)
