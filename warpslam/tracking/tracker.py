"""Camera tracking (Sec. 3.3): the pose of one frame against a fixed map, Eq. 11-12."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
import warp as wp

from warpslam.camera import Intrinsics
from warpslam.config import SamplingConfig, TrackingConfig
from warpslam.field.arrays import FieldArrays, Gradients, Thresholds
from warpslam.field.objectives import choose_inliers, gauss_newton_step, note_rays, tracking_loss
from warpslam.field.passes import render
from warpslam.field.ray_batch import RayBatch
from warpslam.field.seeds import ray_seed
from warpslam.kernels import adam
from warpslam.poses import pose_from_vector, vector_from_pose
from warpslam.runtime.launching import Launcher
from warpslam.scene.image_pool import ImagePool
from warpslam.scene.optimizers import PoseOptimizer

MAX_CANDIDATES = 3
MIN_SEEN_SHARE = 0.2
"""Where less of a frame's depth lies in what the map has seen, the share of inliers goes down as if this much did."""


@dataclass(frozen=True)
class TrackingResult:
    """Outcome of tracking one frame.

    T_world_camera: Estimated pose (4, 4).
    loss: Mean loss per inlier on the fixed pixels, those of the coarse term included (`TrackingConfig.coarse_term`).
    depth_error: Mean |D - D^| over the inliers [m].
    inliers: Inliers over rays with a measured depth that count (`TrackingConfig.seen_only`), in [0, 1]; less if few do.
    agreeing: Inliers over all rays with a measured depth, in [0, 1].
    """

    T_world_camera: np.ndarray
    loss: float
    depth_error: float
    inliers: float
    agreeing: float


class Tracker:
    """Optimises the pose of the frame in slot 0 of the image pool, with new random rays in every iteration."""

    def __init__(
        self, camera: Intrinsics, config: TrackingConfig, sampling: SamplingConfig, device: wp.Device, seed: int
    ) -> None:
        self.camera, self.config, self.sampling, self.device, self.seed = camera, config, sampling, device, seed
        self._launcher = Launcher(device)
        self._batch = self._new_batch(config.pixels)
        self._forecast: RayBatch | None = None
        self._poses = PoseOptimizer(1, self._launcher)
        self._window = wp.zeros(1, dtype=int, device=device)
        self._visited = wp.zeros((1, 7), dtype=float, device=device)
        self._candidates = wp.zeros((MAX_CANDIDATES, 7), dtype=float, device=device)
        self._judged = wp.zeros((MAX_CANDIDATES, config.pixels + 1, 4), dtype=float, device=device)
        self._thresholds = Thresholds(sampling.min_weight, sampling.min_gradient, sampling.min_transmittance)

    def track(
        self,
        arrays: FieldArrays,
        images: ImagePool,
        frame: int,
        initial: np.ndarray,
        *,
        effort: int = 1,
        iteration_factor: int = 1,
    ) -> TrackingResult:
        """Estimate the pose of frame ``frame``, starting from ``initial`` (4, 4); ``effort`` multiplies pixels and
        iterations, ``iteration_factor`` iterations alone.
        """
        config = self.config
        batch = self._batch if effort == 1 else self._new_batch(config.pixels * effort)
        start = vector_from_pose(initial)
        visited = self._optimize(batch, arrays, images, frame, start, config.iterations * effort * iteration_factor)
        candidates = [visited[-1]]
        if config.keep_best == "fixed_pixels":
            # Different pixels give different losses; only a comparison on the same ones means something.
            candidates += [start, visited[len(visited) // 2 :].mean(axis=0)]
        candidates = [vector for vector in candidates if np.isfinite(vector).all()] or [start]
        return min(self._judge(batch, arrays, images, frame, candidates), key=lambda result: result.loss)

    def _optimize(
        self, batch: RayBatch, arrays: FieldArrays, images: ImagePool, frame: int, start: np.ndarray, iterations: int
    ) -> np.ndarray:
        """New pixels every iteration; nothing comes back from the device before the last. The poses visited, (n, 7)."""
        config = self.config
        progress = np.linspace(0.0, 1.0, iterations)[:, None]
        rates = config.learning_rate * config.final_rate_factor**progress * [config.rotation_rate_factor, 1.0]
        self._poses.begin(start[None], rates)
        batch.set_seeds([self._ray_seed(frame, iteration) for iteration in range(iterations)])
        if self._visited.shape[0] != iterations:
            self._visited = wp.zeros((iterations, 7), dtype=float, device=self.device)
        method = self._descend if config.optimizer == "adam" else self._gauss_newton

        def iterate() -> None:
            method(batch, arrays, images)
            self._launcher.launch(adam.note_pose, 7, [batch.iteration, self._poses.poses, self._visited])
            batch.next_iteration()

        uses = (config.optimizer, config.color_weight, self._poses.rates, self._visited, *self._uses(batch, arrays))
        for _ in range(iterations):
            self._launcher.iterate("optimize", (*uses, *images.arrays), iterate)
        return self._visited.numpy().astype(np.float64)

    def _descend(self, batch: RayBatch, arrays: FieldArrays, images: ImagePool) -> None:
        """The paper's optimiser: a step of Adam on the pose vector."""
        with self._launcher.tape() as tape:
            self._render(batch, arrays, images, tape)
            tracking_loss(batch, self.config.color_weight, self._forecast_of(batch))
        self._launcher.call(partial(tape.backward, batch.loss))
        self._poses.update()

    def _gauss_newton(self, batch: RayBatch, arrays: FieldArrays, images: ImagePool) -> None:
        """A Gauss-Newton step on the same loss: its absolute values are reweighted as squares, and colour enters as the
        mean of its channels.
        """
        self._render(batch, arrays, images)
        gauss_newton_step(batch, arrays, self._poses.poses, self.config.color_weight, thresholds=self._thresholds)

    def explained_share(self, known_error: float) -> float:
        """Share of the last judged pixels whose rendered depth is within ``known_error`` x D (information gain, Sec.
        3.4).
        """
        count = self._batch.count
        measured = self._batch.measured_depth.numpy()[:count]
        valid = (measured > 0) & (self._batch.keep.numpy()[:count] != 0)
        # Rays that leave the map are unexplained, too.
        usable = measured > 0
        error = np.abs(measured - self._batch.depth.numpy()[:count])
        explained = valid & (error < known_error * np.maximum(measured, 1e-6))
        return float(explained.sum() / max(usable.sum(), 1))

    def _judge(
        self, batch: RayBatch, arrays: FieldArrays, images: ImagePool, frame: int, vectors: list[np.ndarray]
    ) -> list[TrackingResult]:
        """What pose vectors come to, all on the same pixels; nothing comes back from the device before the last."""
        self._candidates[: len(vectors)].assign(np.asarray(vectors, np.float32))
        if self._judged.shape[1] != batch.capacity + 1:
            self._judged = wp.zeros((MAX_CANDIDATES, batch.capacity + 1, 4), dtype=float, device=self.device)
        batch.set_seeds([self._ray_seed(frame, -1)] * len(vectors))

        def judge() -> None:
            self._launcher.launch(adam.take_pose, 7, [batch.iteration, self._candidates, self._poses.poses])
            self._render(batch, arrays, images)
            forecast = self._forecast_of(batch)
            tracking_loss(batch, self.config.color_weight, forecast)
            note_rays(batch, self._judged, forecast)
            batch.next_iteration()

        uses = (self.config.color_weight, self._judged, *self._uses(batch, arrays), *images.arrays)
        for _ in vectors:
            self._launcher.iterate("judge", uses, judge)
        return [_result(*pair) for pair in zip(vectors, self._judged.numpy(), strict=False)]

    def _render(self, batch: RayBatch, arrays: FieldArrays, images: ImagePool, tape: wp.Tape | None = None) -> None:
        config, sampling = self.config, self.sampling
        self._draw(batch, arrays, images, tape)
        if config.seen_only:
            batch.drop_unseen(arrays)
        batch.place_samples(sampling.stratified, sampling.surface, jitter=sampling.jitter)
        gradients = None if tape is None else Gradients(points=True)
        render(batch, arrays, "color", gradients, tape, thresholds=self._thresholds)
        choose_inliers(
            batch,
            config.dynamic_filter,
            median_includes_missing=config.median_includes_missing,
            color_weight=config.color_weight if config.filter_by == "loss" else 0.0,
        )
        forecast = self._forecast_of(batch)
        if forecast is not None:
            # As the coarse level was trained (`warpslam.mapping.coarse`): what a ray renders to depends on how densely
            # its samples lie, and depth must not place them about itself.
            self._draw(forecast, arrays, images, tape)
            forecast.keep_unseen(arrays)
            forecast.place_samples(sampling.stratified, 0, use_depth=False, jitter=sampling.jitter)
            render(forecast, arrays, "coarse", gradients, tape, thresholds=self._thresholds)
            choose_inliers(forecast, config.dynamic_filter)

    def _draw(self, batch: RayBatch, arrays: FieldArrays, images: ImagePool, tape: wp.Tape | None) -> None:
        """Random pixels, and those of their rays that end in the map."""
        edges = (self.config.ignore_edge_u, self.config.ignore_edge_v)
        batch.draw(images.arrays, self._window, batch.capacity, self.camera, edges=edges)
        batch.cast(self._poses.poses, differentiate=tape is not None)
        batch.bound(arrays)

    def _forecast_of(self, batch: RayBatch) -> RayBatch | None:
        """The pixels of a batch once more, for the coarse term of Eq. 11 where nothing was seen; None without it."""
        if not self.config.coarse_term:
            return None
        if self._forecast is None or self._forecast.capacity != batch.capacity:
            self._forecast = RayBatch(batch.capacity, self.sampling.stratified, self.device, self._launcher)
        self._forecast.seeds, self._forecast.iteration = batch.seeds, batch.iteration
        return self._forecast

    def _uses(self, batch: RayBatch, arrays: FieldArrays) -> tuple:
        """What a recorded iteration stands on."""
        levels = ("middle", "fine", "color", *(("coarse",) if self.config.coarse_term else ()))
        features = (arrays.features[level] for level in levels)
        lattices = (arrays.lattices[level] for level in levels)
        weights = (arrays.decoders[level].weights for level in levels)
        grids = (arrays.seen, *features, *lattices, *weights, *arrays.low, *arrays.high)
        return (batch, self._forecast_of(batch), batch.seeds, self._poses.poses, *grids)

    def _ray_seed(self, frame: int, iteration: int) -> int:
        return ray_seed(self.seed, 1, frame, iteration)

    def _new_batch(self, pixels: int) -> RayBatch:
        samples = self.sampling.stratified + self.sampling.surface
        return RayBatch(pixels, samples, self.device, self._launcher)


def _result(vector: np.ndarray, judged: np.ndarray) -> TrackingResult:
    """Outcome for a pose vector from what `note_rays` kept of its rays, (rays + 1, 4)."""
    keep, inlier, measured, depth = judged[:-1].T
    has_depth = measured > 0
    depth_count = max(int(has_depth.sum()), 1)
    counting = max(int((has_depth & (keep != 0)).sum()), MIN_SEEN_SHARE * depth_count)
    inlier_count = int((inlier != 0).sum())
    error = np.abs(measured - depth)[inlier != 0]
    term_count = inlier_count + int(judged[-1, 1])
    loss = float(judged[-1, 0]) / term_count if inlier_count else np.inf
    return TrackingResult(
        T_world_camera=pose_from_vector(vector),
        loss=loss if np.isfinite(loss) else np.inf,
        depth_error=float(error.mean()) if inlier_count else np.inf,
        inliers=inlier_count / counting,
        agreeing=inlier_count / depth_count,
    )
