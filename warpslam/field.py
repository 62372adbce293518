"""One batch of rays through the field: the arrays, the forward stages, and their adjoints recorded on the tape.

An optimisation iteration reads

    with wp.Tape() as tape:
        batch.cast(poses)
        batch.bound(...); batch.place_samples(...)
        batch.render(arrays, "color", gradients, tape)
        batch.mapping_loss(...)
    tape.backward(batch.loss)

`RayBatch.cast` and the losses have generated adjoints; compositing and the decoders have hand-written ones, attached
with
`wp.Tape.record_func`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import warp as wp

from warpslam.camera import Intrinsics
from warpslam.decoders import DecoderWeights
from warpslam.kernels import compositing, decoder, losses, rays
from warpslam.kernels.grid import Lattice, Vec32
from warpslam.launching import decoders_for, launch_points, slice_count

STAGES = ("coarse", "middle", "fine", "color")


class PackedDecoder:
    """Weights of one decoder as the kernels read them: rows of 32, and the rows of the transposed matrices.

    weights, transposed: arrays of `Vec32`; layouts in `warpslam.kernels.decoder`.
    """

    def __init__(self, weights: DecoderWeights, device: wp.Device) -> None:
        self.level = weights.level
        self.device = device
        tensors = weights.padded().tensors
        rows, columns = (_pack_coarse if self.level == "coarse" else _pack)(tensors, self.level)
        self.weights = wp.array(rows, dtype=Vec32, device=device)
        self.transposed = wp.array(columns, dtype=Vec32, device=device)
        self._output = tensors["output_linear.weight"], tensors["output_linear.bias"]

    def unpack(self) -> DecoderWeights:
        """The weights by the reference's names (hidden width 32), as they are now."""
        if self.level == "coarse":
            raise NotImplementedError("the coarse decoder is never trained: keep the weights it was made from")
        rows = self.weights.numpy()
        size = 64 if self.level == "fine" else 32
        out = decoder.V + 5 * size
        tensors: dict[str, np.ndarray] = {}
        for k in range(5):
            tensors[f"fc_c.{k}.weight"] = rows[decoder.V + size * k : decoder.V + size * (k + 1)].T.copy()
            tensors[f"fc_c.{k}.bias"] = rows[decoder.FC_BIAS + k].copy()
        tensors["embedder._B"] = rows[:9].reshape(3, 3, 32).transpose(1, 0, 2).reshape(3, 96)[:, :93].copy()
        embedding = {0: rows[decoder.E0 : decoder.E0 + 93].T, 3: rows[decoder.E3 : decoder.E3 + 93].T}
        hidden = {k: rows[w : w + 32].T for k, w in zip((1, 2, 3, 4), _HIDDEN_ROWS, strict=True)}
        for k in range(5):
            parts = [part[k] for part in (embedding, hidden) if k in part]
            tensors[f"pts_linears.{k}.weight"] = np.concatenate(parts, axis=1)
            tensors[f"pts_linears.{k}.bias"] = rows[decoder.BIAS + k].copy()
        weight, bias = (array.copy() for array in self._output)
        # The colour decoder's fourth output takes no part, and keeps the values it was loaded with.
        used = 3 if self.level == "color" else 1
        weight[:used] = rows[out : out + used]
        bias[:used] = rows[out + used, :used]
        tensors["output_linear.weight"], tensors["output_linear.bias"] = weight, bias
        return DecoderWeights(self.level, 32, tensors)


_HIDDEN_ROWS = (decoder.W1, decoder.W2, decoder.W3, decoder.W4)


def _pack(tensors: Mapping[str, np.ndarray], level: str) -> tuple[np.ndarray, np.ndarray]:
    size = 64 if level == "fine" else 32
    outputs = 3 if level == "color" else 1
    out = decoder.V + 5 * size
    rows = np.zeros((out + outputs + 1, 32), np.float32)
    columns = np.zeros((decoder.V_T + 160, 32), np.float32)
    B = np.zeros((3, 96), np.float32)
    B[:, :93] = tensors["embedder._B"]
    rows[:9] = B.reshape(3, 3, 32).transpose(1, 0, 2).reshape(9, 32)
    linears = [tensors[f"pts_linears.{k}.weight"] for k in range(5)]
    for first, first_T, matrix in (
        (decoder.E0, decoder.E0_T, linears[0]),
        (decoder.E3, decoder.E3_T, linears[3][:, :93]),
    ):
        rows[first : first + 93] = matrix.T
        padded = np.pad(matrix, ((0, 0), (0, 3)))
        columns[first_T : first_T + 96] = padded.reshape(32, 3, 32).transpose(1, 0, 2).reshape(96, 32)
    hidden_T = (decoder.W1_T, decoder.W2_T, decoder.W3_T, decoder.W4_T)
    hidden = (linears[1], linears[2], linears[3][:, 93:], linears[4])
    for row, row_T, matrix in zip(_HIDDEN_ROWS, hidden_T, hidden, strict=True):
        rows[row : row + 32] = matrix.T
        columns[row_T : row_T + 32] = matrix
    for k in range(5):
        rows[decoder.BIAS + k] = tensors[f"pts_linears.{k}.bias"]
        rows[decoder.FC_BIAS + k] = tensors[f"fc_c.{k}.bias"]
        matrix = tensors[f"fc_c.{k}.weight"]
        rows[decoder.V + size * k : decoder.V + size * (k + 1)] = matrix.T
        columns[decoder.V_T + 32 * k : decoder.V_T + 32 * (k + 1)] = matrix[:, :32]
    rows[out : out + outputs] = tensors["output_linear.weight"][:outputs]
    rows[out + outputs, :outputs] = tensors["output_linear.bias"][:outputs]
    return rows, columns


def _pack_coarse(tensors: Mapping[str, np.ndarray], level: str) -> tuple[np.ndarray, np.ndarray]:
    linears = [tensors[f"pts_linears.{k}.weight"] for k in range(5)]
    matrices = (linears[0], linears[1], linears[2], linears[3][:, :32], linears[3][:, 32:], linears[4])
    firsts = (decoder.C_W0, decoder.C_W1, decoder.C_W2, decoder.C_C3, decoder.C_W3, decoder.C_W4)
    rows = np.zeros((decoder.C_OUT + 2, 32), np.float32)
    columns = np.zeros((decoder.C_BIAS, 32), np.float32)
    for first, matrix in zip(firsts, matrices, strict=True):
        rows[first : first + 32] = matrix.T
        columns[first : first + 32] = matrix
    for k in range(5):
        rows[decoder.C_BIAS + k] = tensors[f"pts_linears.{k}.bias"]
    rows[decoder.C_OUT] = tensors["output_linear.weight"][0]
    rows[decoder.C_OUT + 1, 0] = tensors["output_linear.bias"][0]
    return rows, columns


@dataclass
class FieldArrays:
    """What a query of the field reads.

    lattices, features: by level; features are arrays of `Vec32`, one row a vertex.
    decoders: packed weights by level.
    low, high: the map's bound [m]; samples on or beyond it are opaque and constant.
    """

    lattices: dict[str, Lattice]
    features: dict[str, wp.array]
    decoders: dict[str, PackedDecoder]
    low: wp.vec3
    high: wp.vec3


@dataclass
class GridGradient:
    """Gradient of one level: ``buffers`` (slices, rows) of `Vec32`; rows with ``selected`` 0 get none."""

    buffers: wp.array
    selected: wp.array


@dataclass
class Gradients:
    """Which gradients an iteration wants; everything absent is never computed.

    grids: by level.
    points: sample positions, and through them rays and poses.
    color_weights: (slices, rows) buffers of `Vec32` for the colour decoder, or None.
    """

    grids: dict[str, GridGradient] = field(default_factory=dict)
    points: bool = False
    color_weights: wp.array | None = None


class RayBatch:
    """Device arrays of up to ``capacity`` rays with up to ``max_samples`` samples each, and the stages that fill them.
    """

    def __init__(self, capacity: int, max_samples: int, device: wp.Device) -> None:
        self.capacity, self.max_samples, self.device = capacity, max_samples, device
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
        self.bits = {
            level: wp.zeros((points, decoder.MASK_WORDS), dtype=wp.uint32, device=device)
            for level in ("middle", "fine", "color")
        }
        self.bits["coarse"] = self.bits["middle"]
        empty = wp.zeros((1, 1), dtype=Vec32, device=device)
        self._no_rows, self._no_selection = empty, wp.zeros(1, dtype=wp.uint8, device=device)
        self._activations = self._layer_grad = empty

    # -- filling in the rays -------------------------------------------------------------------------------------

    def draw(
        self,
        images: tuple[wp.array, wp.array, wp.array],
        window: wp.array,
        rays_per_frame: int,
        camera: Intrinsics,
        *,
        seed: int,
        edge_u: int = 0,
        edge_v: int = 0,
    ) -> None:
        """Draw random pixels of the window's images (colour, depth, depth scale; see `warpslam.keyframes.ImagePool`).
        """
        self.count = window.shape[0] * rays_per_frame
        rgb, depth, scale = images
        self._launch(
            rays.draw_pixels,
            self.count,
            [seed, rays_per_frame, window, edge_u, edge_v, *_camera_vectors(camera), rgb, depth, scale],
            [self.frame, self.direction_camera, self.measured_depth, self.measured_rgb],
        )

    def set_pixels(self, first_row: int, row_count: int, camera: Intrinsics, stride: int = 1) -> None:
        """All pixels of ``row_count`` rows of an image that takes every ``stride``-th pixel."""
        width = -(-camera.width // stride)
        self.count = row_count * width
        self._launch(
            rays.grid_pixels,
            self.count,
            [first_row, width, stride, *_camera_vectors(camera)],
            [self.frame, self.direction_camera],
        )

    def set_points(self, points: np.ndarray) -> None:
        """Query points, shape (N, 3) [m], as rays of one sample at z = 0."""
        self.count = len(points)
        self.sample_count = 1
        self.origin[: self.count].assign(np.ascontiguousarray(points, np.float32))
        self.direction.zero_()
        self.z.zero_()
        self.keep.fill_(1)

    def cast(self, poses: wp.array) -> None:
        """Rays of the pixels for pose vectors ``poses``, shape (frames, 7); recorded on an active tape."""
        wp.launch(
            rays.cast_rays,
            dim=self.count,
            inputs=[poses, self.frame, self.direction_camera],
            outputs=[self.origin, self.direction],
            device=self.device,
            record_tape=poses.requires_grad,
        )

    def bound(self, arrays: FieldArrays, *, use_depth: bool = True) -> None:
        """Exit distances and the rays to keep (a measured surface outside the bound drops its ray)."""
        self.max_depth.zero_()
        self._launch(
            rays.bound_rays,
            self.count,
            [arrays.low, arrays.high, self.origin, self.direction, self.measured_depth, int(use_depth)],
            [self.t_exit, self.keep, self.max_depth],
        )

    def place_samples(
        self, stratified: int, surface: int, *, use_depth: bool = True, jitter: bool = False, seed: int = 0
    ) -> None:
        """Depths of the samples along each kept ray, ascending."""
        self.sample_count = stratified + (surface if use_depth else 0)
        self._launch(
            rays.place_samples,
            self.count,
            [seed, int(jitter), stratified, self.sample_count - stratified, int(use_depth)]
            + [self.measured_depth, self.t_exit, self.keep, self.max_depth],
            [self.z],
        )

    # -- the field -----------------------------------------------------------------------------------------------

    def query(self, arrays: FieldArrays, stage: str) -> None:
        """Logit (and colour, in the colour stage) of every sample: `logit`, `color`."""
        kernels, points = self.kernels, self.count * self.sample_count
        sample = [32, self.sample_count, self.origin, self.direction, self.z, self.keep]

        def grid(level: str) -> list:
            return [arrays.lattices[level], arrays.features[level]]

        def weights(level: str) -> list:
            return [arrays.decoders[level].weights, self.bits[level]]

        if stage == "coarse":
            self._points(kernels.coarse_forward, points, [*sample, *grid("coarse"), *weights("coarse"), self.logit])
            return
        self._points(kernels.middle_forward, points, [*sample, *grid("middle"), *weights("middle"), self.logit])
        if stage in ("fine", "color"):
            inputs = [*sample, *grid("fine"), *grid("middle"), *weights("fine"), self.logit]
            self._points(kernels.fine_forward, points, inputs)
        if stage == "color":
            self._query_color(arrays)

    def _query_color(self, arrays: FieldArrays, min_weight: float = 0.0, *, want_activations: bool = False) -> None:
        points = self.count * self.sample_count
        if want_activations and self._activations.shape[0] < points:
            size = self.capacity * self.max_samples
            self._activations = wp.empty((size, 5), dtype=Vec32, device=self.device)
            if self.kernels.sums_weights_apart:
                self._layer_grad = wp.empty((size, 10), dtype=Vec32, device=self.device)
        inputs = [32, self.sample_count, self.origin, self.direction, self.z, self.keep, arrays.lattices["color"]]
        inputs += [arrays.features["color"], arrays.decoders["color"].weights, self.bits["color"]]
        inputs += [int(want_activations), self._activations, self.weight, min_weight, self.color]
        self._points(self.kernels.color_forward, points, inputs)

    def render(
        self,
        arrays: FieldArrays,
        stage: str,
        gradients: Gradients | None = None,
        tape: wp.Tape | None = None,
        *,
        min_weight: float = 0.0,
        min_gradient: float = 0.0,
    ) -> None:
        """Depth, colour and variance of every ray (Eq. 5-7).

        gradients, tape: What to differentiate, and the tape that gets the adjoint; both or neither.
        min_weight: Samples that weigh less get no colour; the colour of a ray errs by less than samples * min_weight.
        min_gradient: Derivatives of the loss by a logit up to this are dropped. 0 and 0 are exact.
        """
        want_weights = gradients is not None and gradients.color_weights is not None
        self.query(arrays, "fine" if stage == "color" else stage)
        self._launch(
            compositing.composite,
            self.count,
            [self.sample_count, arrays.low, arrays.high, self.origin, self.direction, self.z, self.keep, self.logit],
            [self.weight, self.depth, self.variance],
        )
        if stage == "color":
            self._query_color(arrays, min_weight, want_activations=want_weights)
            inputs = [self.sample_count, self.keep, self.color, self.weight]
            self._launch(compositing.composite_color, self.count, inputs, [self.rgb])
        else:
            self.rgb.zero_()
        if gradients is not None:
            if tape is None:
                raise ValueError("gradients are recorded on a tape: pass the active one")
            tape.record_func(
                lambda: self._backward(arrays, stage, gradients, min_weight, min_gradient), [self.depth, self.rgb]
            )

    def take_surface_depth(self, min_occupancy: float) -> None:
        """After `render`: replace the mean depth of each ray by that of its first sample with ``min_occupancy``."""
        inputs = [self.sample_count, self.keep, self.z, self.logit, self.weight, min_occupancy]
        self._launch(compositing.surface_depth, self.count, inputs, [self.depth])

    def _backward(
        self, arrays: FieldArrays, stage: str, gradients: Gradients, min_weight: float, min_gradient: float
    ) -> None:
        kernels, points = self.kernels, self.count * self.sample_count
        with_color = int(stage == "color")
        self._launch(
            compositing.composite_backward,
            self.count,
            [self.sample_count, self.z, self.keep, self.logit, with_color, self.color, self.weight, min_weight],
            [self.depth.grad, self.rgb.grad, self.logit_grad, self.color_grad],
        )
        sample = [32, self.sample_count, self.origin, self.direction, self.z]
        want_points = int(gradients.points)

        def grid_gradient(level: str) -> list:
            wanted = gradients.grids.get(level)
            if wanted is None:
                return [0, self._no_selection, self._no_rows]
            return [1, wanted.selected, wanted.buffers]

        def common(level: str) -> list:
            packed = arrays.decoders[level]
            return [*sample, arrays.lattices[level], arrays.features[level], packed.weights, packed.transposed]

        if stage == "coarse":
            packed = arrays.decoders["coarse"]
            inputs = [*sample, arrays.lattices["coarse"], packed.weights, packed.transposed, self.bits["coarse"]]
            inputs += [self.logit_grad, *grid_gradient("coarse")[1:]]
            self._points(kernels.coarse_backward, points, inputs, with_slot=True)
            return
        levels = ("middle",) if stage == "middle" else ("middle", "fine")
        for level in levels:
            if gradients.points or level in gradients.grids:
                output = decoder.OUT_64 if level == "fine" else decoder.OUT_32
                inputs = [*common(level), output, self.bits[level], self.logit_grad, min_gradient]
                inputs += [*grid_gradient(level), want_points, self.point_grad]
                self._points(kernels.geometry_backward, points, inputs, with_slot=True)
        want_weights = gradients.color_weights is not None
        if stage == "color" and (gradients.points or want_weights or "color" in gradients.grids):
            buffers = gradients.color_weights if want_weights else self._no_rows
            inputs = [*common("color"), self.bits["color"], self.color_grad, *grid_gradient("color")]
            inputs += [want_points, self.point_grad, int(want_weights), self._activations, buffers, self._layer_grad]
            self._points(kernels.color_backward, points, inputs, with_slot=True)
            if want_weights and kernels.sums_weights_apart:
                chunk = 256
                self._launch(
                    kernels.color_weights,
                    (-(-points // chunk), decoder.COLOR_WEIGHT_ROWS),
                    [points, chunk, *common("color"), self._activations, self.color_grad, self._layer_grad],
                    [buffers],
                )
        if gradients.points:
            self._launch(
                rays.collect_ray_gradients,
                self.count,
                [self.sample_count, self.keep, self.z, self.point_grad],
                [self.origin.grad, self.direction.grad],
            )

    # -- losses --------------------------------------------------------------------------------------------------

    def mapping_loss(self, color_weight: float, depth_weight: float = 1.0) -> None:
        """Eq. 8-10; `loss` holds the sum. Recorded on an active tape."""
        self.loss.zero_()
        wp.launch(
            losses.mapping_loss,
            dim=self.count,
            inputs=[
                self.keep,
                self.measured_depth,
                self.measured_rgb,
                depth_weight,
                color_weight,
                self.depth,
                self.rgb,
            ],
            outputs=[self.loss],
            device=self.device,
        )

    def choose_inliers(self, filter_factor: float, *, median_includes_missing: bool = False) -> None:
        """Normalised residuals, their median and the inliers (Sec. 3.3, dynamic objects)."""
        self.counts.zero_()
        self._launch(
            losses.tracking_residuals,
            self.count,
            [self.keep, self.measured_depth, self.depth, self.variance, int(median_includes_missing)],
            [self.sigma, self.residual, self.counts],
        )
        if filter_factor > 0.0:
            residual = self.residual[: self.count]
            self._launch(losses.lower_median, self.count, [residual, self.counts], [self.median])
        self._launch(
            losses.choose_inliers,
            self.count,
            [self.keep, self.measured_depth, self.residual, self.median, filter_factor],
            [self.inlier, self.counts[1:]],
        )

    def tracking_loss(self, color_weight: float) -> None:
        """Eq. 11-12 over the inliers; `loss` holds the sum. Recorded on an active tape."""
        self.loss.zero_()
        wp.launch(
            losses.tracking_loss,
            dim=self.count,
            inputs=[self.inlier, self.measured_depth, self.measured_rgb, self.sigma, 1.0, color_weight]
            + [self.depth, self.rgb],
            outputs=[self.loss],
            device=self.device,
        )

    def pose_jacobians(
        self, arrays: FieldArrays, *, min_weight: float = 0.0, min_gradient: float = 0.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Derivative of every ray's depth and grey value by a motion of the camera, each float32 (rays, 6), after
        `render`.

        Motion: translation (world), then rotation about the camera centre (world axes): o' = o + t, d' = d + w x d.
        """
        result = []
        wanted = Gradients(points=True)
        for depth_seed, rgb_seed in ((1.0, wp.vec3()), (0.0, wp.vec3(1.0 / 3.0, 1.0 / 3.0, 1.0 / 3.0))):
            self.depth.grad.fill_(depth_seed)
            self.rgb.grad.fill_(rgb_seed)
            self.origin.grad.zero_()
            self.direction.grad.zero_()
            self._backward(arrays, "color", wanted, min_weight, min_gradient)
            by_origin = self.origin.grad.numpy()[: self.count]
            by_direction = self.direction.grad.numpy()[: self.count]
            turned = np.cross(self.direction.numpy()[: self.count], by_direction)
            result.append(np.concatenate([by_origin, turned], axis=1))
        # The tape's adjoints add to these.
        self.depth.grad.zero_()
        self.rgb.grad.zero_()
        self.origin.grad.zero_()
        self.direction.grad.zero_()
        return result[0], result[1]

    # -- launching -----------------------------------------------------------------------------------------------

    def _launch(self, kernel: wp.Kernel, dim, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device, record_tape=False)

    def _points(self, kernel: wp.Kernel, count: int, inputs: list, *, with_slot: bool = False) -> None:
        launch_points(kernel, count, inputs, self.device, with_slot=with_slot)


def gradient_buffers(row_count: int, device: wp.Device) -> wp.array:
    """Zeroed buffers (slices, row_count) of `Vec32` for the gradient of a grid or of decoder weights."""
    return wp.zeros((slice_count(device), row_count), dtype=Vec32, device=device)


def _camera_vectors(camera: Intrinsics) -> list:
    return [wp.vec2(camera.fx, camera.fy), wp.vec2(camera.cx, camera.cy)]
