"""Camera tracking (Sec. 3.3): the pose of one frame against a fixed map, Eq. 11-12."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from warpslam.camera import Intrinsics, pose_from_vector, vector_from_pose
from warpslam.config import SamplingConfig, TrackingConfig
from warpslam.field import FieldArrays, Gradients, RayBatch
from warpslam.keyframes import ImagePool
from warpslam.optimizers import PoseOptimizer

# Gauss-Newton: residuals below the floors count as squares; damping; largest step.
DEPTH_FLOOR = 0.005
SIGMA_FLOOR = 0.005
GREY_FLOOR = 0.02
DAMPING = 1e-3
MAX_TRANSLATION = 0.05
MAX_ROTATION = 0.05


@dataclass(frozen=True)
class TrackingResult:
    """Outcome of tracking one frame.

    T_world_camera: Estimated pose (4, 4).
    loss: Mean loss per inlier on the fixed pixels.
    depth_error: Mean |D - D^| over the inliers [m].
    inliers: Inliers over rays with a measured depth, in [0, 1].
    """

    T_world_camera: np.ndarray
    loss: float
    depth_error: float
    inliers: float


class Tracker:
    """Optimises the pose vector of the frame in slot 0 of the image pool by Adam, 200 rays an iteration by default."""

    def __init__(
        self, camera: Intrinsics, config: TrackingConfig, sampling: SamplingConfig, device: wp.Device, seed: int
    ) -> None:
        self.camera, self.config, self.sampling, self.device, self.seed = camera, config, sampling, device, seed
        self._batch = self._new_batch(config.pixels)
        self._poses = PoseOptimizer(1, device)
        self._window = wp.zeros(1, dtype=int, device=device)
        self._gradients = Gradients(points=True)
        self._thresholds = {"min_weight": sampling.min_weight, "min_gradient": sampling.min_gradient}

    def track(
        self, arrays: FieldArrays, images: ImagePool, frame: int, initial: np.ndarray, *, effort: int = 1
    ) -> TrackingResult:
        """Estimate the pose of frame ``frame``, starting from ``initial`` (4, 4); ``effort`` multiplies pixels and
        iterations.
        """
        config = self.config
        batch = self._batch if effort == 1 else self._new_batch(config.pixels * effort)
        start = vector_from_pose(initial)
        method = self._descend if config.optimizer == "adam" else self._gauss_newton
        visited = method(batch, arrays, images, frame, start, config.iterations * effort)
        candidates = [visited[-1]]
        if config.keep_best == "fixed_pixels":
            # Different pixels give different losses; only a comparison on the same ones means something.
            candidates += [start, visited[len(visited) // 2 :].mean(axis=0)]
        candidates = [vector for vector in candidates if np.isfinite(vector).all()] or [start]
        results = [self._judge(batch, arrays, images, frame, vector) for vector in candidates]
        return min(results, key=lambda result: result.loss)

    def _descend(
        self, batch: RayBatch, arrays: FieldArrays, images: ImagePool, frame: int, start: np.ndarray, iterations: int
    ) -> np.ndarray:
        """The paper's optimiser: Adam on the pose vector, new pixels every iteration. Returns the poses visited, (n,
        7).
        """
        config = self.config
        self._poses.begin(start[None])
        visited = np.empty((iterations, 7))
        for iteration in range(iterations):
            with wp.Tape() as tape:
                self._evaluate(batch, arrays, images, self._ray_seed(frame, iteration), tape)
                batch.tracking_loss(config.color_weight)
            tape.backward(batch.loss)
            progress = iteration / max(iterations - 1, 1)
            rate = config.learning_rate * config.final_rate_factor**progress
            self._poses.update(rate * config.rotation_rate_factor, rate)
            visited[iteration] = self._poses.vectors()[0]
        return visited

    def _gauss_newton(
        self, batch: RayBatch, arrays: FieldArrays, images: ImagePool, frame: int, start: np.ndarray, iterations: int
    ) -> np.ndarray:
        """Gauss-Newton on the same loss: its absolute values are reweighted as squares, |r| ~ r^2 / max(|r0|, floor).

        Colour enters as the mean of its channels. New pixels every iteration. Returns the poses visited, (n, 7).
        """
        config = self.config
        vector = start
        visited = np.empty((iterations, 7))
        for iteration in range(iterations):
            self._poses.begin(vector[None])
            self._evaluate(batch, arrays, images, self._ray_seed(frame, iteration))
            by_depth, by_grey = batch.pose_jacobians(arrays, **self._thresholds)
            inlier = batch.inlier.numpy()[: batch.count] != 0
            sigma = batch.sigma.numpy()[: batch.count][inlier]
            depth_error = (batch.measured_depth.numpy() - batch.depth.numpy())[: batch.count][inlier]
            grey_error = (batch.measured_rgb.numpy() - batch.rgb.numpy())[: batch.count][inlier].mean(axis=1)
            weights = 1.0 / (np.maximum(sigma, SIGMA_FLOOR) * np.maximum(np.abs(depth_error), DEPTH_FLOOR))
            grey_weights = 3.0 * config.color_weight / np.maximum(np.abs(grey_error), GREY_FLOOR)
            J = np.concatenate([by_depth[inlier], by_grey[inlier]]).astype(np.float64)
            w = np.concatenate([weights, grey_weights]).astype(np.float64)
            r = np.concatenate([depth_error, grey_error]).astype(np.float64)
            usable = np.isfinite(J).all(axis=1) & np.isfinite(r) & np.isfinite(w)
            J, w, r = J[usable], w[usable], r[usable]
            H = (J * w[:, None]).T @ J
            step = np.linalg.solve(H + np.diag(DAMPING * np.diag(H) + 1e-9), (J * w[:, None]).T @ r)
            # A single step never leaves the basin that the samples around the surface can see.
            step *= min(1.0, MAX_TRANSLATION / max(np.linalg.norm(step[:3]), 1e-12))
            step *= min(1.0, MAX_ROTATION / max(np.linalg.norm(step[3:]), 1e-12))
            vector = vector_from_pose(_moved(pose_from_vector(vector), step))
            visited[iteration] = vector
        return visited

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
        self, batch: RayBatch, arrays: FieldArrays, images: ImagePool, frame: int, vector: np.ndarray
    ) -> TrackingResult:
        self._poses.begin(vector[None])
        self._evaluate(batch, arrays, images, self._ray_seed(frame, -1))
        batch.tracking_loss(self.config.color_weight)
        count = batch.count
        inlier = batch.inlier.numpy()[:count] != 0
        measured = batch.measured_depth.numpy()[:count]
        inlier_count = int(inlier.sum())
        error = np.abs(measured - batch.depth.numpy()[:count])[inlier]
        loss = float(batch.loss.numpy()[0]) / inlier_count if inlier_count else np.inf
        return TrackingResult(
            T_world_camera=pose_from_vector(vector),
            loss=loss if np.isfinite(loss) else np.inf,
            depth_error=float(error.mean()) if inlier_count else np.inf,
            inliers=inlier_count / max(int((measured > 0).sum()), 1),
        )

    def _evaluate(
        self, batch: RayBatch, arrays: FieldArrays, images: ImagePool, seed: int, tape: wp.Tape | None = None
    ) -> None:
        config = self.config
        rays = batch.capacity
        batch.draw(
            images.arrays,
            self._window,
            rays,
            self.camera,
            seed=seed,
            edge_u=config.ignore_edge_u,
            edge_v=config.ignore_edge_v,
        )
        batch.cast(self._poses.poses)
        batch.bound(arrays)
        batch.place_samples(self.sampling.stratified, self.sampling.surface, jitter=self.sampling.jitter, seed=seed)
        gradients = None if tape is None else self._gradients
        batch.render(arrays, "color", gradients, tape, **self._thresholds)
        batch.choose_inliers(config.dynamic_filter, median_includes_missing=config.median_includes_missing)

    def _ray_seed(self, frame: int, iteration: int) -> int:
        return ray_seed(self.seed, 1, frame, iteration)

    def _new_batch(self, pixels: int) -> RayBatch:
        return RayBatch(pixels, self.sampling.stratified + self.sampling.surface, self.device)


def _moved(T_world_camera: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Camera moved by a world translation and turned about its centre by a world rotation vector (step: both, (6,))."""
    angle = np.linalg.norm(step[3:])
    K = np.zeros((3, 3))
    if angle > 0:
        x, y, z = step[3:] / angle
        K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    R = np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K
    T = T_world_camera.copy()
    T[:3, :3] = R @ T[:3, :3]
    T[:3, 3] += step[:3]
    return T


def ray_seed(*key: int) -> int:
    """Seed of one batch of rays from (seed, purpose, frame, iteration): no hidden state, so runs repeat and resume
    exactly.
    """
    return int(np.random.SeedSequence([k & 0xFFFFFFFF for k in key]).generate_state(1)[0] & 0x7FFFFFFF)
