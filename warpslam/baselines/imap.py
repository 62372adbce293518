"""iMAP (Sucar et al., ICCV 2021) as the authors of NICE-SLAM re-implemented it for comparison, "iMAP*".

One network holds density and colour; there are no feature grids. The frame's pose is tracked against it by Adam; it is
trained on random pixels of the current frame, the last keyframe and random other keyframes, without bundle adjustment
and without active sampling. All lengths inside are metres times `ImapConfig.scale`.

Where this differs from the released code: the bound grows with what is seen and is not given; rays whose surface lies
beyond it are left out; the final pose of a frame is the best of start, last and mean of the second half on one fixed
set of pixels, not the one with the lowest loss, each on its own pixels; mesh colours are the network's at the vertices,
not rendered along normals.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warpslam.baselines.base import Baseline
from warpslam.baselines.imap_network import Bound, ImapBatch, ImapNetwork, Wanted, imap_shapes
from warpslam.camera import Intrinsics
from warpslam.config import Config
from warpslam.errors import InputError
from warpslam.field.complexity import flops_per_point, weight_count
from warpslam.field.objectives import choose_inliers, mapping_loss, tracking_loss
from warpslam.field.rendering import RenderedImage
from warpslam.field.seeds import ray_seed
from warpslam.frames import AdmittedFrame, FrameResult
from warpslam.kernels import adam, losses, pixels
from warpslam.kernels import imap_density as density
from warpslam.kernels import imap_network as imap
from warpslam.meshing import extract_mesh
from warpslam.poses import check_transform, pose_from_vector, vector_from_pose
from warpslam.runtime.environment import named_device
from warpslam.runtime.launching import Launcher, synchronize
from warpslam.scene.image_pool import ImagePool
from warpslam.scene.keyframes import Keyframe
from warpslam.scene.mapped_views import SEEN_STRIDE, ObservedView, SeenDepth
from warpslam.scene.optimizers import PoseOptimizer, RowOptimizer
from warpslam.storage.state_file import StateFields, StateFormat
from warpslam.trajectory import Located

if TYPE_CHECKING:
    import trimesh

TRACKING_COLOR_WEIGHT = 0.5
DECAY, DECAY_STEPS = 0.8, 200
# Samples of a rendered view, which has no depth to guide them.
_VIEW_STRATIFIED, _VIEW_IMPORTANCE = 48, 16
_VIEW_POINTS = 1 << 14
_TRACKING, _MAPPING = 21, 22  # purposes of random numbers


class Imap(Baseline):
    """iMAP* under the interface of `warpslam.slam.Slam`. Settings: `ImapConfig` and what that names."""

    name = "imap"
    form = StateFormat("warpslam-imap", 2, "the map of a run with --method imap")

    def __init__(
        self, intrinsics: Intrinsics, config: Config | None = None, device: str | None = None, seed: int = 0
    ) -> None:
        """A random network.

        Args:
            intrinsics: Camera of all frames.
            config: Settings, `Config()` by default.
            device: Warp device, "cpu" or "cuda:0"; by default CUDA where there is one.
            seed: Of the initial network and of every random choice. Same input, seed and device: same result.
        """
        super().__init__(intrinsics, config, device, seed)
        self.device = named_device(device)
        self.compile_seconds = _compile(self.device)
        self._settings = self.config.imap
        self._launcher = Launcher(self.device)
        self.network = ImapNetwork.random(seed, self._launcher)
        self.keyframes: list[Keyframe] = []
        self._low, self._high = np.full(3, np.inf), np.full(3, -np.inf)
        self._images = ImagePool(intrinsics, self.device, self.config.keyframes.max_gigabytes)
        self._seen: list[SeenDepth] = []
        self._mapped: int | None = None
        self._current: int | None = None
        settings, stratified = self._settings, self.config.sampling.stratified
        self._tracking = ImapBatch(settings.tracking_pixels, stratified, settings.importance, 0, self._launcher)
        self._mapping = ImapBatch(
            settings.mapping_pixels, stratified, settings.importance, settings.empty_samples, self._launcher
        )
        self._poses = PoseOptimizer(1, self._launcher)
        self._optimizer = RowOptimizer(self._launcher)
        self._slot_of_frame = wp.zeros(1, dtype=int, device=self.device)
        self._visited = wp.zeros((settings.tracking_iterations, 7), dtype=float, device=self.device)
        self._queries: ImapBatch | None = None

    # -- the algorithm -------------------------------------------------------------------------------------------

    def _step(self, frame: AdmittedFrame) -> FrameResult:
        index, depth, given = frame.index, frame.depth, frame.given_pose
        scale = self._settings.scale
        self._images.set(0, frame.rgb, depth * np.float32(scale))
        self._current = index
        timings: dict[str, float] = {}
        values: dict[str, float] = {}
        first = not self._seen
        if first or self.config.tracking.use_given_poses:
            located = Located(np.eye(4) if given is None else given)
        else:
            start = time.perf_counter()
            located, values["tracking"] = self._track(index)
            timings["tracking"] = time.perf_counter() - start
        self.history.add(frame.timestamp, located)
        if first or index % self.config.mapping.every == 0:
            start = time.perf_counter()
            values["mapping"] = self._map(index, depth, first)
            synchronize(self.device)
            timings["mapping"] = time.perf_counter() - start
        if not self.keyframes or index - self.keyframes[-1].index >= self.config.keyframes.every:
            image = self._images.add(frame.rgb, depth * np.float32(scale))
            self.keyframes.append(Keyframe(index, image, self.history.pose(index)))
        return FrameResult(
            index,
            frame.timestamp,
            self.history.pose(index),
            located.status,
            values,
            located.inliers,
            located.depth_error,
            timings=timings,
        )

    def finish(self) -> dict[str, float]:
        """Map the last frame if it was not, then train on a doubled window. Returns the seconds by phase."""
        timings: dict[str, float] = {}
        index, settings = self._current, self._settings
        if index is None:
            return timings
        if self._mapped != index:
            start = time.perf_counter()
            self._map(index, self._images.current_depth() / np.float32(settings.scale), first=False)
            timings["mapping"] = time.perf_counter() - start
        if self.config.mapping.color_refinement:
            start = time.perf_counter()
            for round_ in range(settings.refinement_rounds):
                self._train(index, settings.rounds + round_, settings.rounds * settings.iterations, doubled=True)
            synchronize(self.device)
            timings["refinement"] = time.perf_counter() - start
        return timings

    def _track(self, index: int) -> tuple[Located, float]:
        """The camera, and the mean loss; inliers are the share of the rays with depth that are kept."""
        start = self._scaled(vector_from_pose(self.history.starts(self.config.tracking.constant_speed)[0]))
        settings, batch = self._settings, self._tracking
        iterations = settings.tracking_iterations
        decay = self.config.tracking.final_rate_factor ** np.linspace(0.0, 1.0, iterations)[:, None]
        self._poses.begin(start[None], settings.tracking_rate * decay * [1.0, 1.0])
        batch.set_seeds([ray_seed(self.seed, _TRACKING, index, n) for n in range(iterations)])

        def iterate() -> None:
            with self._launcher.tape() as tape:
                self._tracking_loss(Wanted(points=True), tape)
            self._launcher.call(partial(tape.backward, batch.loss))
            self._poses.update()
            self._launcher.launch(adam.note_pose, 7, [batch.iteration, self._poses.poses, self._visited])
            batch.next_iteration()

        for _ in range(iterations):
            self._launcher.iterate("track", self._uses(batch), iterate)
        visited = self._visited.numpy().astype(np.float64)
        candidates = [visited[-1], start, visited[len(visited) // 2 :].mean(axis=0)]
        candidates = [vector for vector in candidates if np.isfinite(vector).all()]
        return min((self._judge(index, vector) for vector in candidates), key=lambda result: result[1])

    def _judge(self, index: int, vector: np.ndarray) -> tuple[Located, float]:
        """`_track`'s result for a pose, on pixels that are the same for all of a frame's."""
        batch = self._tracking
        self._poses.begin(vector[None])
        batch.set_seeds([ray_seed(self.seed, _TRACKING, index, -1)])
        self._launcher.iterate("judge", self._uses(batch), self._tracking_loss)
        measured = batch.measured_depth.numpy()[: batch.count]
        inlier = batch.inlier.numpy()[: batch.count] != 0
        count = int(inlier.sum())
        pose = pose_from_vector(self._scaled(vector, 1.0 / self._settings.scale))
        if not count:
            return Located(pose, inliers=0.0, depth_error=np.inf), np.inf
        error = np.abs(measured - batch.depth.numpy()[: batch.count])[inlier].mean() / self._settings.scale
        loss = float(batch.loss.numpy()[0]) / count
        located = Located(pose, inliers=count / int((measured > 0).sum()), depth_error=float(error))
        return located, loss if np.isfinite(loss) else np.inf

    def _tracking_loss(self, wanted: Wanted | None = None, tape: wp.Tape | None = None) -> None:
        config, batch, bound = self.config.tracking, self._tracking, self._bound
        edges = (config.ignore_edge_u, config.ignore_edge_v)
        batch.draw(self._images.arrays, self._slot_of_frame, batch.capacity, self.intrinsics, edges=edges)
        batch.cast(self._poses.poses, differentiate=tape is not None)
        batch.bound_to(bound.low, bound.high)
        batch.evaluate(self.network, bound, wanted, tape, jitter=self.config.sampling.jitter)
        choose_inliers(batch, 0.0)
        tracking_loss(batch, TRACKING_COLOR_WEIGHT)

    def _map(self, index: int, depth: np.ndarray, first: bool) -> float:
        """Train on the frame and on keyframes; the mean loss a ray of the last iteration."""
        seen = SeenDepth.of(index, depth)
        self._seen.append(seen)
        self._cover(seen)
        self._mapped = index
        if first:
            return self._train(index, 0, self._settings.first_iterations)
        return [self._train(index, n, self._settings.iterations) for n in range(self._settings.rounds)][-1]

    def _train(self, index: int, round_: int, iterations: int, *, doubled: bool = False) -> float:
        settings, batch = self._settings, self._mapping
        slots, poses = self._window(index, round_, self.config.mapping.window * (2 if doubled else 1))
        pixels = max(settings.mapping_pixels // slots.shape[0], 1)
        self._optimizer.start(imap.WEIGHT_ROWS, np.arange(imap.WEIGHT_ROWS))
        batch.set_seeds([ray_seed(self.seed, _MAPPING, index, n, round_) for n in range(iterations)])
        bound, wanted = self._bound, Wanted(weights=self._optimizer.gradient)

        def iterate(rate: float) -> None:
            with self._launcher.tape() as tape:
                batch.draw(self._images.arrays, slots, pixels, self.intrinsics)
                batch.cast(poses)
                batch.bound_to(bound.low, bound.high)
                jitter, weight = self.config.sampling.jitter, settings.empty_weight
                batch.evaluate(self.network, bound, wanted, tape, jitter=jitter, empty_weight=weight)
                mapping_loss(batch, settings.color_weight)
                batch.add_empty_loss(settings.empty_weight)
            self._launcher.call(partial(tape.backward, batch.loss))
            self._optimizer.update(self.network.weights, rate)
            self.network.transpose()
            batch.next_iteration()

        for n in range(iterations):
            rate = settings.mapping_rate * DECAY ** (n // DECAY_STEPS)
            uses = (slots, poses, rate, self._optimizer.rows, *self._uses(batch))
            self._launcher.iterate("train", uses, partial(iterate, rate))
        return float(batch.loss.numpy()[0]) / max(batch.count, 1)

    def _window(self, index: int, round_: int, size: int) -> tuple[wp.array, wp.array]:
        """Image slots and poses of random keyframes from all but the last, of the last one, and of the frame."""
        chosen: list[Keyframe] = []
        if self.keyframes and size > 1:
            *others, last = self.keyframes
            rng = np.random.default_rng([self.seed, _MAPPING, index, round_])
            chosen = [others[n] for n in rng.permutation(len(others))[: max(size - 2, 0)]] + [last]
        matrices = [*(keyframe.pose for keyframe in chosen), self.history.pose(index)]
        poses = np.stack([self._scaled(vector_from_pose(T)) for T in matrices]).astype(np.float32)
        slots = [*self._images.bring([keyframe.image for keyframe in chosen]), 0]
        return wp.array(slots, dtype=int, device=self.device), wp.array(poses, dtype=float, device=self.device)

    def _uses(self, batch: ImapBatch) -> tuple:
        """What a recorded iteration stands on."""
        return (batch.seeds, self._poses.poses, self._poses.rates, *self._images.arrays, *self._low, *self._high)

    def _cover(self, seen: SeenDepth) -> None:
        """Grow the bound to hold all that a frame measures, and its camera."""
        view = self._view(seen)
        points = np.concatenate([view.points(), view.T_world_camera[None, :3, 3]])
        low, high = points.min(axis=0), points.max(axis=0)
        if (low < self._low).any() or (high > self._high).any():
            margin = self.config.grid.margin
            self._low, self._high = np.minimum(self._low, low - margin), np.maximum(self._high, high + margin)

    @property
    def _bound(self) -> Bound:
        scale = self._settings.scale
        return Bound(wp.vec3(*(scale * self._low)), wp.vec3(*(scale * self._high)))

    def _scaled(self, vector: np.ndarray, scale: float | None = None) -> np.ndarray:
        """A pose vector with its translation in other units, network units by default."""
        return np.concatenate([vector[:4], vector[4:] * (self._settings.scale if scale is None else scale)])

    def _view(self, seen: SeenDepth) -> ObservedView:
        return seen.view(self.intrinsics, self.history.pose(seen.index))

    # -- what came out -------------------------------------------------------------------------------------------

    @property
    def map_bytes(self) -> int:
        """Memory of the network's weights."""
        return 4 * weight_count("imap")

    @property
    def flops_per_point(self) -> int:
        """Operations of the network at a point, forward (see `warpslam.field.complexity`)."""
        return flops_per_point("imap")

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner of the mapped region, float64 (3,) each [m]."""
        return self._low, self._high

    def query_occupancy(self, points: np.ndarray, level: str = "fine") -> np.ndarray:
        """Density before the ReLU, float32 (N,), at world points (N, 3) [m]; there is one level."""
        return self._query(points, lambda batch: batch.density)

    def query_color(self, points: np.ndarray) -> np.ndarray:
        """Colours in [0, 1], float32 (N, 3), at world points (N, 3) [m]."""
        return np.clip(self._query(points, lambda batch: batch.color), 0.0, 1.0)

    def _query(self, points: np.ndarray, wanted: Callable[[ImapBatch], wp.array]) -> np.ndarray:
        if self._queries is None:
            self._queries = ImapBatch(_VIEW_POINTS, 1, 0, 0, self._launcher, training=False)
        batch = self._queries
        scaled = np.asarray(points, np.float32) * np.float32(self._settings.scale)
        parts = []
        for start in range(0, len(scaled), _VIEW_POINTS):
            batch.query_points(self.network, scaled[start : start + _VIEW_POINTS])
            parts.append(wanted(batch).numpy()[: batch.count].copy())
        return np.concatenate(parts) if parts else wanted(batch).numpy()[:0]

    def _mesh(self, voxel: float | None) -> trimesh.Trimesh:
        config = self.config.meshing
        return extract_mesh(
            self,
            [self._view(seen) for seen in self._seen],
            voxel=voxel or config.voxel,
            level_set=self._settings.level_set,
            min_component_area=config.min_component_area,
        )

    def render(self, T_world_camera: np.ndarray, *, depth: np.ndarray | None = None, stride: int = 1) -> RenderedImage:
        """View of the map from a pose, every ``stride``-th pixel; a ``depth`` image [m] guides the samples if given.

        Raises:
            InputError: The map is empty, or the pose is no rigid transform.
        """
        if not self._seen:
            raise InputError("the map is empty: step at least one frame first")
        scale, camera = self._settings.scale, self.intrinsics
        vector = self._scaled(vector_from_pose(check_transform(T_world_camera)))
        pose = wp.array(vector[None].astype(np.float32), dtype=float, device=self.device)
        width, height = -(-camera.width // stride), -(-camera.height // stride)
        rows = max(1, _VIEW_POINTS // ((_VIEW_STRATIFIED + _VIEW_IMPORTANCE) * width))
        batch = ImapBatch(rows * width, _VIEW_STRATIFIED, _VIEW_IMPORTANCE, 0, Launcher(self.device), training=False)
        out = RenderedImage(*(np.zeros((height, width, *c), np.float32) for c in ((), (3,), ())))
        guided, bound = depth is not None, self._bound
        for first in range(0, height, rows):
            count = min(rows, height - first)
            batch.set_pixels(first, count, camera, stride)
            batch.cast(pose)
            if depth is not None:
                part = np.ascontiguousarray(depth[::stride, ::stride][first : first + count], np.float32)
                batch.measured_depth[: batch.count].assign(scale * part.reshape(-1))
            batch.bound_to(bound.low, bound.high, use_depth=guided)
            batch.evaluate(self.network, bound, use_depth=guided)
            arrays = ((out.depth, batch.depth, 1 / scale), (out.rgb, batch.rgb, 1.0))
            for image, array, unit in (*arrays, (out.variance, batch.variance, 1 / scale**2)):
                values = array.numpy()[: batch.count].reshape(count, width, *image.shape[2:])
                image[first : first + count] = np.float32(unit) * values
        np.clip(out.rgb, 0.0, 1.0, out=out.rgb)
        return out

    def _state(self) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        seen = [seen.millimetres for seen in self._seen]
        camera = self.intrinsics.strided(SEEN_STRIDE)
        arrays = {
            # Until something is seen there is no bound.
            "bounds": np.stack([self._low, self._high])[: 2 * bool(seen)],
            "seen": np.array(seen, np.uint16).reshape(-1, camera.height, camera.width),
        }
        arrays |= {f"network:{name}": array for name, array in self.network.tensors().items()}
        return {"seen": [seen.index for seen in self._seen]}, arrays

    def _restore(self, state: StateFields) -> None:
        camera = self.intrinsics.strided(SEEN_STRIDE)
        frames = state.frames("seen", len(self.history))
        depths = state.array("seen", np.uint16, (len(frames), camera.height, camera.width))
        self._seen = [SeenDepth(index, millimetres) for index, millimetres in zip(frames, depths, strict=True)]
        if frames:
            self._low, self._high = state.array("bounds", np.float64, (2, 3)).copy()
        shapes = imap_shapes().items()
        tensors = {name: state.array(f"network:{name}", np.float32, shape) for name, shape in shapes}
        self.network = ImapNetwork(tensors, self._launcher)


def _compile(device: wp.Device) -> float:
    """Load the kernel modules that this method needs, and none of NICE-SLAM's decoders; the seconds it took."""
    start = time.perf_counter()
    names = [module.__name__ for module in (adam, density, losses)]
    for name in [*names, pixels.MODULE, f"warpslam.imap_{'cuda' if device.is_cuda else 'cpu'}"]:
        wp.get_module(name).load(device)
    return time.perf_counter() - start
