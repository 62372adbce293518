"""One batch of rays: its arrays on the device, and the stages that fill them with rays and samples.

An optimisation iteration reads

    with launcher.tape() as tape:
        batch.cast(poses)
        batch.bound(...); batch.place_samples(...)
        render(batch, arrays, "color", gradients, tape)
        mapping_loss(batch, ...)
    launcher.call(lambda: tape.backward(batch.loss))

with `warpslam.field.passes.render` and the losses of `warpslam.field.objectives`. `RayBatch.cast` and the losses have
generated adjoints; compositing and the decoders have hand-written ones, attached with `wp.Tape.record_func`. All
launches go through a `warpslam.runtime.launching.Launcher`, which can record and replay them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warpslam.camera import Intrinsics
from warpslam.field.arrays import FieldArrays, camera_struct, projection, struct
from warpslam.kernels import adam, by_sample, compositing, free_space, pixels, rays, rejection, samples
from warpslam.kernels.compositing import Rendered
from warpslam.kernels.decoder import layout
from warpslam.kernels.decoder.build import decoders_for
from warpslam.kernels.free_space import Looks
from warpslam.kernels.grid import Vec32
from warpslam.kernels.pixels import Draw, ErrorCells, Images, Pixels
from warpslam.kernels.samples import Placement, Rays
from warpslam.runtime.cores import slice_count
from warpslam.runtime.environment import check_memory
from warpslam.runtime.launching import Launcher

if TYPE_CHECKING:
    from warpslam.field.objectives import MotionArrays


_POINT_BYTES = 72 + 4 * 3 * layout.MASK_WORDS
"""What a sample takes, without gradients of weights."""


class RayBatch:
    """Device arrays of up to ``capacity`` rays with up to ``max_samples`` samples each, and the stages to fill them."""

    def __init__(self, capacity: int, max_samples: int, device: wp.Device, launcher: Launcher | None = None) -> None:
        self.capacity, self.max_samples, self.device = capacity, max_samples, device
        self.launcher = launcher or Launcher(device)
        self.kernels = decoders_for(device)
        self.count = 0
        self.sample_count = 0
        points = capacity * max_samples
        check_memory(device, _POINT_BYTES * points, f"rays ({capacity}) and samples ({max_samples} each): lower either")

        def zeros(shape: int, dtype: Any = float, grad: bool = False) -> wp.array:
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
            level: wp.zeros((points, layout.MASK_WORDS), dtype=wp.uint32, device=device)
            for level in ("middle", "fine", "color")
        }
        self.bits["coarse"] = self.bits["middle"]
        empty = wp.zeros((1, 1), dtype=Vec32, device=device)
        self.no_errors = wp.zeros((1, 1), dtype=float, device=device)
        self.no_rows, self.no_places = empty, wp.zeros(1, dtype=int, device=device)
        self.activations = self.layer_grad = self.feature_grad = empty
        self.motion: MotionArrays | None = None

    def make_room_for_feature_gradients(self) -> None:
        """Before the first gradient of a grid is wanted, where the samples store theirs."""
        size = self.capacity * self.max_samples
        if self.kernels.by_sample and self.feature_grad.shape[0] < size:
            self.feature_grad = wp.empty((size, 1), dtype=Vec32, device=self.device)

    def make_room_for_activations(self) -> None:
        """Before the first gradient of the colour decoder's weights is wanted."""
        size = self.capacity * self.max_samples
        if self.activations.shape[0] < size:
            self.activations = wp.empty((size, 5), dtype=Vec32, device=self.device)
            if self.kernels.by_sample:
                self.layer_grad = wp.empty((size, layout.STORED_COLUMNS), dtype=Vec32, device=self.device)
            else:
                shape = (layout.WEIGHT_GROUP * slice_count(self.device), layout.WEIGHT_GROUP_COLUMNS)
                self.layer_grad = wp.zeros(shape, dtype=Vec32, device=self.device)

    # -- as the kernels take them ---------------------------------------------------------------------------------

    @property
    def draws(self) -> Draw:
        """Where the random numbers of an iteration come from."""
        return struct(Draw, seeds=self.seeds, iteration=self.iteration)

    @property
    def pixels(self) -> Pixels:
        """What the pixels measure."""
        return struct(
            Pixels,
            frame=self.frame,
            direction=self.direction_camera,
            depth=self.measured_depth,
            rgb=self.measured_rgb,
        )

    @property
    def rays(self) -> Rays:
        """The rays and their samples."""
        return struct(Rays, sample_count=self.sample_count, origin=self.origin, direction=self.direction, z=self.z)

    @property
    def rendered(self) -> Rendered:
        """What the field says of the samples."""
        return struct(Rendered, logit=self.logit, color=self.color, weight=self.weight)

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
        share, cells, cumulative_error = active or (0.0, (1, 1), self.no_errors)
        errors = struct(ErrorCells, share=share, cells=wp.vec2i(*cells), cumulative_error=cumulative_error)
        inputs = [self.draws, rays_per_frame, window, wp.vec2i(*edges), camera_struct(camera), image_struct(images)]
        self.launcher.launch(pixels.draw_pixels, self.count, [*inputs, errors, self.pixels])

    def set_pixels(self, first_row: int, row_count: int, camera: Intrinsics, stride: int = 1) -> None:
        """All pixels of ``row_count`` rows of an image that takes every ``stride``-th pixel."""
        width = -(-camera.width // stride)
        self.count = row_count * width
        inputs = [first_row, width, stride, camera_struct(camera), self.frame, self.direction_camera]
        self.launcher.launch(pixels.grid_pixels, self.count, inputs)

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
        inputs = [low, high, self.rays, self.measured_depth, int(use_depth)]
        self.launcher.launch(rays.bound_rays, self.count, [*inputs, self.t_exit, self.keep, self.max_depth])

    def drop_unseen(self, arrays: FieldArrays) -> None:
        """After `bound`: leave out the rays that end where no mapped frame has measured anything."""
        if arrays.seen is None:
            return
        inputs = [arrays.lattices["color"], arrays.seen, self.rays, self.measured_depth, self.keep]
        self.launcher.launch(rejection.drop_unseen, self.count, inputs)

    def keep_unseen(self, arrays: FieldArrays) -> None:
        """After `bound`: keep the rays alone that end where no mapped frame has measured anything (`drop_unseen`)."""
        if arrays.seen is None:
            self.launcher.call(self.keep.zero_)
            return
        inputs = [arrays.lattices["color"], arrays.seen, self.rays, self.measured_depth, self.keep]
        self.launcher.launch(rejection.keep_unseen, self.count, inputs)

    def drop_contradicted(
        self,
        images: tuple[wp.array, wp.array, wp.array],
        current: int,
        T_world_camera: np.ndarray,
        camera: Intrinsics,
        margin: float,
    ) -> None:
        """After `bound`: leave out the rays of other frames that the current one contradicts, for something has moved.

        current: Its first place in the window, whose last frames are the current one; its image is in slot 0.
        T_world_camera: Its pose (4, 4).
        margin: By how much [m].
        """
        inputs = [current, margin, *projection(camera, T_world_camera), image_struct(images)]
        inputs += [self.frame, self.rays, self.measured_depth, self.keep]
        self.launcher.launch(rejection.drop_contradicted, self.count, inputs)

    def place_samples(self, stratified: int, surface: int, *, use_depth: bool = True, jitter: bool = False) -> None:
        """Depths of the samples along each kept ray, ascending."""
        surface = surface if use_depth else 0
        self.sample_count = stratified + surface
        numbers = {"stratified": stratified, "surface": surface, "jitter": int(jitter), "use_depth": int(use_depth)}
        inputs = [self.draws, struct(Placement, **numbers), self.measured_depth, self.t_exit, self.keep]
        inputs += [self.max_depth, self.z]
        if self.kernels.by_sample:
            self.launcher.launch(by_sample.place_samples, self.count * self.sample_count, inputs)
            return
        self.launcher.spread(samples.place_samples, self.count, inputs)

    def look(self, arrays: FieldArrays, limit: float, looks: Looks) -> None:
        """Note of the cells of the fine level whether the logit of a sample in them is beyond ``limit``."""
        inputs = [arrays.lattices["fine"], self.rays, self.keep, self.logit, limit, looks]
        self.launcher.spread(free_space.look, self.count, inputs)

    def leave_out_free(self, arrays: FieldArrays, looks: Looks) -> None:
        """Samples alone that are not in free space, so many a ray as the ray with most of them has."""
        counts = self.inlier  # nobody's before the loss
        inputs = [arrays.lattices["fine"], self.rays, self.keep, looks, counts]
        self.launcher.spread(free_space.take_wanted, self.count, inputs)
        width = int(counts.numpy()[: self.count].max())
        z = self.z[: self.count * self.sample_count].reshape((self.count, self.sample_count))
        wp.copy(self.z, z[:, :width].contiguous().flatten())
        self.sample_count = width


def image_struct(images: tuple[wp.array, wp.array, wp.array]) -> Images:
    """Colour, depth and scale of images in slots, as the kernels take them."""
    rgb, depth, scale = images
    return struct(Images, rgb=rgb, depth=depth, scale=scale)
