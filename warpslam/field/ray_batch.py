"""One batch of rays through the field: the arrays, the forward stages, and their adjoints recorded on the tape.

An optimisation iteration reads

    with launcher.tape() as tape:
        batch.cast(poses)
        batch.bound(...); batch.place_samples(...)
        batch.render(arrays, "color", gradients, tape)
        batch.mapping_loss(...)
    launcher.call(lambda: tape.backward(batch.loss))

`RayBatch.cast` and the losses have generated adjoints; compositing and the decoders have hand-written ones, attached
with `wp.Tape.record_func`. All launches go through a `warpslam.runtime.launching.Launcher`, which
can record and replay them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import warp as wp

from warpslam.camera import Intrinsics
from warpslam.field.arrays import EXACT, FieldArrays, Gradients, Thresholds, camera_vectors, projection
from warpslam.kernels import adam, compositing, decoder, gauss_newton, losses, rays
from warpslam.kernels.decoder import decoders_for
from warpslam.kernels.grid import Vec32
from warpslam.runtime.cores import slice_count
from warpslam.runtime.launching import Launcher, Step
from warpslam.runtime.program import run_slices

STAGES = ("coarse", "middle", "fine", "color")
GROUP_SIZE = {"cpu": 8, "cuda": 16}
"""Samples of a ray between two looks at its transmittance."""


class RayBatch:
    """Device arrays of up to ``capacity`` rays with up to ``max_samples`` samples each, and the stages to fill them."""

    def __init__(self, capacity: int, max_samples: int, device: wp.Device, launcher: Launcher | None = None) -> None:
        self.capacity, self.max_samples, self.device = capacity, max_samples, device
        self.launcher = launcher or Launcher(device)
        self.kernels = decoders_for(device)
        self.count = 0
        self.sample_count = 0
        points = capacity * max_samples

        def zeros(shape, dtype=float, grad: bool = False) -> wp.array:
            return wp.zeros(shape, dtype=dtype, device=device, requires_grad=grad)

        self.frame = zeros(capacity, int)
        self.direction_camera = zeros(capacity, wp.vec3)
        self.measured_depth = zeros(capacity)
        self.measured_rgb = zeros(capacity, wp.vec3)
        self.origin = zeros(capacity, wp.vec3, True)
        self.direction = zeros(capacity, wp.vec3, True)
        self.t_exit = zeros(capacity)
        self.keep = zeros(capacity, int)
        self.transmittance = zeros(capacity)
        self.seeds = zeros(1, int)
        self.iteration = zeros(1, int)
        self.z = zeros(points)
        self.logit = zeros(points)
        self.color = zeros(points, wp.vec3)
        self.weight = zeros(points)
        self.depth = zeros(capacity, float, True)
        self.rgb = zeros(capacity, wp.vec3, True)
        self.variance = zeros(capacity)
        self.loss = zeros(1, float, True)
        self.max_depth = zeros(1)
        self.sigma = zeros(capacity)
        self.residual = zeros(capacity)
        self.inlier = zeros(capacity, int)
        self.counts = zeros(2, int)
        self.median = zeros(1)
        self.logit_grad = zeros(points)
        self.color_grad = zeros(points, wp.vec3)
        self.point_grad = zeros(points, wp.vec3)
        # Samples that need colour and samples whose logit has a gradient, by slice.
        self.weighty, self.steep = zeros(points, int), zeros(points, int)
        counts = compositing.COUNT_STRIDE * slice_count(device)
        self.weighty_count, self.steep_count = zeros(counts, int), zeros(counts, int)
        self.bits = {
            level: wp.zeros((points, decoder.MASK_WORDS), dtype=wp.uint32, device=device)
            for level in ("middle", "fine", "color")
        }
        self.bits["coarse"] = self.bits["middle"]
        empty = wp.zeros((1, 1), dtype=Vec32, device=device)
        self._no_errors = wp.zeros((1, 1), dtype=float, device=device)
        self._no_rows, self._no_selection = empty, wp.zeros(1, dtype=wp.uint8, device=device)
        self._activations = self._layer_grad = empty
        self._layer_inputs = wp.zeros((1, 1, 1), dtype=float, device=device)
        self._motion: _MotionArrays | None = None

    # -- filling in the rays -------------------------------------------------------------------------------------

    def set_seeds(self, seeds: Sequence[int]) -> None:
        """Seeds of the iterations to come, int32; `next_iteration` moves on to the next one."""
        if len(seeds) > self.seeds.shape[0]:
            self.seeds = wp.zeros(2 * len(seeds), dtype=int, device=self.device)
        self.seeds[: len(seeds)].assign(np.asarray(seeds, np.int32))
        self.iteration.zero_()

    def next_iteration(self) -> None:
        """Use the next seed."""
        self.launcher.launch(adam.advance_step, 1, [self.iteration])

    def draw(
        self,
        images: tuple[wp.array, wp.array, wp.array],
        window: wp.array,
        rays_per_frame: int,
        camera: Intrinsics,
        *,
        edges: tuple[int, int] = (0, 0),
        active: tuple[float, tuple[int, int], wp.array] | None = None,
    ) -> None:
        """Draw random pixels of the window's images (colour, depth, depth scale; see `scene.image_pool.ImagePool`).

        edges: Columns and rows that are left out on both sides [px].
        active: Share of pixels that is not uniform, but follows the error of an image's cells; the number of cells
            across and down; and running sums of the error, (frames, cells). See `warpslam.mapping.active_sampling`.
        """
        self.count = window.shape[0] * rays_per_frame
        rgb, depth, scale = images
        inputs = [self.seeds, self.iteration, rays_per_frame, window, *edges, *camera_vectors(camera)]
        share, cells, cumulative_error = active or (0.0, (1, 1), self._no_errors)
        inputs += [rgb, depth, scale, share, wp.vec2i(*cells), cumulative_error]
        inputs += [self.frame, self.direction_camera, self.measured_depth, self.measured_rgb]
        self.launcher.launch(rays.draw_pixels, self.count, inputs)

    def set_pixels(self, first_row: int, row_count: int, camera: Intrinsics, stride: int = 1) -> None:
        """All pixels of ``row_count`` rows of an image that takes every ``stride``-th pixel."""
        width = -(-camera.width // stride)
        self.count = row_count * width
        inputs = [first_row, width, stride, *camera_vectors(camera), self.frame, self.direction_camera]
        self.launcher.launch(rays.grid_pixels, self.count, inputs)

    def set_points(self, points: np.ndarray) -> None:
        """Query points, shape (N, 3) [m], as rays of one sample at z = 0."""
        self.count = len(points)
        self.sample_count = 1
        self.origin[: self.count].assign(np.ascontiguousarray(points, np.float32))
        self.direction.zero_()
        self.z.zero_()
        self.keep.fill_(1)

    def cast(self, poses: wp.array, *, differentiate: bool = True) -> None:
        """Rays of the pixels for pose vectors ``poses``, shape (frames, 7); recorded on the launcher's tape."""
        inputs, outputs = [poses, self.frame, self.direction_camera], [self.origin, self.direction]
        if differentiate and poses.requires_grad:
            self.launcher.launch_taped(rays.cast_rays, self.count, inputs, outputs)
        else:
            self.launcher.launch(rays.cast_rays, self.count, inputs + outputs)

    def bound(self, arrays: FieldArrays, *, use_depth: bool = True) -> None:
        """Exit distances and the rays to keep (a measured surface outside the bound drops its ray)."""
        self.bound_to(arrays.low, arrays.high, use_depth=use_depth)

    def bound_to(self, low: wp.vec3, high: wp.vec3, *, use_depth: bool = True) -> None:
        """`bound` for the box between two corners."""
        self.launcher.call(self.max_depth.zero_)
        inputs = [low, high, self.origin, self.direction, self.measured_depth, int(use_depth)]
        self.launcher.launch(rays.bound_rays, self.count, [*inputs, self.t_exit, self.keep, self.max_depth])

    def drop_unseen(self, arrays: FieldArrays) -> None:
        """After `bound`: leave out the rays that end where no mapped frame has measured anything."""
        if arrays.seen is None:
            return
        inputs = [arrays.lattices["color"], arrays.seen, self.origin, self.direction, self.measured_depth, self.keep]
        self.launcher.launch(rays.drop_unseen, self.count, inputs)

    def drop_contradicted(
        self,
        images: tuple[wp.array, wp.array, wp.array],
        current: int,
        T_world_camera: np.ndarray,
        camera: Intrinsics,
        margin: float,
    ) -> None:
        """After `bound`: leave out the rays of other frames that the current one contradicts, for something has moved.

        current: Its place in the window; its image is in slot 0.
        T_world_camera: Its pose (4, 4).
        margin: By how much [m].
        """
        _, depth, scale = images
        inputs = [current, margin, *projection(camera, T_world_camera), depth, scale]
        inputs += [self.frame, self.origin, self.direction, self.measured_depth, self.keep]
        self.launcher.launch(rays.drop_contradicted, self.count, inputs)

    def place_samples(self, stratified: int, surface: int, *, use_depth: bool = True, jitter: bool = False) -> None:
        """Depths of the samples along each kept ray, ascending."""
        self.sample_count = stratified + (surface if use_depth else 0)
        inputs = [self.seeds, self.iteration, int(jitter), stratified, self.sample_count - stratified, int(use_depth)]
        inputs += [self.measured_depth, self.t_exit, self.keep, self.max_depth, self.z]

        def steps(first: int, stop: int, slot: int) -> list[Step]:
            return [(rays.place_samples, stop - first, [first, *inputs])]

        self.launcher.slices(self.count, steps)

    # -- the field -----------------------------------------------------------------------------------------------

    def query(self, arrays: FieldArrays, stage: str) -> None:
        """Logit (and colour, in the colour stage) of every sample: `logit`, `color`."""

        def steps(first: int, stop: int, slot: int) -> list[Step]:
            start = self._start(first, stop, slot)
            result = [start, *self._logits(arrays, stage, first, stop, 0, self.sample_count, EXACT)]
            if stage == "color":
                result += self._colors(arrays, first, stop, slot, 0.0)
            return result

        self.launcher.slices(self.count, steps)

    def render(
        self,
        arrays: FieldArrays,
        stage: str,
        gradients: Gradients | None = None,
        tape: wp.Tape | None = None,
        *,
        thresholds: Thresholds = EXACT,
    ) -> None:
        """Depth, colour and variance of every ray (Eq. 5-7).

        gradients, tape: What to differentiate, and the tape that gets the adjoint; both or neither.
        """
        if gradients is not None and tape is None:
            raise ValueError("gradients are recorded on a tape: pass the active one")
        want_activations = gradients is not None and gradients.color_weights is not None
        if want_activations:
            self._make_room_for_activations()
        samples = self.sample_count
        width = GROUP_SIZE["cuda" if self.device.is_cuda else "cpu"] if thresholds.min_transmittance > 0 else samples

        def steps(first: int, stop: int, slot: int) -> list[Step]:
            ray_count = stop - first
            result = [self._start(first, stop, slot)]
            for sample in range(0, samples, width):
                group = min(width, samples - sample)
                result += self._logits(arrays, stage, first, stop, sample, group, thresholds)
                inputs = [first, sample, group, samples, thresholds.min_transmittance, arrays.low, arrays.high]
                inputs += [self.origin, self.direction, self.z, self.logit, self.weight, self.transmittance, self.depth]
                result.append((compositing.composite, ray_count, inputs))
            inputs = [first, samples, self.z, self.keep, self.weight, self.depth, self.variance]
            result.append((compositing.ray_variance, ray_count, inputs))
            if stage == "color":
                result += self._colors(arrays, first, stop, slot, thresholds.min_weight, want_activations)
                inputs = [first, samples, self.keep, self.color, self.weight, self.rgb]
                result.append((compositing.composite_color, ray_count, inputs))
            return result

        self.launcher.slices(self.count, steps)
        if gradients is not None and tape is not None:
            tape.record_func(self._adjoint(arrays, stage, gradients, thresholds), [self.depth, self.rgb])

    def take_surface_depth(self, min_occupancy: float) -> None:
        """After `render`: replace the mean depth of each ray by that of its first sample with ``min_occupancy``."""
        inputs = [self.sample_count, self.keep, self.z, self.logit, self.weight, min_occupancy, self.depth]
        self.launcher.launch(compositing.surface_depth, self.count, inputs)

    def _start(self, first: int, stop: int, slot: int) -> Step:
        inputs = [first, slot, self.weighty_count, self.keep, self.transmittance, self.depth, self.variance, self.rgb]
        return (compositing.start_rays, stop - first, inputs)

    def _logits(
        self, arrays: FieldArrays, stage: str, first: int, stop: int, sample: int, width: int, thresholds: Thresholds
    ) -> list[Step]:
        """Occupancy logits of some samples of the rays ``first`` to ``stop``."""
        kernels, count = self.kernels, (stop - first) * width
        dim = kernels.thread_count(count)
        points = [count, first, sample, width, 32, self.sample_count, self.origin, self.direction, self.z]
        points += [self.transmittance, thresholds.min_transmittance]

        def grid(level: str) -> list:
            return [arrays.lattices[level], arrays.features[level]]

        def rest(level: str) -> list:
            return [arrays.decoders[level].weights, self.bits[level], self.logit]

        if stage == "coarse":
            return [(kernels.coarse_forward, dim, [*points, *grid("coarse"), *rest("coarse")])]
        steps: list[Step] = [(kernels.middle_forward, dim, [*points, *grid("middle"), *rest("middle")])]
        if stage != "middle":
            steps.append((kernels.fine_forward, dim, [*points, *grid("fine"), *grid("middle"), *rest("fine")]))
        return steps

    def _colors(
        self,
        arrays: FieldArrays,
        first: int,
        stop: int,
        slot: int,
        min_weight: float,
        want_activations: bool = False,
    ) -> list[Step]:
        samples = self.sample_count
        dim = self.kernels.thread_count((stop - first) * samples)
        listed = [self.weighty, self.weighty_count]
        choose = [first, slot, samples, self.keep, self.weight, min_weight, self.color, *listed]
        inputs = [first * samples, slot, *listed, 32, samples, self.origin, self.direction, self.z]
        inputs += [arrays.lattices["color"], arrays.features["color"], arrays.decoders["color"].weights]
        inputs += [self.bits["color"], int(want_activations), self._activations, self.color]
        return [(compositing.list_weighty, stop - first, choose), (self.kernels.color_forward, dim, inputs)]

    def _steep(self, first: int, stop: int, slot: int, min_gradient: float) -> Step:
        inputs = [first, slot, self.sample_count, self.logit_grad, min_gradient, self.steep, self.steep_count]
        return (compositing.list_steep, stop - first, inputs)

    def _make_room_for_activations(self) -> None:
        size = self.capacity * self.max_samples
        if self._activations.shape[0] < size:
            self._activations = wp.empty((size, 5), dtype=Vec32, device=self.device)
            if self.kernels.sums_weights_apart:
                self._layer_grad = wp.empty((size, 14), dtype=Vec32, device=self.device)
            else:
                shape = (decoder.WEIGHT_GROUP * slice_count(self.device), decoder.WEIGHT_GROUP_COLUMNS)
                self._layer_inputs = wp.zeros((*shape, 32), dtype=float, device=self.device)
                pointer = self._layer_inputs.ptr
                self._layer_grad = wp.array(ptr=pointer, dtype=Vec32, shape=shape, device=self.device)

    def _adjoint(
        self, arrays: FieldArrays, stage: str, gradients: Gradients, thresholds: Thresholds
    ) -> Callable[[], None]:
        """The backward pass of `render` as a function that replays its launches."""
        samples = self.sample_count
        want_weights = gradients.color_weights is not None

        def steps(first: int, stop: int, slot: int) -> list[Step]:
            inputs = [first, slot, self.steep_count, samples, self.z, self.keep, self.logit, int(stage == "color")]
            inputs += [self.color, self.weight, thresholds.min_weight, self.depth.grad, self.rgb.grad]
            inputs += [self.logit_grad, self.color_grad]
            result: list[Step] = [(compositing.composite_backward, stop - first, inputs)]
            result.append(self._steep(first, stop, slot, thresholds.min_gradient))
            levels = {"coarse": ("coarse",), "middle": ("middle",)}.get(stage, ("middle", "fine"))
            for level in levels:
                if gradients.points or level in gradients.grids:
                    result.append(self._geometry_adjoint(arrays, level, gradients, first, stop, slot, self.point_grad))
            if stage == "color" and (gradients.points or want_weights or "color" in gradients.grids):
                result.append(self._color_adjoint(arrays, gradients, first, stop, slot, self.point_grad))
            if gradients.points:
                counts = self.inlier if gradients.inliers_move else self.keep
                inputs = [first, samples, self.keep, counts, self.z, self.point_grad]
                inputs += [self.origin.grad, self.direction.grad]
                result.append((rays.collect_ray_gradients, stop - first, inputs))
            return result

        commands = self.launcher.slice_commands(self.count, steps)
        last: list[wp.Launch] = []
        if want_weights and stage == "color" and self.kernels.sums_weights_apart:
            chunk, points = 256, self.count * samples
            inputs = [points, chunk, samples, self.origin, self.direction, self.z, arrays.decoders["color"].weights]
            inputs += [self._activations, self.color_grad, self._layer_grad, gradients.color_weights]
            dim = (-(-points // chunk), decoder.COLOR_WEIGHT_ROWS)
            last.append(self.launcher.command(self.kernels.color_weights, dim, inputs))

        def run() -> None:
            run_slices(commands)
            for command in last:
                command.launch()

        return run

    def _common(self, arrays: FieldArrays, level: str) -> list:
        packed = arrays.decoders[level]
        points = [32, self.sample_count, self.origin, self.direction, self.z]
        return [*points, arrays.lattices[level], arrays.features[level], packed.weights, packed.transposed]

    def _grid_gradient(self, gradients: Gradients, level: str) -> list:
        wanted = gradients.grids.get(level)
        if wanted is None:
            return [0, self._no_selection, self._no_rows]
        return [1, wanted.selected, wanted.buffers]

    def _geometry_adjoint(
        self,
        arrays: FieldArrays,
        level: str,
        gradients: Gradients,
        first: int,
        stop: int,
        slot: int,
        point_grad: wp.array,
    ) -> Step:
        samples = self.sample_count
        dim = self.kernels.thread_count((stop - first) * samples)
        head = [first * samples, slot, self.steep, self.steep_count]
        if level == "coarse":
            packed = arrays.decoders["coarse"]
            inputs = [*head, 32, samples, self.origin, self.direction, self.z, arrays.lattices["coarse"]]
            inputs += [packed.weights, packed.transposed, self.bits["coarse"], self.logit_grad]
            return (self.kernels.coarse_backward, dim, inputs + self._grid_gradient(gradients, "coarse")[1:])
        output = decoder.OUT_64 if level == "fine" else decoder.OUT_32
        inputs = [*head, *self._common(arrays, level), output, self.bits[level], self.logit_grad]
        inputs += [*self._grid_gradient(gradients, level), int(gradients.points), point_grad]
        return (self.kernels.geometry_backward, dim, inputs)

    def _color_adjoint(
        self, arrays: FieldArrays, gradients: Gradients, first: int, stop: int, slot: int, point_grad: wp.array
    ) -> Step:
        samples = self.sample_count
        buffers = self._no_rows if gradients.color_weights is None else gradients.color_weights
        blocks = self.kernels.color_blocks
        inputs = [first * samples, slot, self.weighty, self.weighty_count, blocks, *self._common(arrays, "color")]
        inputs += [self.bits["color"], self.color_grad]
        inputs += [*self._grid_gradient(gradients, "color"), int(gradients.points), point_grad]
        inputs += [int(gradients.color_weights is not None), self._activations, buffers]
        inputs += [self._layer_grad, self._layer_inputs]
        threads = -(-self.kernels.thread_count((stop - first) * samples) // blocks)
        return (self.kernels.color_backward, threads, inputs)

    # -- losses --------------------------------------------------------------------------------------------------

    def mapping_loss(self, color_weight: float, depth_weight: float = 1.0) -> None:
        """Eq. 8-10; `loss` holds the sum. Recorded on the launcher's tape."""
        self.launcher.call(self.loss.zero_)
        inputs = [self.keep, self.measured_depth, self.measured_rgb, depth_weight, color_weight, self.depth, self.rgb]
        self.launcher.launch_taped(losses.mapping_loss, self.count, inputs, [self.loss])

    def choose_inliers(
        self, filter_factor: float, *, median_includes_missing: bool = False, normalized: bool = True
    ) -> None:
        """Depth residuals, normalised by the rendered standard deviation or not, their median and the inliers, whose
        residual is below ``filter_factor`` times that (Sec. 3.3, dynamic objects).
        """
        launch = self.launcher.launch
        self.launcher.call(self.counts.zero_)
        inputs = [self.keep, self.measured_depth, self.depth, self.variance]
        inputs += [int(median_includes_missing), int(normalized)]
        launch(losses.tracking_residuals, self.count, [*inputs, self.sigma, self.residual, self.counts])
        if filter_factor > 0.0:
            launch(losses.lower_median, self.count, [self.residual[: self.count], self.counts, self.median])
        inputs = [self.keep, self.measured_depth, self.residual, self.median, filter_factor]
        launch(losses.choose_inliers, self.count, [*inputs, self.inlier, self.counts[1:]])

    def tracking_loss(self, color_weight: float) -> None:
        """Eq. 11-12 over the inliers; `loss` holds the sum. Recorded on the launcher's tape."""
        self.launcher.call(self.loss.zero_)
        inputs = [self.inlier, self.measured_depth, self.measured_rgb, self.sigma, 1.0, color_weight]
        self.launcher.launch_taped(losses.tracking_loss, self.count, [*inputs, self.depth, self.rgb], [self.loss])

    def gauss_newton_step(
        self, arrays: FieldArrays, poses: wp.array, color_weight: float, *, thresholds: Thresholds = EXACT
    ) -> None:
        """After `render` in the colour stage and `choose_inliers`: one step on the first pose vector, which is the only
        one that rays may have; see `warpslam.kernels.gauss_newton`.
        """
        if self._motion is None:
            self._motion = _MotionArrays(self.capacity, self.capacity * self.max_samples, self.device)
        motion, samples, wanted = self._motion, self.sample_count, Gradients(points=True)

        def steps(first: int, stop: int, slot: int) -> list[Step]:
            inputs = [first, slot, self.steep_count, samples, self.z, self.inlier, self.logit, self.color, self.weight]
            inputs += [thresholds.min_weight, thresholds.min_gradient, motion.by_logit]
            result: list[Step] = [
                (gauss_newton.ray_derivatives, stop - first, [*inputs, self.logit_grad, self.color_grad]),
                self._steep(first, stop, slot, 0.0),
            ]
            for level in ("middle", "fine"):
                adjoint = self._geometry_adjoint(arrays, level, wanted, first, stop, slot, self.point_grad)
                result.append(adjoint)
            result.append(self._color_adjoint(arrays, wanted, first, stop, slot, motion.grey_by_point))
            inputs = [first, samples, self.z, self.direction, motion.by_logit, self.point_grad, motion.grey_by_point]
            result.append((gauss_newton.ray_jacobians, stop - first, [*inputs, motion.depth, motion.grey]))
            return result

        self.launcher.slices(self.count, steps)
        inputs = [self.count, color_weight, self.inlier, self.sigma, self.measured_depth, self.measured_rgb]
        inputs += [self.depth, self.rgb, motion.depth, motion.grey, motion.normal, motion.right, poses]
        self.launcher.launch(gauss_newton.gauss_newton_step, 1, inputs)


class _MotionArrays:
    """Derivatives of rays by a motion of the camera, and the normal equations."""

    def __init__(self, ray_count: int, point_count: int, device: wp.Device) -> None:
        self.by_logit = wp.zeros(point_count, dtype=wp.vec2, device=device)
        self.grey_by_point = wp.zeros(point_count, dtype=wp.vec3, device=device)
        self.depth = wp.zeros(ray_count, dtype=gauss_newton.Vec6, device=device)
        self.grey = wp.zeros(ray_count, dtype=gauss_newton.Vec6, device=device)
        self.normal = wp.zeros(1, dtype=gauss_newton.Mat66d, device=device)
        self.right = wp.zeros(1, dtype=gauss_newton.Vec6d, device=device)
