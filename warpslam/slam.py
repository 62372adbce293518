"""Dense RGB-D SLAM, frame by frame (NICE-SLAM, CVPR 2022, Sec. 3): track, decide, map, keyframe."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import warp as wp

from warpslam.camera import Intrinsics, check_number
from warpslam.config import Config
from warpslam.errors import ConfigError, FrameError, InputError
from warpslam.field.complexity import field_flops, weight_count
from warpslam.field.decoder_files import load_decoders
from warpslam.field.decoders import Decoders
from warpslam.field.rendering import RenderedImage, render_image
from warpslam.frames import FrameResult, read_images
from warpslam.mapping.frustum import measured_extent
from warpslam.mapping.mapper import Mapper
from warpslam.mapping.scheduler import MappingTask, new_scheduler
from warpslam.meshing import ObservedView, extract_mesh
from warpslam.poses import check_transform, pose_from_vector, vector_from_pose
from warpslam.runtime.compilation import compile_kernels
from warpslam.runtime.launching import synchronize
from warpslam.runtime.phases import phase
from warpslam.scene.image_pool import ImagePool, check_window_fits
from warpslam.scene.keyframes import Keyframe
from warpslam.scene.mapped_views import SEEN_STRIDE, SeenDepth
from warpslam.scene.scene_map import SceneMap
from warpslam.tracking.localizer import Localizer
from warpslam.tracking.tracker import Tracker
from warpslam.trajectory import Track, Trajectory

if TYPE_CHECKING:
    import trimesh


class Slam:
    """A camera that moves through a scene, and the map it makes.

        slam = Slam(Intrinsics(fx, fy, cx, cy, width, height))
        for rgb, depth in frames:
            result = slam.step(rgb, depth)
        slam.finish()
        slam.mesh().export("mesh.ply")

    Args:
        intrinsics: Camera of all frames.
        config: Settings, `Config()` by default.
        device: Warp device, "cpu" or "cuda:0"; by default CUDA where there is one.
        seed: Of the initial features and of every random choice. Same input, seed and device: same result (with the
            strict schedule).
        decoders: Decoder weights; by default those of `Config.decoders`, and failing that the package's own.
    """

    has_checkpoints: ClassVar[bool] = True

    def __init__(
        self,
        intrinsics: Intrinsics,
        config: Config | None = None,
        device: str | None = None,
        seed: int = 0,
        *,
        decoders: Decoders | None = None,
    ) -> None:
        self.intrinsics = intrinsics
        self.config = (config if config is not None else Config()).resolved()
        _check_settings(intrinsics, self.config)
        check_window_fits(intrinsics, self.config.keyframes.max_gigabytes, self.config.mapping.window)
        self.device = wp.get_device(device)
        self.seed = seed
        start = time.perf_counter()
        compile_kernels(self.device)
        self.compile_seconds = time.perf_counter() - start
        self.scene = SceneMap(decoders or load_decoders(self.config.decoders), self.config.grid, self.device, seed)
        self.keyframes: list[Keyframe] = []
        self._images = ImagePool(intrinsics, self.device, self.config.keyframes.max_gigabytes)
        self._tracker = Tracker(intrinsics, self.config.tracking, self.config.sampling, self.device, seed)
        self._localizer = Localizer(self._tracker, self.config.tracking, intrinsics)
        self._mapper = Mapper(self.scene, intrinsics, self.config.mapping, self.config.sampling, self.device, seed)
        self._scheduler = new_scheduler(self.config.schedule, self._mapper, self._images)
        self._vectors: list[np.ndarray] = []
        self._timestamps: list[float] = []
        self._status: list[str] = []
        self._depth_errors: list[float] = []
        self._motion = np.eye(4)
        self._first = 0
        self._seen: list[SeenDepth] = []
        self._current: int | None = None
        self._mapped: int | None = None

    # -- the algorithm -------------------------------------------------------------------------------------------

    def step(
        self,
        rgb: Any,
        depth: Any,
        timestamp: float | None = None,
        T_world_camera: np.ndarray | None = None,
        *,
        depth_scale: float | None = None,
    ) -> FrameResult:
        """Take in one frame.

        Args:
            rgb: Colour (H, W, 3): uint8, or float in [0, 1]. NumPy, torch or Warp array.
            depth: z-depth (H, W): float in metres, or uint16 with ``depth_scale``. 0, NaN, infinite or negative =
            missing.
            timestamp: Time [s]; frame number / 30 by default.
            T_world_camera: Known pose (4, 4): used for the first frame (identity by default), for the first after
                `forget_pose`, and for every frame with `TrackingConfig.use_given_poses`. One that is not finite counts
                as unknown.
            depth_scale: Units per metre of integer depth, for example 1000 or 5000.

        A bad frame raises nothing: arrays of another size or type, too few pixels with depth, a black or over-exposed
        image, a time that is not finite, or a pose that is not finite where one is needed give the status SKIPPED and
        a message, and leave the map as it was.

        Raises:
            InputError: misuse, which no other frame would mend: an argument that is no array, integer depth without
                ``depth_scale``, a T_world_camera that is no rigid transform, or none where one is needed.
            MapSizeError: the map would outgrow the memory set for it.
        """
        index = len(self._vectors)
        timestamp = index / 30.0 if timestamp is None else check_number(timestamp, "timestamp")
        given = None if T_world_camera is None else check_transform(T_world_camera, unknown_is_nan=True)
        if self.config.tracking.use_given_poses and given is None:
            raise InputError(f"frame {index}: tracking.use_given_poses is on, but step() got no T_world_camera")
        try:
            rgb, depth = self._read_images(rgb, depth, depth_scale)
            given = self._check_frame(timestamp, given)
        except FrameError as error:
            return self._skip(index, timestamp, str(error))

        timings: dict[str, float] = {}
        losses: dict[str, float] = {}
        is_due = index % self.config.mapping.every == 0
        # A frame that is to be mapped is tracked against all that was mapped before it.
        if self._scheduler.has_finished or (is_due and self._scheduler.is_busy):
            with _timed(timings, "mapping", self.device):
                losses.update(self._take_over(wait=True))
        self._images.set(0, rgb, depth)
        self._current = index
        status, message, inliers, depth_error = "OK", "", 1.0, 0.0
        first = self.scene.is_empty
        if first and not self.config.mapping.enabled:
            raise InputError("the map is empty and mapping.enabled is off: load a map with Slam.load")
        track = Track(self._vectors, self._status, self._depth_errors, self._motion, self._first)
        if first or self.config.tracking.use_given_poses or (track.last is None and given is not None):
            pose = np.eye(4) if given is None else given
        else:
            with _timed(timings, "tracking", self.device):
                located = self._localizer.locate(self.scene.arrays(), self._images, index, track, self.keyframes)
            tracked, message = located.tracked, located.why_lost
            inliers, depth_error, losses["tracking"] = tracked.inliers, tracked.depth_error, tracked.loss
            status = "LOST" if message else "OK"
            pose = self._last_pose() if message else tracked.T_world_camera
            if located.after_loss:
                self._first = index
        if status == "OK" and self._vectors:
            self._motion = np.linalg.inv(self._last_pose()) @ pose
        self._append(vector_from_pose(pose), timestamp, status, depth_error if status == "OK" else 0.0)

        if status == "OK" and self.config.mapping.enabled:
            keyframe = self._is_keyframe(index)
            if first or is_due:
                with _timed(timings, "mapping", self.device):
                    losses.update(self._map(index, depth, first))
            if keyframe:
                with _timed(timings, "keyframe", self.device):
                    self.keyframes.append(Keyframe(index, self._images.add(rgb, depth), self._vectors[index].copy()))
        T = pose_from_vector(self._vectors[index])
        return FrameResult(index, timestamp, T, status, losses, inliers, depth_error, timings, message)

    def finish(self) -> dict[str, float]:
        """After the last frame: map it if it was not, then refine the whole map (Sec. 3.1). Returns the seconds by
        phase.
        """
        self.wait()
        timings: dict[str, float] = {}
        index = self._current
        if index is None or self._status[index] != "OK" or not self.config.mapping.enabled:
            return timings
        if self._mapped != index:
            with _timed(timings, "mapping", self.device):
                self._map(index, self._images.depth_image(0), first=False)
                self.wait()
        if self.config.mapping.color_refinement and self.keyframes:
            with _timed(timings, "refinement", self.device):
                self._refine(index, 0, self.config.mapping.refinement_rounds)
        return timings

    def refine(self, rounds: int | None = None) -> None:
        """More rounds of the global refinement that `finish` ends with (Sec. 3.1), on a map that is done.

        Args:
            rounds: `MappingConfig.refinement_rounds` by default. Their random draws are not those of `finish`.

        Raises:
            InputError: there is no keyframe, or the last frame was not OK, so there is no window to refine.
        """
        self.wait()
        config, index = self.config.mapping, self._current
        if index is None or self._status[index] != "OK" or not self.keyframes:
            raise InputError("the map can't be refined: it has no keyframe, or its last frame was not OK")
        done = config.refinement_rounds if config.color_refinement else 0
        self._refine(index, done, config.refinement_rounds if rounds is None else rounds)

    def _refine(self, index: int, first_round: int, rounds: int) -> None:
        which = range(first_round, first_round + rounds)
        task = MappingTask("refinement", index, self._vectors[index], rounds=which)
        self._scheduler.start(task, self.keyframes)
        self.wait()

    def wait(self) -> None:
        """Until every frame that was to be mapped is in the map (at once, unless `Config.schedule` is overlapped)."""
        self._take_over(wait=True)

    def forget_pose(self) -> None:
        """The camera may be anywhere now: the next frame takes the pose that comes with it, or is looked for at the
        keyframes.
        """
        self._first = len(self._vectors)

    def _is_keyframe(self, index: int) -> bool:
        config = self.config.keyframes
        if not self.keyframes:
            return True
        if config.policy == "interval":
            return index - self.keyframes[-1].index >= config.every
        return self._tracker.explained_share(config.known_error) < config.known_share

    def _map(self, index: int, depth: np.ndarray, first: bool) -> dict[str, float]:
        """Have a frame mapped; returns the losses if it is done by now."""
        vector = self._vectors[index]
        extent = measured_extent(depth, pose_from_vector(vector), self.intrinsics)
        self._scheduler.start(MappingTask("first" if first else "frame", index, vector, extent), self.keyframes)
        self._seen.append(SeenDepth.of(index, depth))
        return self._take_over(wait=first)

    def _take_over(self, *, wait: bool = False) -> dict[str, float]:
        """What the mapper has finished since: the map, the poses it refined, and its losses, which are returned."""
        finished = self._scheduler.finished(wait=wait)
        if finished is None:
            return {}
        frame, result = finished
        self._mapped = frame
        if result.adjusted:
            self._write_back(frame, result.vector)
        return result.losses

    def _write_back(self, index: int, vector: np.ndarray) -> None:
        """Bundle adjustment's poses into the trajectory: the current frame and every keyframe."""
        self._vectors[index] = vector
        for keyframe in self.keyframes:
            self._vectors[keyframe.index] = keyframe.pose.copy()

    # -- what came out -------------------------------------------------------------------------------------------

    @property
    def trajectory(self) -> Trajectory:
        """All poses so far; keyframes and mapped frames with the corrections of bundle adjustment."""
        poses = np.array([pose_from_vector(vector) for vector in self._vectors]).reshape(-1, 4, 4)
        return Trajectory(np.array(self._timestamps), poses, list(self._status))

    def render(self, T_world_camera: np.ndarray, *, depth: np.ndarray | None = None, stride: int = 1) -> RenderedImage:
        """View of the map from a pose, every ``stride``-th pixel; a ``depth`` image [m] guides the samples if given.

        Raises:
            InputError: the map is empty, or the pose is no rigid transform.
        """
        if self.scene.is_empty:
            raise InputError("the map is empty: step at least one frame first")
        T = check_transform(T_world_camera)
        arrays = self.scene.arrays()
        return render_image(arrays, self.intrinsics, T, self.config.sampling, self.device, depth=depth, stride=stride)

    def mesh(self, voxel: float | None = None, *, forecast: bool = False) -> trimesh.Trimesh:
        """Coloured mesh of what the mapped frames saw (A.4), in the world frame.

        Args:
            voxel: Edge of a marching-cubes cell [m]; `MeshingConfig.voxel` by default.
            forecast: Add what the coarse level suggests where nothing was seen, in cyan.

        Raises:
            MeshError: nothing was seen, or there is no surface.
        """
        self.wait()
        config = self.config.meshing
        camera = self.intrinsics.strided(SEEN_STRIDE)
        return extract_mesh(
            self.scene,
            [ObservedView(seen.depth(), camera, pose_from_vector(self._vectors[seen.index])) for seen in self._seen],
            voxel=voxel or config.voxel,
            level_set=config.level_set,
            min_component_area=config.min_component_area,
            forecast=forecast,
            device=str(self.device),
        )

    @property
    def map_bytes(self) -> int:
        """Memory of the grids' features and of the decoders, without optimiser state and images [bytes]."""
        rows = sum(grid.row_count for grid in self.scene.grids.values())
        weights = sum(weight_count(decoder.level, decoder.hidden) for decoder in self.scene.decoder_weights)
        return 4 * (32 * rows + weights)

    @property
    def flops_per_point(self) -> int:
        """Operations of the field at a point, forward (see `warpslam.field.complexity`)."""
        return field_flops({decoder.level: decoder.hidden for decoder in self.scene.decoder_weights})["field"]

    def memory(self) -> dict[str, float | None]:
        """Bytes of the map's state, in all and per observed cubic metre; see `scene.inventory.memory_report`."""
        from warpslam.scene.inventory import memory_report

        return memory_report(self)

    def inventory(self) -> dict[str, Any]:
        """What the map holds, under the names of metrics.json; see `scene.inventory.take_inventory`."""
        from warpslam.scene.inventory import take_inventory

        return {**take_inventory(self), "memory": self.memory()}

    def save(self, path: str | Path) -> None:
        """Write map, keyframes, trajectory and settings to one file (plain arrays, no code)."""
        from warpslam.slam_state import save_slam

        save_slam(self, Path(path))

    @classmethod
    def load(
        cls,
        path: str | Path,
        device: str | None = None,
        *,
        config: Config | None = None,
        localize_only: bool = False,
    ) -> Slam:
        """Read what `save` wrote; the result goes on from the last frame.

        Args:
            path: File.
            device: As in `Slam`.
            config: Settings from now on, those saved by default; the grids' spacings are the map's.
            localize_only: The map stays as it is, and the camera may be anywhere in it: `mapping.enabled` is off, and
                `forget_pose` was called.

        Raises:
            CheckpointError: the file is missing, damaged, or of another version.
            ConfigError: ``config`` does not fit the map.
        """
        from warpslam.slam_state import load_slam

        return load_slam(Path(path), device, config=config, localize_only=localize_only)

    # -- frames in -----------------------------------------------------------------------------------------------

    def _append(self, vector: np.ndarray, timestamp: float, status: str, depth_error: float = 0.0) -> None:
        self._vectors.append(vector)
        self._timestamps.append(timestamp)
        self._status.append(status)
        self._depth_errors.append(depth_error)

    def _last_pose(self) -> np.ndarray:
        return pose_from_vector(self._vectors[-1]) if self._vectors else np.eye(4)

    def _skip(self, index: int, timestamp: float, message: str) -> FrameResult:
        pose = self._last_pose()
        if not math.isfinite(timestamp):
            timestamp = self._timestamps[-1] if self._timestamps else 0.0
        self._append(vector_from_pose(pose), timestamp, "SKIPPED")
        return FrameResult(index, timestamp, pose, "SKIPPED", inliers=0.0, message=message)

    def _read_images(self, rgb: Any, depth: Any, depth_scale: float | None) -> tuple[np.ndarray, np.ndarray]:
        config = self.config
        is_colored = config.tracking.color_weight > 0 or config.mapping.color_weight > 0
        return read_images(rgb, depth, self.intrinsics, config.grid.max_depth, depth_scale, colored=is_colored)

    def _check_frame(self, timestamp: float, given: np.ndarray | None) -> np.ndarray | None:
        """The given pose if it is known; `FrameError` if it is needed and not known, or the time is no time."""
        if not math.isfinite(timestamp):
            raise FrameError(f"its timestamp is {timestamp}")
        if given is None or np.isfinite(given).all():
            return given
        if self.config.tracking.use_given_poses:
            raise FrameError("its T_world_camera holds NaN or infinity, and tracking.use_given_poses is on")
        return None


class _timed:
    """Adds the wall-clock seconds of a block to ``timings[name]``; the block is a phase for the profiler."""

    def __init__(self, timings: dict[str, float], name: str, device: wp.Device) -> None:
        self.timings, self.name, self.device = timings, name, device
        self.phase = phase(name)

    def __enter__(self) -> None:
        self.phase.__enter__()
        self.start = time.perf_counter()

    def __exit__(self, *_: object) -> None:
        synchronize(self.device)
        self.timings[self.name] = self.timings.get(self.name, 0.0) + time.perf_counter() - self.start
        self.phase.__exit__()


def _check_settings(camera: Intrinsics, config: Config) -> None:
    tracking = config.tracking
    if camera.width <= 2 * tracking.ignore_edge_u or camera.height <= 2 * tracking.ignore_edge_v:
        raise InputError(
            f"tracking.ignore_edge_u = {tracking.ignore_edge_u} and ignore_edge_v = {tracking.ignore_edge_v} "
            f"leave nothing of a {camera.width} x {camera.height} image: lower them"
        )
    if tracking.use_given_poses and config.keyframes.policy == "information_gain":
        raise ConfigError("keyframes.policy = information_gain needs tracking; use interval with given poses")
