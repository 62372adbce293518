"""The network of iMAP* on the device, and batches of rays through it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
import warp as wp

from warpslam.field.arrays import entries, struct
from warpslam.field.complexity import imap_shapes
from warpslam.field.decoders import EMBEDDING_SCALE
from warpslam.field.ray_batch import RayBatch
from warpslam.kernels import imap_density, rays
from warpslam.kernels import imap_network as imap
from warpslam.kernels.compositing import Box
from warpslam.kernels.grid import Vec32
from warpslam.kernels.imap_density import Composited
from warpslam.kernels.samples import Span
from warpslam.runtime.launching import Launcher, Step
from warpslam.runtime.program import run_slices

_CHUNK = 256  # points whose weight gradients a thread sums
_IN_BLOCKS = (imap.EMBEDDING_BLOCKS, imap.BLOCKS, imap.BLOCKS, imap.BLOCKS)


@dataclass(frozen=True)
class Bound:
    """Corners of the mapped region in network units; samples on or beyond it count as outside."""

    low: wp.vec3
    high: wp.vec3


class ImapNetwork:
    """Weights as the kernels read them: rows of 32, and the rows of the transposed matrices."""

    def __init__(self, tensors: dict[str, np.ndarray], launcher: Launcher) -> None:
        self.launcher, self.device = launcher, launcher.device
        self.kernels = imap.CUDA if self.device.is_cuda else imap.CPU
        self.weights = wp.array(_pack(tensors), dtype=Vec32, device=self.device)
        self.transposed = wp.zeros(imap.TRANSPOSED_ROWS, dtype=Vec32, device=self.device)
        self.transpose()

    @classmethod
    def random(cls, seed: int, launcher: Launcher) -> ImapNetwork:
        """Xavier uniform with gain sqrt(2), of the output 1; zero biases; B normal with 25 rad a network unit."""
        rng = np.random.default_rng([seed, 11])
        tensors = {}
        for name, shape in imap_shapes().items():
            gain = 1.0 if name.startswith("output") else np.sqrt(2.0)
            if name == "embedder._B":
                array = rng.normal(0.0, EMBEDDING_SCALE, shape)
            elif name.endswith("bias"):
                array = np.zeros(shape)
            else:
                limit = gain * np.sqrt(6.0 / sum(shape))
                array = rng.uniform(-limit, limit, shape)
            tensors[name] = array.astype(np.float32)
        return cls(tensors, launcher)

    def transpose(self) -> None:
        """Bring the transposed rows in line with the weights, after every change of these."""
        for blocks, row, row_T in zip(_IN_BLOCKS, imap.LAYER, imap.LAYER_T, strict=True):
            inputs = [blocks, row, row_T, self.weights, self.transposed]
            self.launcher.launch(self.kernels.transpose, 256 * blocks, inputs)

    def tensors(self) -> dict[str, np.ndarray]:
        """The weights by name, shapes as in `warpslam.field.complexity.imap_shapes`."""
        return unpack(self.weights.numpy())


def _pack(tensors: dict[str, np.ndarray]) -> np.ndarray:
    rows = np.zeros((imap.WEIGHT_ROWS, 32), np.float32)
    B = np.pad(tensors["embedder._B"], ((0, 0), (0, 3)))
    rows[:9] = B.reshape(3, 3, 32).transpose(1, 0, 2).reshape(9, 32)
    for k, (blocks, row) in enumerate(zip(_IN_BLOCKS, imap.LAYER, strict=True)):
        matrix = tensors[f"pts_linears.{k}.weight"]
        matrix = np.pad(matrix, ((0, 0), (0, 32 * blocks - matrix.shape[1])))
        rows[row : row + 256 * blocks] = matrix.reshape(8, 32, -1).transpose(0, 2, 1).reshape(-1, 32)
        rows[imap.BIAS + 8 * k : imap.BIAS + 8 * (k + 1)] = tensors[f"pts_linears.{k}.bias"].reshape(8, 32)
    rows[imap.OUT : imap.OUT + 32] = tensors["output_linear.weight"].reshape(32, 32)
    rows[imap.OUT + 32, :4] = tensors["output_linear.bias"]
    return rows


def unpack(rows: np.ndarray) -> dict[str, np.ndarray]:
    """Tensors by name from rows (WEIGHT_ROWS, 32), of weights or of their gradient."""
    tensors = {"embedder._B": rows[:9].reshape(3, 3, 32).transpose(1, 0, 2).reshape(3, 96)[:, :93].copy()}
    for k, (blocks, row) in enumerate(zip(_IN_BLOCKS, imap.LAYER, strict=True)):
        matrix = rows[row : row + 256 * blocks].reshape(8, 32 * blocks, 32).transpose(0, 2, 1)
        size_in = imap_shapes()[f"pts_linears.{k}.weight"][1]
        tensors[f"pts_linears.{k}.weight"] = matrix.reshape(256, -1)[:, :size_in].copy()
        tensors[f"pts_linears.{k}.bias"] = rows[imap.BIAS + 8 * k : imap.BIAS + 8 * (k + 1)].reshape(256).copy()
    tensors["output_linear.weight"] = rows[imap.OUT : imap.OUT + 32].reshape(4, 256).copy()
    tensors["output_linear.bias"] = rows[imap.OUT + 32, :4].copy()
    return tensors


@dataclass(frozen=True)
class Wanted:
    """Which gradients an iteration wants."""

    points: bool = False
    """Sample positions, and through them rays and poses."""
    weights: wp.array | None = None
    """(slices, WEIGHT_ROWS) buffers of `Vec32`, or None."""


class ImapBatch(RayBatch):
    """Rays through the network; pixels, rays, bounds and losses are those of `warpslam.field.ray_batch.RayBatch`.

    stratified, importance, empty: Samples a ray of each kind; density and colour of the first two are composited.
    training: Whether activations are kept for the adjoint.
    """

    def __init__(
        self, capacity: int, stratified: int, importance: int, empty: int, launcher: Launcher, *, training: bool = True
    ) -> None:
        self.stratified, self.importance, self.empty = stratified, importance, empty
        self.visible = stratified + importance
        samples = self.visible + empty
        super().__init__(capacity, samples, launcher.device, launcher)
        self.sample_count = samples
        self.kernels_imap = imap.CUDA if self.device.is_cuda else imap.CPU
        points = capacity * samples

        def blocks(count: int) -> wp.array:
            return wp.zeros((count, points), dtype=Vec32, device=self.device)

        self.order = wp.zeros(points, dtype=int, device=self.device)
        self.in_front = wp.zeros(points, dtype=float, device=self.device)
        self.embedding = blocks(imap.EMBEDDING_BLOCKS)
        # Without an adjoint, two layers take turns.
        kept = [blocks(imap.BLOCKS) for _ in range(imap.LAYERS if training else 2)]
        self.layers = [kept[k % len(kept)] for k in range(imap.LAYERS)]
        self.training = training
        if training:
            self._d = blocks(imap.BLOCKS), blocks(imap.BLOCKS)
            self._d_embedding = blocks(imap.EMBEDDING_BLOCKS)

    @property
    def density(self) -> wp.array:
        """Density of every sample, before the ReLU."""
        return self.logit

    @property
    def composited(self) -> Composited:
        """The samples as compositing takes them."""
        return struct(
            Composited,
            order=self.order,
            density=self.density,
            color=self.color,
            weight=self.weight,
            transmittance=self.in_front,
        )

    def evaluate(
        self,
        network: ImapNetwork,
        bound: Bound,
        wanted: Wanted | None = None,
        tape: wp.Tape | None = None,
        *,
        use_depth: bool = True,
        jitter: bool = False,
        empty_weight: float = 0.0,
    ) -> None:
        """Place the samples of each kept ray and composite depth, colour and variance.

        wanted, tape: What to differentiate, and the tape that gets the adjoint; both or neither.
        empty_weight: Of |density| at the empty samples, whose adjoint is that of the sum over rays.
        """
        samples = self.sample_count
        corners = [struct(Box, low=bound.low, high=bound.high), self.rays]

        def steps(first: int, stop: int, slot: int) -> list[Step]:
            ray_count = stop - first
            inputs = [first, self.draws, int(jitter), self.stratified, int(use_depth)]
            inputs += [self.measured_depth, self.t_exit, self.max_depth, self.rays]
            result: list[Step] = [(imap_density.place_stratified, ray_count, inputs)]
            if self.empty:
                inputs = [first, self.draws, self.visible, self.empty, self.measured_depth, self.rays]
                result.append((imap_density.place_empty, ray_count, inputs))
            result += self._forward(network, first, stop, 0, self.stratified)
            inputs = [first, self.stratified, self.importance, self.keep, *corners]
            inputs += [self.density, self.weight, self.order]
            result.append((imap_density.place_importance, ray_count, inputs))
            result += self._forward(network, first, stop, self.stratified, samples - self.stratified)
            inputs = [first, self.visible, self.keep, *corners, self.composited]
            inputs += [self.depth, self.variance, self.rgb]
            result.append((imap_density.composite, ray_count, inputs))
            return result

        self.launcher.slices(self.count, steps)
        if wanted is not None and tape is not None:
            adjoint = partial(self._backward, network, bound, wanted, empty_weight)
            commands = self.launcher.slice_commands(self.count, adjoint)
            tape.record_func(partial(run_slices, commands), [self.depth, self.rgb])

    def add_empty_loss(self, empty_weight: float) -> None:
        """Add the sum of ``empty_weight`` |density| over the empty samples to `loss`."""
        inputs = [self.visible, self.sample_count, empty_weight, self.keep, self.density, self.loss]
        self.launcher.launch(imap_density.empty_loss, self.count, inputs)

    def query_points(self, network: ImapNetwork, points: np.ndarray) -> None:
        """Density and colour at points (N, 3) in network units; needs a batch of one sample a ray."""
        self.set_points(points)
        self.launcher.slices(self.count, lambda first, stop, slot: self._forward(network, first, stop, 0, 1))

    def _forward(self, network: ImapNetwork, first: int, stop: int, sample: int, width: int) -> list[Step]:
        """Density and colour of some samples of the rays ``first`` to ``stop``."""
        kernels, W, count = self.kernels_imap, network.weights, (stop - first) * width
        span = struct(Span, point_count=count, first_ray=first, first_sample=sample, width=width)
        result: list[Step] = [(kernels.embed, count, [span, self.rays, W, self.embedding])]
        x = self.embedding
        for k, y in enumerate(self.layers):
            layer = _layer(_IN_BLOCKS[k], W, imap.LAYER[k], W, imap.BIAS + 8 * k)
            inputs = [span, self.sample_count, layer, x, imap.FORWARD, x, y]
            result.append((kernels.product, (imap.BLOCKS, -(-count // 4)), inputs))
            x = y
        result.append((kernels.output, count, [span, self.sample_count, W, x, self.color, self.density]))
        return result

    def _backward(
        self, network: ImapNetwork, bound: Bound, wanted: Wanted, empty_weight: float, first: int, stop: int, slot: int
    ) -> list[Step]:
        kernels, samples, W, T = self.kernels_imap, self.sample_count, network.weights, network.transposed
        start, end = first * samples, stop * samples
        count, chunks = end - start, -(-(end - start) // _CHUNK)
        span = struct(Span, point_count=count, first_ray=first, first_sample=0, width=samples)
        parts = struct(imap.Chunks, start=start, stop=end, size=_CHUNK, slot=slot)
        gradient = struct(
            imap_density.CompositeGradient,
            depth_grad=self.depth.grad,
            rgb_grad=self.rgb.grad,
            density_grad=self.logit_grad,
            color_grad=self.color_grad,
        )
        inputs = [first, self.visible, self.keep, struct(Box, low=bound.low, high=bound.high), self.rays]
        inputs += [self.composited, empty_weight, gradient]
        result: list[Step] = [(imap_density.composite_backward, stop - first, inputs)]
        d, other = self._d
        inputs = [start, W, self.layers[-1], self.color_grad, self.logit_grad, d]
        result.append((kernels.output_backward, count, inputs))
        if wanted.weights is not None:
            inputs = [parts, self.layers[-1], self.color_grad, self.logit_grad, wanted.weights]
            result.append((kernels.output_weights, (chunks, imap.BLOCKS), inputs))
        for k in reversed(range(imap.LAYERS)):
            x = self.layers[k - 1] if k else self.embedding
            blocks = _IN_BLOCKS[k]
            if wanted.weights is not None:
                inputs = [parts, blocks, imap.LAYER[k], entries(x), d, wanted.weights]
                result.append((kernels.layer_weights, (chunks, imap.BLOCKS, 4 * blocks), inputs))
                inputs = [parts, imap.BIAS + 8 * k, d, wanted.weights]
                result.append((kernels.bias_weights, (chunks, imap.BLOCKS), inputs))
            target, mode = (other, imap.ADJOINT) if k else (self._d_embedding, imap.UNMASKED)
            layer = _layer(imap.BLOCKS, T, imap.LAYER_T[k], W, 0)
            inputs = [span, samples, layer, d, mode, x, target]
            result.append((kernels.product, (blocks, -(-count // 4)), inputs))
            d, other = target, d
        inputs = [start, self.rays, W, self._d_embedding, int(wanted.points), self.point_grad]
        result.append((kernels.embed_backward, count, inputs))
        if wanted.weights is not None:
            inputs = [parts, self.rays, self._d_embedding, wanted.weights]
            result.append((kernels.embedding_weights, (chunks, imap.EMBEDDING_BLOCKS), inputs))
        if wanted.points:
            inputs = [first, self.rays, self.keep, self.keep, self.point_grad]
            inputs += [self.origin.grad, self.direction.grad]
            result.append((rays.collect_ray_gradients, stop - first, inputs))
        return result


def _layer(in_blocks: int, W: wp.array, row: int, bias: wp.array, bias_row: int) -> imap.Layer:
    return struct(imap.Layer, trips=32, in_blocks=in_blocks, W=W, row=row, bias=bias, bias_row=bias_row)
