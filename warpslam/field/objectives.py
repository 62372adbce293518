"""What an iteration makes smaller: losses over a rendered batch, the choice of its inliers, and Gauss-Newton.

A loss is a function that leaves a sum over rays in `RayBatch.loss`, its adjoint on the launcher's tape.
"""

from __future__ import annotations

import warp as wp

from warpslam.field.arrays import EXACT, FieldArrays, Gradients, Thresholds, struct
from warpslam.field.passes import color_adjoint, geometry_adjoint, steep_list, steep_samples
from warpslam.field.ray_batch import RayBatch
from warpslam.kernels import by_sample, gauss_newton, losses
from warpslam.runtime.launching import Step


def mapping_loss(batch: RayBatch, color_weight: float, depth_weight: float = 1.0) -> None:
    """Eq. 8-10 over the kept rays."""
    inputs = [batch.keep, batch.measured_depth, batch.measured_rgb, depth_weight, color_weight]
    _sum_over_rays(batch, losses.mapping_loss, inputs)


def tracking_loss(batch: RayBatch, color_weight: float, forecast: RayBatch | None = None) -> None:
    """Eq. 11-12 over the inliers.

    forecast: Rays rendered from the coarse level, whose inliers add the coarse term of Eq. 11; they share the launcher.
    """
    inputs = [batch.inlier, batch.measured_depth, batch.measured_rgb, batch.sigma, 1.0, color_weight]
    _sum_over_rays(batch, losses.tracking_loss, inputs)
    if forecast is not None:
        inputs = [forecast.inlier, forecast.measured_depth, forecast.measured_rgb, forecast.sigma, 1.0, 0.0]
        inputs += [forecast.depth, forecast.rgb]
        batch.launcher.launch_taped(losses.tracking_loss, forecast.count, inputs, [batch.loss])


def _sum_over_rays(batch: RayBatch, kernel: wp.Kernel, inputs: list) -> None:
    """A kernel that takes ``inputs`` and the rendered depth and colour, and adds to the loss."""
    batch.launcher.call(batch.loss.zero_)
    batch.launcher.launch_taped(kernel, batch.count, [*inputs, batch.depth, batch.rgb], [batch.loss])


def choose_inliers(
    batch: RayBatch,
    filter_factor: float,
    *,
    median_includes_missing: bool = False,
    normalized: bool = True,
    color_weight: float = 0.0,
) -> None:
    """Depth residuals, normalised by the rendered standard deviation or not, their median and the inliers, whose
    residual is below ``filter_factor`` times that (Sec. 3.3, dynamic objects).

    color_weight: Of the colour residuals that are added to them: lambda_pt makes them the loss of Eq. 12.
    """
    launch = batch.launcher.launch
    batch.launcher.call(batch.counts.zero_)
    inputs = [batch.keep, batch.measured_depth, batch.depth, batch.variance]
    inputs += [int(median_includes_missing), int(normalized), batch.sigma, batch.residual, batch.counts]
    launch(losses.tracking_residuals, batch.count, inputs)
    if color_weight > 0.0:
        launch(losses.add_color_residuals, batch.count, [batch.measured_rgb, batch.rgb, color_weight, batch.residual])
    if filter_factor > 0.0:
        launch(losses.lower_median, batch.count, [batch.residual[: batch.count], batch.counts, batch.median])
    inputs = [batch.keep, batch.measured_depth, batch.residual, batch.median, filter_factor]
    launch(losses.choose_inliers, batch.count, [*inputs, batch.inlier, batch.counts[1:]])


def gauss_newton_step(
    batch: RayBatch, arrays: FieldArrays, poses: wp.array, color_weight: float, *, thresholds: Thresholds = EXACT
) -> None:
    """After a rendering in the colour stage and `choose_inliers`: one step on the first pose vector, which is the only
    one that rays may have; see `warpslam.kernels.gauss_newton`.
    """
    if batch.motion is None:
        batch.motion = MotionArrays(batch.capacity, batch.capacity * batch.max_samples, batch.device)
    motion, wanted = batch.motion, Gradients(points=True)

    def steps(first: int, stop: int, slot: int) -> list[Step]:
        inputs = [steep_list(batch, first, slot), batch.rays, batch.inlier, batch.rendered]
        inputs += [thresholds.min_weight, thresholds.min_gradient, motion.by_logit, batch.logit_grad, batch.color_grad]
        samples, ray_count = batch.sample_count, stop - first
        result: list[Step] = [(gauss_newton.ray_derivatives, ray_count, [first, *inputs])]
        if batch.kernels.by_sample:
            result = [(by_sample.ray_derivatives, ray_count * samples, inputs)]
        result.append(steep_samples(batch, first, stop, slot, 0.0))
        for level in ("middle", "fine"):
            result += geometry_adjoint(batch, arrays, level, wanted, first, stop, slot)
        result += color_adjoint(batch, arrays, wanted, first, stop, slot, motion.grey_by_point)
        inputs = [batch.rays, motion.by_logit, batch.point_grad, motion.grey_by_point]
        if batch.kernels.by_sample:
            result.append((by_sample.jacobian_parts, (ray_count, by_sample.PARTS), [*inputs, motion.ray_parts]))
            inputs = [batch.direction, motion.ray_parts, motion.depth, motion.grey]
            result.append((by_sample.ray_jacobians, ray_count, inputs))
        else:
            result.append((gauss_newton.ray_jacobians, ray_count, [first, *inputs, motion.depth, motion.grey]))
        return result

    batch.launcher.slices(batch.count, steps, whole=batch.kernels.by_sample)
    residuals = struct(
        gauss_newton.Residuals,
        ray_count=batch.count,
        color_weight=color_weight,
        inlier=batch.inlier,
        sigma=batch.sigma,
        measured_depth=batch.measured_depth,
        measured_rgb=batch.measured_rgb,
        depth=batch.depth,
        rgb=batch.rgb,
        depth_by_motion=motion.depth,
        grey_by_motion=motion.grey,
    )
    if not batch.kernels.by_sample:
        batch.launcher.launch(gauss_newton.gauss_newton_step, 1, [residuals, motion.normal, motion.right, poses])
        return
    chunks = -(-batch.count // gauss_newton.CHUNK)
    batch.launcher.launch(gauss_newton.normal_parts, (chunks, 32), [residuals, motion.normal_parts])
    inputs = [chunks, motion.normal_parts, motion.entries]
    batch.launcher.launch(gauss_newton.sum_parts, gauss_newton.ENTRIES, inputs)
    batch.launcher.launch(gauss_newton.gauss_newton_step_of_entries, 1, [motion.entries, poses])


def note_rays(batch: RayBatch, noted: wp.array, forecast: RayBatch | None = None) -> None:
    """After a loss: keep whether a ray is kept, whether it is an inlier, its measured and its rendered depth [m].

    noted: Float (iterations, rays + 1, 4); the last row of an iteration holds the loss, and beside it how many inliers
        ``forecast`` has, the rays of the coarse term.
    """
    inputs = [batch.iteration, batch.keep, batch.inlier, batch.measured_depth, batch.depth, batch.loss, noted]
    batch.launcher.launch(losses.note_rays, batch.count, inputs)
    if forecast is not None:
        batch.launcher.launch(losses.note_forecast, 1, [batch.iteration, forecast.counts, noted])


class MotionArrays:
    """Derivatives of rays by a motion of the camera, and the normal equations."""

    def __init__(self, ray_count: int, point_count: int, device: wp.Device) -> None:
        self.by_logit = wp.zeros(point_count, dtype=wp.vec2, device=device)
        self.grey_by_point = wp.zeros(point_count, dtype=wp.vec3, device=device)
        self.depth = wp.zeros(ray_count, dtype=gauss_newton.Vec6, device=device)
        self.grey = wp.zeros(ray_count, dtype=gauss_newton.Vec6, device=device)
        self.ray_parts = wp.zeros((ray_count, by_sample.PARTS), dtype=by_sample.Vec12, device=device)
        chunks = -(-ray_count // gauss_newton.CHUNK)
        self.normal_parts = wp.zeros((chunks, gauss_newton.ENTRIES), dtype=wp.float64, device=device)
        self.entries = wp.zeros(gauss_newton.ENTRIES, dtype=wp.float64, device=device)
        self.normal = wp.zeros(1, dtype=gauss_newton.Mat66d, device=device)
        self.right = wp.zeros(1, dtype=gauss_newton.Vec6d, device=device)
