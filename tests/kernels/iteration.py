"""One optimisation iteration of the kernels on the oracle's inputs, with results under the oracle's names."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
import warp as wp

from tests.reference import oracle
from warpslam.field.arrays import FieldArrays, Gradients, GridGradient, gradient_buffers
from warpslam.field.decoders import DecoderWeights
from warpslam.field.objectives import choose_inliers, mapping_loss, tracking_loss
from warpslam.field.packing import PackedDecoder
from warpslam.field.passes import render
from warpslam.field.ray_batch import RayBatch
from warpslam.kernels.decoder.layout import COLOR_WEIGHT_ROWS, E0, E3
from warpslam.kernels.grid import Lattice, Vec32

MAPPED_LEVELS = {
    "coarse": ("coarse",),
    "middle": ("middle",),
    "fine": ("middle", "fine"),
    "color": ("middle", "fine", "color"),
}


@dataclass
class Rays:
    """Pixels of one batch.

    ``frame`` (N,) int: row of ``poses`` (frames, 7) it belongs to; ``direction_camera`` (N, 3); ``depth`` (N,) [m],
    0 = missing; ``rgb`` (N, 3) in [0, 1]. All float32.
    """

    poses: np.ndarray
    frame: np.ndarray
    direction_camera: np.ndarray
    depth: np.ndarray
    rgb: np.ndarray

    @classmethod
    def from_pixels(cls, poses, frame, column, row, depth, rgb, fx, fy, cx, cy) -> Rays:
        """Rays of pixels in column and row (N,)."""
        direction = np.stack([(column - cx) / fx, (row - cy) / fy, np.ones(len(column))], axis=1)
        return cls(
            *(np.asarray(a, np.float32) if a is not frame else frame for a in (poses, frame, direction, depth, rgb))
        )


@dataclass
class Gradient:
    """Loss and gradients of one iteration: feature rows by level, colour decoder by weight name, poses (frames, 7)."""

    loss: float
    rows: dict[str, np.ndarray] = field(default_factory=dict)
    color_decoder: dict[str, np.ndarray] = field(default_factory=dict)
    poses: np.ndarray | None = None


def field_on_device(source: oracle.Field, device: wp.Device) -> FieldArrays:
    """The oracle's map as the kernels read it."""
    lattices, features = {}, {}
    for level, grid in source.grids.items():
        lattice = Lattice()
        lattice.origin = wp.vec3(*grid.origin.tolist())
        lattice.inverse_spacing = wp.vec3(*(1.0 / grid.spacing).tolist())
        lattice.shape = wp.vec3i(*grid.shape)
        lattices[level] = lattice
        features[level] = wp.array(grid.rows.detach().float().numpy(), dtype=Vec32, device=device)
    decoders = {
        level: PackedDecoder(
            DecoderWeights(level, 32, {name: w.detach().float().numpy() for name, w in weights.items()}), device
        )
        for level, weights in source.decoders.items()
    }
    low, high = wp.vec3(*source.lo.tolist()), wp.vec3(*source.hi.tolist())
    return FieldArrays(lattices, features, decoders, low, high)


class Iteration:
    """A batch of rays against a map. `mapping` and `tracking` do all steps and return the gradients."""

    def __init__(self, source: oracle.Field, rays: Rays, stage: str, device: wp.Device) -> None:
        self.stage, self.device, self.count = stage, device, len(rays.depth)
        self.arrays = field_on_device(source, device)
        self.batch = RayBatch(self.count, 48, device)
        self.batch.count = self.count
        self.batch.frame.assign(np.asarray(rays.frame, np.int32))
        self.batch.direction_camera.assign(rays.direction_camera)
        self.batch.measured_depth.assign(rays.depth)
        self.batch.measured_rgb.assign(rays.rgb)
        self.poses = wp.array(rays.poses, dtype=float, device=device, requires_grad=True)
        self.dropped: np.ndarray | None = None
        self.places = {
            level: wp.array(np.arange(len(grid.rows)), dtype=int, device=device) for level, grid in source.grids.items()
        }

    def cast_and_sample(self) -> None:
        """Rays, the pre-filter and the samples; the coarse stage filters by depth, too, and then ignores it."""
        self.batch.cast(self.poses)
        self.batch.bound(self.arrays)
        if self.dropped is not None:
            self.batch.keep.assign(np.where(self.dropped, 0, self.batch.keep.numpy()))
        self.batch.place_samples(oracle.STRATIFIED_COUNT, oracle.SURFACE_COUNT, use_depth=self.stage != "coarse")

    def render(self, gradients: Gradients | None = None, tape: wp.Tape | None = None) -> None:
        """Depth, colour and variance of the rays that are cast."""
        render(self.batch, self.arrays, self.stage, gradients, tape)

    def mapping(self, *, filter_factor: float = 0.0) -> Gradient:
        """Mapping loss and the gradient of everything that the stage has one for; with a filter only rays with a depth
        error below that multiple of the median move the poses.
        """
        self.poses.grad.zero_()
        gradients = self._wanted(MAPPED_LEVELS[self.stage], points=True)
        gradients.inliers_move = filter_factor > 0
        with self.batch.launcher.tape() as tape:
            self.cast_and_sample()
            self.render(gradients, tape)
            if gradients.inliers_move:
                choose_inliers(self.batch, filter_factor, normalized=False)
            mapping_loss(self.batch, 0.2 if self.stage == "color" else 0.0)
        tape.backward(self.batch.loss)
        rows = {level: gradient.buffers.numpy().sum(axis=0) for level, gradient in gradients.grids.items()}
        weights = {}
        if gradients.color_weights is not None:
            weights = self._named_weight_gradient(gradients.color_weights.numpy().sum(axis=0))
        poses = self.poses.grad.numpy().copy()
        return Gradient(float(self.batch.loss.numpy()[0]), rows, weights, poses)

    def tracking(
        self,
        *,
        filter_factor: float = 10.0,
        median_includes_missing: bool = True,
        filter_by_loss: bool = False,
        forecast: Iteration | None = None,
    ) -> Gradient:
        """Tracking loss and the gradient of the poses alone.

        forecast: Of the coarse stage and of this one's poses and launcher: rays that add the coarse term of Eq. 11.
        """
        self.poses.grad.zero_()
        with self.batch.launcher.tape() as tape:
            self.cast_and_sample()
            self.render(Gradients(points=True), tape)
            choose_inliers(
                self.batch,
                filter_factor,
                median_includes_missing=median_includes_missing,
                color_weight=0.5 if filter_by_loss else 0.0,
            )
            if forecast is not None:
                forecast.cast_and_sample()
                forecast.render(Gradients(points=True), tape)
                choose_inliers(forecast.batch, filter_factor)
            tracking_loss(self.batch, 0.5, None if forecast is None else forecast.batch)
        tape.backward(self.batch.loss)
        return Gradient(float(self.batch.loss.numpy()[0]), poses=self.poses.grad.numpy().copy())

    def array(self, name: str) -> np.ndarray:
        """An array of the batch cut to the rays that are in use, samples as (N, S)."""
        values = getattr(self.batch, name).numpy()
        if len(values) == self.batch.capacity:
            return values[: self.count].copy()
        samples = self.batch.sample_count
        return values[: self.count * samples].reshape(self.count, samples, *values.shape[1:]).copy()

    def _wanted(self, levels, *, points: bool) -> Gradients:
        grids = {
            level: GridGradient(gradient_buffers(self.arrays.features[level].shape[0], self.device), self.places[level])
            for level in levels
        }
        weights = gradient_buffers(COLOR_WEIGHT_ROWS, self.device) if self.stage == "color" else None
        return Gradients(grids, points, weights)

    def _named_weight_gradient(self, rows: np.ndarray) -> dict[str, np.ndarray]:
        # Rows 93..95 of the embedding and of B pad it to 96: they must stay zero, so they may not get a gradient.
        for first in (E0, E3):
            assert not rows[first + 93 : first + 96].any()
        assert not rows[6:9, 29:].any()
        packed = self.arrays.decoders["color"]
        holder = PackedDecoder(packed.unpack(), self.device)
        holder.weights = wp.array(rows, dtype=Vec32, device=self.device)
        named = holder.unpack().tensors
        # The fourth output takes no part.
        named["output_linear.weight"][3] = 0.0
        named["output_linear.bias"][3] = 0.0
        return named


def relative_error(value, expected) -> float:
    """||value - expected|| / ||expected||; shapes must agree."""
    value = np.asarray(value.detach() if torch.is_tensor(value) else value, dtype=np.float64)
    expected = np.asarray(expected.detach() if torch.is_tensor(expected) else expected, dtype=np.float64)
    assert value.shape == expected.shape
    assert np.isfinite(value).all()
    scale = np.linalg.norm(expected)
    assert scale > 0
    return float(np.linalg.norm(value - expected) / scale)
