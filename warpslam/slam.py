"""Dense RGB-D SLAM, frame by frame (NICE-SLAM, CVPR 2022, Sec. 3): track, decide, map, keyframe."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warpslam.camera import Intrinsics, check_number, check_transform, pose_from_vector, vector_from_pose
from warpslam.config import Config
from warpslam.decoders import Decoders, load_decoders
from warpslam.errors import ConfigError, FrameError, InputError
from warpslam.images import read_images
from warpslam.keyframes import SEEN_STRIDE, ImagePool, Keyframe, SeenDepth
from warpslam.launching import compile_kernels, synchronize
from warpslam.mapper import Mapper
from warpslam.meshing import ObservedView, extract_mesh
from warpslam.rendering import RenderedImage, render_image
from warpslam.scene import SceneMap
from warpslam.tracker import Tracker, TrackingResult
from warpslam.trajectory import Trajectory

if TYPE_CHECKING:
    import trimesh


@dataclass(frozen=True)
class FrameResult:
    """What `Slam.step` returns.

    index: Frame number from 0. timestamp: [s].
    T_world_camera: Estimated pose, float64 (4, 4).
    status: "OK"; "LOST" (tracking failed, pose unreliable, map untouched); "SKIPPED" (nothing usable in the frame).
    losses: Mean loss per ray: "tracking", and of the mapping stages that ran.
    inliers: Share of the depth rays that agree with the map, in [0, 1].
    depth_error: Mean |measured - rendered depth| of the inliers [m].
    timings: Seconds by phase: "tracking", "mapping", "keyframe".
    message: Why the frame is not OK.
    """

    index: int
    timestamp: float
    T_world_camera: np.ndarray
    status: str = "OK"
    losses: dict[str, float] = field(default_factory=dict)
    inliers: float = 1.0
    depth_error: float = 0.0
    timings: dict[str, float] = field(default_factory=dict)
    message: str = ""


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
        seed: Of the initial features and of every random choice. Same input, seed and device: same result.
        decoders: Decoder weights; by default those of `Config.decoders`, and failing that the package's own.
    """

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
        self.config = config if config is not None else Config()
        _check_settings(intrinsics, self.config)
        self.device = wp.get_device(device)
        self.seed = seed
        self.compile_seconds = compile_kernels(self.device)
        self.scene = SceneMap(decoders or load_decoders(self.config.decoders), self.config.grid, self.device, seed)
        self.keyframes: list[Keyframe] = []
        self._images = ImagePool(intrinsics, self.device)
        self._tracker = Tracker(intrinsics, self.config.tracking, self.config.sampling, self.device, seed)
        self._mapper = Mapper(self.scene, intrinsics, self.config.mapping, self.config.sampling, self.device, seed)
        self._vectors: list[np.ndarray] = []
        self._timestamps: list[float] = []
        self._status: list[str] = []
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
            T_world_camera: Known pose (4, 4): used for the first frame (identity by default), and for every frame with
                `TrackingConfig.use_given_poses`. One that is not finite counts as unknown.
            depth_scale: Units per metre of integer depth, for example 1000 or 5000.

        A bad frame raises nothing: arrays of another size or type, too few pixels with depth, a black or over-exposed
        image, a time that is not finite, or a pose that is not finite where one is needed give the status SKIPPED and
        a message, and leave the map as it was.

        Raises:
            InputError: misuse, which no other frame would mend: an argument that is no array, integer depth without
                ``depth_scale``, a T_world_camera that is no rigid transform, or none where one is needed.
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

        self._images.set(0, rgb, depth)
        self._current = index
        timings: dict[str, float] = {}
        losses: dict[str, float] = {}
        status, message, inliers, depth_error = "OK", "", 1.0, 0.0
        first = self.scene.is_empty
        if first or self.config.tracking.use_given_poses:
            pose = np.eye(4) if given is None else given
        else:
            with _timed(timings, "tracking", self.device):
                tracked = self._track(index)
            pose, inliers, depth_error = tracked.T_world_camera, tracked.inliers, tracked.depth_error
            losses["tracking"] = tracked.loss
            message = self._why_lost(tracked)
            status = "LOST" if message else "OK"
        self._append(vector_from_pose(pose), timestamp, status)

        if status == "OK":
            keyframe = self._is_keyframe(index)
            if first or index % self.config.mapping.every == 0:
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
        timings: dict[str, float] = {}
        index = self._current
        if index is None or self._status[index] != "OK":
            return timings
        if self._mapped != index:
            with _timed(timings, "mapping", self.device):
                self._map(index, self._images.depth_image(0), first=False)
        if self.config.mapping.color_refinement and self.keyframes:
            with _timed(timings, "refinement", self.device):
                result = self._mapper.refine(self._images, index, self._vectors[index], self.keyframes)
                self._write_back(index, result.vector)
        return timings

    def _track(self, index: int) -> TrackingResult:
        arrays = self.scene.arrays()
        starts = self._initial_poses()
        result = self._tracker.track(arrays, self._images, index, starts[0])
        if self._why_lost(result):
            # Harder, and from the last pose as well: the constant-speed guess may be what failed.
            effort = self.config.tracking.recovery_factor
            tries = [self._tracker.track(arrays, self._images, index, start, effort=effort) for start in starts]
            result = min(
                [result, *tries], key=lambda r: (bool(self._why_lost(r)), r.depth_error / max(r.inliers, 1e-3))
            )
        return result

    def _initial_poses(self) -> list[np.ndarray]:
        """Where to start from: constant speed (if on and known), and the last pose."""
        last = pose_from_vector(self._vectors[-1])
        starts = [last]
        recent = self._status[-2:]
        if self.config.tracking.constant_speed and recent == ["OK", "OK"]:
            before = pose_from_vector(self._vectors[-2])
            starts.insert(0, last @ np.linalg.inv(before) @ last)
        return starts

    def _why_lost(self, tracked: TrackingResult) -> str:
        config = self.config.tracking
        if tracked.inliers < config.lost_inliers:
            return f"only {tracked.inliers:.0%} of the depth rays agree with the map"
        if not tracked.depth_error <= config.lost_depth_error:
            return f"mean depth error {tracked.depth_error:.2f} m"
        return ""

    def _is_keyframe(self, index: int) -> bool:
        config = self.config.keyframes
        if not self.keyframes:
            return True
        if config.policy == "interval":
            return index - self.keyframes[-1].index >= config.every
        return self._tracker.explained_share(config.known_error) < config.known_share

    def _map(self, index: int, depth: np.ndarray, first: bool) -> dict[str, float]:
        vector = self._vectors[index]
        self.scene.cover(*self._extent(depth, pose_from_vector(vector)))
        if first:
            result = self._mapper.map_first(self._images, index, vector)
        else:
            result = self._mapper.map_frame(self._images, index, vector, self.keyframes)
        self._mapped = index
        self._seen.append(SeenDepth.of(index, depth))
        if result.adjusted:
            self._write_back(index, result.vector)
        return result.losses

    def _write_back(self, index: int, vector: np.ndarray) -> None:
        """Bundle adjustment's poses into the trajectory: the current frame and every keyframe."""
        self._vectors[index] = vector
        for keyframe in self.keyframes:
            self._vectors[keyframe.index] = keyframe.pose.copy()

    def _extent(self, depth: np.ndarray, T_world_camera: np.ndarray, stride: int = 4) -> tuple[np.ndarray, np.ndarray]:
        """Box of the camera and of everything it measures [m]."""
        v, u = np.nonzero(depth[::stride, ::stride])
        d = depth[::stride, ::stride][v, u].astype(np.float64)
        camera = self.intrinsics
        rays = np.stack(
            [(u * stride - camera.cx) / camera.fx, (v * stride - camera.cy) / camera.fy, np.ones(len(u))], 1
        )
        points = (rays * d[:, None]) @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
        points = np.concatenate([points, T_world_camera[None, :3, 3]])
        return points.min(axis=0), points.max(axis=0)

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

    def mesh(self, voxel: float | None = None) -> trimesh.Trimesh:
        """Coloured mesh of what the mapped frames saw (A.4), in the world frame.

        Args:
            voxel: Edge of a marching-cubes cell [m]; `MeshingConfig.voxel` by default.

        Raises:
            MeshError: nothing was seen, or there is no surface.
        """
        config = self.config.meshing
        camera = self.intrinsics.strided(SEEN_STRIDE)
        return extract_mesh(
            self.scene,
            [ObservedView(seen.depth(), camera, pose_from_vector(self._vectors[seen.index])) for seen in self._seen],
            voxel=voxel or config.voxel,
            level_set=config.level_set,
            min_component_area=config.min_component_area,
        )

    def save(self, path: str | Path) -> None:
        """Write map, keyframes, trajectory and settings to one .npz file (no pickled code)."""
        from warpslam.checkpoint import save_slam

        save_slam(self, Path(path))

    @classmethod
    def load(cls, path: str | Path, device: str | None = None) -> Slam:
        """Read what `save` wrote; the result goes on from the last frame.

        Raises:
            CheckpointError: the file is missing, damaged, or of another version.
        """
        from warpslam.checkpoint import load_slam

        return load_slam(Path(path), device)

    # -- frames in -----------------------------------------------------------------------------------------------

    def _append(self, vector: np.ndarray, timestamp: float, status: str) -> None:
        self._vectors.append(vector)
        self._timestamps.append(timestamp)
        self._status.append(status)

    def _skip(self, index: int, timestamp: float, message: str) -> FrameResult:
        vector = self._vectors[-1].copy() if self._vectors else vector_from_pose(np.eye(4))
        if not math.isfinite(timestamp):
            timestamp = self._timestamps[-1] if self._timestamps else 0.0
        self._append(vector, timestamp, "SKIPPED")
        return FrameResult(index, timestamp, pose_from_vector(vector), "SKIPPED", inliers=0.0, message=message)

    def _read_images(self, rgb: Any, depth: Any, depth_scale: float | None) -> tuple[np.ndarray, np.ndarray]:
        config = self.config
        is_colored = config.tracking.color_weight > 0 or config.mapping.color_weight > 0
        return read_images(
            rgb, depth, self.intrinsics, config.grid.max_depth, depth_scale, colored=is_colored
        )

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
    """Adds the wall-clock seconds of a block to ``timings[name]``."""

    def __init__(self, timings: dict[str, float], name: str, device: wp.Device) -> None:
        self.timings, self.name, self.device = timings, name, device

    def __enter__(self) -> None:
        self.start = time.perf_counter()

    def __exit__(self, *_: object) -> None:
        synchronize(self.device)
        self.timings[self.name] = self.timings.get(self.name, 0.0) + time.perf_counter() - self.start


def _check_settings(camera: Intrinsics, config: Config) -> None:
    tracking = config.tracking
    if camera.width <= 2 * tracking.ignore_edge_u or camera.height <= 2 * tracking.ignore_edge_v:
        raise InputError(
            f"tracking.ignore_edge_u = {tracking.ignore_edge_u} and ignore_edge_v = {tracking.ignore_edge_v} "
            f"leave nothing of a {camera.width} x {camera.height} image: lower them"
        )
    if tracking.use_given_poses and config.keyframes.policy == "information_gain":
        raise ConfigError("keyframes.policy = information_gain needs tracking; use interval with given poses")
