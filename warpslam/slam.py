"""Dense RGB-D SLAM, frame by frame (NICE-SLAM, CVPR 2022, Sec. 3): admit, track, decide, map, keyframe."""

from __future__ import annotations

import time
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import warp as wp

from warpslam.camera import ONE_MOMENT, FrameMotion, Intrinsics, SensorTiming
from warpslam.config import Config
from warpslam.errors import InputError, MapSizeError
from warpslam.field.complexity import field_flops, weight_count
from warpslam.field.decoder_files import load_decoders
from warpslam.field.decoders import Decoders
from warpslam.field.rendering import RenderedImage, render_image
from warpslam.frames import AdmittedFrame, FrameResult, FrameStatus, admit, check_settings, skipped
from warpslam.loops.closer import LoopCloser
from warpslam.mapping.frustum import measured_extent
from warpslam.mapping.policy import images_at_a_time, new_mapper
from warpslam.mapping.scheduler import MappingTask, new_scheduler
from warpslam.meshing import extract_mesh
from warpslam.poses import MAX_DISTANCE, check_transform, is_near
from warpslam.runtime.compilation import compile_kernels
from warpslam.runtime.environment import named_device
from warpslam.runtime.exclusive import exclusive
from warpslam.runtime.launching import synchronize
from warpslam.runtime.phases import phase
from warpslam.scene.image_pool import ImagePool, check_images_fit
from warpslam.scene.inventory import take_inventory
from warpslam.scene.keyframes import Keyframe
from warpslam.scene.mapped_views import ObservedView, SeenDepth
from warpslam.scene.scene_map import SceneMap
from warpslam.slam_state import SlamState, read_slam, write_slam
from warpslam.tracking.direct.timing import TimingEstimator, twist_between
from warpslam.tracking.direct.tracker import DirectTracker
from warpslam.tracking.localizer import Localizer
from warpslam.tracking.tracker import Tracker
from warpslam.trajectory import TWIST_STEPS, FrameHistory, Located, Trajectory

if TYPE_CHECKING:
    import trimesh

PART_GAP = 1.0
"""Between a map and a part that is mapped beside it [m]."""


class Slam:
    """A camera that moves through a scene, and the map it makes.

        slam = Slam(Intrinsics(fx, fy, cx, cy, width, height))
        for rgb, depth in frames:
            result = slam.step(rgb, depth)
        slam.finish()
        slam.mesh().export("mesh.ply")

    Its parts: ``scene`` (the map), ``history`` (what became of every frame), ``keyframes``, ``images`` (theirs, and the
    current frame's), ``direct`` (or ``tracker`` and ``localizer``), ``mapper`` and ``scheduler``.

    Several threads may use one object: each call waits for the one before. A forked process may go on with it where it
    is on the CPU with the strict schedule; else it gets an `InputError`.

    Args:
        intrinsics: Camera of all frames.
        config: Settings, `Config()` by default.
        device: Warp device, "cpu" or "cuda:0"; by default CUDA where there is one.
        seed: Of the initial features and of every random choice. Same input and seed: same result on the CPU, however
            many cores it has (with the strict schedule).
        decoders: Decoder weights; by default those of `Config.decoders`, and failing that the package's own.
        timing: When the camera's pixels are taken; `Config.sensor_timing` off = all at once. Where none is known it is
            estimated from frames whose depth has stamps of its own (`DirectConfig.timing`), and is then that.
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
        timing: SensorTiming = ONE_MOMENT,
    ) -> None:
        self.intrinsics = intrinsics
        self.config = (config if config is not None else Config()).resolved()
        check_settings(intrinsics, self.config)
        check_images_fit(intrinsics, self.config.keyframes.max_gigabytes, images_at_a_time(self.config.mapping))
        self.timing = timing
        self.device = named_device(device)
        self.seed = seed
        start = time.perf_counter()
        compile_kernels(self.device, layouts=[self.config.grid.layout])
        self.compile_seconds = time.perf_counter() - start
        self.scene = SceneMap(decoders or load_decoders(self.config.decoders), self.config.grid, self.device, seed)
        self.history = FrameHistory()
        self.keyframes: list[Keyframe] = []
        self.images = ImagePool(intrinsics, self.device, self.config.keyframes.max_gigabytes)
        self.tracker = Tracker(intrinsics, self.config.tracking, self.config.sampling, self.device, seed)
        self.localizer = Localizer(self.tracker, self.config.tracking, intrinsics)
        self.mapper = new_mapper(self.scene, intrinsics, self.config, self.device, seed)
        self.direct = self._direct_tracker()
        self.loops = self._loop_closer()
        self.timing_estimator = self._timing_estimator()
        self.scheduler = new_scheduler(self.config.schedule, self.mapper, self.images)
        self._seen: list[SeenDepth] = []
        self.lock = self.scene.lock
        self.lock.outlives_fork &= self.config.schedule == "strict"
        self._digest: int | None = None
        self._current: int | None = None
        self._mapped: int | None = None

    # -- the algorithm -------------------------------------------------------------------------------------------

    @exclusive
    def step(
        self,
        rgb: Any,
        depth: Any,
        timestamp: float | None = None,
        T_world_camera: np.ndarray | None = None,
        *,
        depth_scale: float | None = None,
        depth_timestamp: float | None = None,
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
            depth_timestamp: Time of the depth image [s], where it has one of its own; ``timestamp`` is colour's.

        A bad frame raises nothing: arrays of another size or type, too few pixels with depth, a black or over-exposed
        image, a time that is not finite, depth stamped more than half a second from colour, or a pose that is not
        finite where one is needed, farther than 10 km from the origin, or from where the map has no room for what is
        seen, give the status SKIPPED and a message, and leave the map as it was.

        Raises:
            InputError: Misuse, which no other frame would mend: an argument that is no array, integer depth without
                ``depth_scale``, a T_world_camera that is no rigid transform, or none where one is needed.
            MapSizeError: The map would outgrow the memory set for it.
        """
        frame = self._admit(rgb, depth, timestamp, T_world_camera, depth_scale, depth_timestamp)
        digest = self._digest
        if self.direct is not None and not frame.fault:
            frame, digest = self._check_new(frame)
        frame = self._check_growth(frame)
        if frame.fault:
            self.history.skip(frame.timestamp)
            return skipped(frame, self.history.last_pose)
        account = _Account(self.device)
        self._await_mapping(frame, account)  # a frame to be mapped is tracked against all that was mapped before it
        self._make_current(frame)
        located = self._locate(frame, account)  # Sec. 3.3, Eq. 11-12
        self.history.add(frame.timestamp, located)
        self._digest = digest
        found = self._estimate_timing(frame, account)
        self._close_loops(frame, account)
        self._note_motion(frame)  # what is mapped and kept are images of one moment
        if located.status is FrameStatus.OK and self.config.mapping.enabled:
            is_keyframe = self._is_keyframe(frame)  # Sec. 3.4
            if self._is_due(frame):
                self._map(frame, account)  # Sec. 3.3, Eq. 8-10, with local bundle adjustment
            if is_keyframe:
                self._insert_keyframe(frame, account)
        return replace(self._result(frame, located, account), sensor_timing=found)

    @exclusive
    def finish(self) -> dict[str, float]:
        """After the last frame: map it if it was not, then refine the whole map (Sec. 3.1). Returns the seconds by
        phase.
        """
        self.wait()
        account = _Account(self.device)
        index = self._current
        if index is None or self.history.status(index) is not FrameStatus.OK or not self.config.mapping.enabled:
            return account.seconds
        if self._mapped != index:
            if self.direct is not None:
                self.images.rectify_current(self.direct.motion)
            rgb, _, _ = self.images.current()
            timestamp = self.history.timestamp(index)
            self._map(AdmittedFrame(index, timestamp, rgb, self.images.current_depth()), account)
            with account.timed("mapping"):
                self.wait()
        if self.config.mapping.color_refinement and self.keyframes:
            with account.timed("refinement"):
                self._refine(index, 0, self._refinement_rounds)
        return account.seconds

    @exclusive
    def refine(self, rounds: int | None = None) -> None:
        """More rounds of the global refinement that `finish` ends with (Sec. 3.1), on a map that is done.

        Args:
            rounds: As many as `finish` by default. Their random draws are not those of `finish`.

        Raises:
            InputError: There is no keyframe, or the last frame was not OK, so there is no window to refine.
        """
        self.wait()
        config, index = self.config.mapping, self._current
        if index is None or self.history.status(index) is not FrameStatus.OK or not self.keyframes:
            raise InputError("the map can't be refined: it has no keyframe, or its last frame was not OK")
        usual = self._refinement_rounds
        self._refine(index, usual if config.color_refinement else 0, usual if rounds is None else rounds)

    @exclusive
    def wait(self) -> None:
        """Until every frame that was to be mapped is in the map (at once, unless `Config.schedule` is overlapped)."""
        self._take_over(wait=True)

    @exclusive
    def forget_pose(self) -> None:
        """The camera may be anywhere now: the next frame takes the pose that comes with it, or is looked for at the
        keyframes.
        """
        self.history.break_off()
        self._digest = None

    def _direct_tracker(self) -> DirectTracker | None:
        if self.config.tracking.optimizer != "direct" or self.config.tracking.use_given_poses:
            return None
        max_depth, readout = self.config.grid.max_depth, self._timing.readout
        return DirectTracker(
            self.intrinsics, self.config.direct, max_depth, self.device, self.keyframes, self.images, readout
        )

    def _loop_closer(self) -> LoopCloser | None:
        """What closes loops; with direct tracking alone, whose keyframes lie to each other as they were registered."""
        if self.direct is None or not self.config.loops.enabled:
            return None
        return LoopCloser(self.direct, self.images, self.config.loops)

    def _timing_estimator(self, first: int = 0) -> TimingEstimator | None:
        """What estimates the camera's timing from frame ``first`` on, where nothing is known of it."""
        config = self.config
        is_wanted = config.sensor_timing and config.direct.timing == "auto" and self.timing == ONE_MOMENT
        return TimingEstimator(first=first) if self.direct is not None and is_wanted else None

    # -- its steps -----------------------------------------------------------------------------------------------

    def _admit(
        self,
        rgb: Any,
        depth: Any,
        timestamp: float | None,
        pose: np.ndarray | None,
        depth_scale: float | None,
        depth_timestamp: float | None,
    ) -> AdmittedFrame:
        config = self.config
        return admit(
            len(self.history),
            rgb,
            depth,
            timestamp,
            pose,
            depth_scale=depth_scale,
            last_timestamp=self.history.last_timestamp,
            intrinsics=self.intrinsics,
            config=config,
            depth_timestamp=depth_timestamp if config.sensor_timing else None,
            timing=self._timing,
            colored=self.direct is not None or max(config.tracking.color_weight, config.mapping.color_weight) > 0,
        )

    def _check_new(self, frame: AdmittedFrame) -> tuple[AdmittedFrame, int]:
        """The frame, with a fault if its images are those of the frame before (noise makes those of a camera differ);
        and what they are known by.
        """
        digest = zlib.crc32(frame.depth[::4].tobytes(), zlib.crc32(frame.rgb[::4].tobytes()))
        if digest == self._digest:
            frame = replace(frame, fault="its images are those of the frame before, to the bit")
        return frame, digest

    def _check_growth(self, frame: AdmittedFrame) -> AdmittedFrame:
        """The frame, with a fault if the map has no room for what it sees from the pose that it comes with: one wrong
        pose must not end the run.
        """
        pose = None if frame.fault or frame.given_pose is None else self._pose_without_tracking(frame)
        if pose is None or not self.config.mapping.enabled:
            return frame
        try:
            self.scene.check_growth(*measured_extent(frame.depth, pose, self.intrinsics))
        except MapSizeError as error:
            if self.scene.is_empty:
                raise  # no pose is to blame
            return replace(frame, fault=f"from its T_world_camera {error}")
        return frame

    def _pose_without_tracking(self, frame: AdmittedFrame) -> np.ndarray | None:
        """The pose that is given, or the origin, where there is nothing to track by; None where there is."""
        given = frame.given_pose
        is_starting = self.history.last_known is None and (given is not None or not self._has_begun)
        if self.config.tracking.use_given_poses or is_starting:
            return np.eye(4) if given is None else given
        return None

    def _is_due(self, frame: AdmittedFrame) -> bool:
        return self.scene.is_empty or frame.index % self.config.mapping.every == 0

    def _await_mapping(self, frame: AdmittedFrame, account: _Account) -> None:
        is_due = frame.index % self.config.mapping.every == 0
        if self.scheduler.has_finished or (is_due and self.scheduler.is_busy):
            with account.timed("mapping"):
                account.losses.update(self._take_over(wait=True))

    def _make_current(self, frame: AdmittedFrame) -> None:
        """Its images into slot 0 of the pool."""
        if self.scene.is_empty and not self.config.mapping.enabled and self.direct is None:
            raise InputError("the map is empty and mapping.enabled is off: load a map with Slam.load")
        self.images.set(0, frame.rgb, frame.depth)
        self._current = frame.index

    def _locate(self, frame: AdmittedFrame, account: _Account) -> Located:
        """Where the camera is: tracked against the map; given, or the origin, where there is nothing to track by."""
        pose = self._pose_without_tracking(frame)
        if pose is not None:
            if self.direct is not None:
                with account.timed("tracking"):
                    self.direct.place(frame, pose)
            return Located(pose)
        with account.timed("tracking"):
            located = self._track(frame)
            if self._begins_elsewhere(frame, located):
                located = self._begin_part(frame)
        if located.loss is not None:
            account.losses["tracking"] = located.loss
        return located

    def _track(self, frame: AdmittedFrame) -> Located:
        if self.direct is not None:
            estimator = self.timing_estimator
            self.direct.is_timing_open = estimator is not None and estimator.is_open
            return self.direct.locate(frame, self.history, None if self.scene.is_empty else self.scene.arrays())
        self.images.rectify_current(self._motion(frame))
        return self.localizer.locate(self.scene.arrays(), self.images, frame.index, self.history, self.keyframes)

    def _begins_elsewhere(self, frame: AdmittedFrame, located: Located) -> bool:
        """Whether a camera that was switched on in a map has recognised nothing for long enough to be mapped apart."""
        after = self.config.loops.own_part_after
        if self.loops is None or self.direct is None or self.direct.fixed or not after or not located.why_lost:
            return False
        return not self.direct.is_confirming and self.history.lost_since_break + 1 >= after

    def _begin_part(self, frame: AdmittedFrame) -> Located:
        """A part of the map on its own, beside what there is, which a loop may join later."""
        assert self.direct is not None
        pose, reach = np.eye(4), self.config.grid.max_depth
        pose[0, 3] = max((keyframe.pose[0, 3] for keyframe in self.keyframes), default=0.0) + 2.0 * reach + PART_GAP
        if not self.scene.is_empty:
            pose[0, 3] = self.scene.high[0] + reach + PART_GAP
            try:
                self.scene.check_growth(*measured_extent(frame.depth, pose, self.intrinsics))
            except MapSizeError as error:
                return Located(self.history.last_pose, f"nothing is recognised, and beside what is mapped {error}")
        self.direct.place(frame, pose, is_apart=True)
        return Located(pose, after_loss=True)

    @property
    def _has_begun(self) -> bool:
        """Whether there is something to track by, or a map whose axes count."""
        return not self.scene.is_empty or (self.direct is not None and bool(self.keyframes))

    def _motion(self, frame: AdmittedFrame) -> FrameMotion:
        """How the camera moved while it took a frame, as far as is known by now."""
        return FrameMotion(depth_offset=frame.depth_offset, readout=self._timing.readout).with_twist(
            self.history.twist()
        )

    def _estimate_timing(self, frame: AdmittedFrame, account: _Account) -> dict[str, float]:
        """What is found out of the camera's timing by this frame; it is used from the next one on."""
        estimator, direct = self.timing_estimator, self.direct
        if estimator is None or direct is None:
            return {}
        with account.timed("tracking"):
            found = estimator.look(direct, self.history, frame.depth_offset)
            if found is None:
                return {}
            change, self.timing = found.timing.since(self.timing), found.timing
            if not change.is_none:
                twists = {one.index: twist_between(self.history, one.index) for one in direct.keyframes}
                known = {index: twist for index, twist in twists.items() if twist is not None}
                direct.retime(change, known, estimator.first)
        return found.to_dict()

    def _close_loops(self, frame: AdmittedFrame, account: _Account) -> None:
        """Compare new keyframes with what was seen long ago, mend the poses of all, and the map after them."""
        if self.loops is None or not self.loops.has_new:
            return
        with account.timed("loops"):
            closed = self.loops.look(self.history)
        if closed is not None and self.config.mapping.enabled and not self.scene.is_empty:
            with account.timed("remapping"):
                self._map_again(self.loops, frame)

    def _map_again(self, loops: LoopCloser, frame: AdmittedFrame) -> None:
        """Have mapped what has moved by more than half a fine voxel; the next frame to be mapped waits for it."""
        self.wait()
        remapping = loops.remapping(self._seen, self.history, self.config)
        if remapping is None:
            return
        task = MappingTask("again", frame.index, self.history.pose(frame.index), remapping=remapping)
        self.scheduler.start(task, self.keyframes)
        self._take_over(wait=self._is_due(frame))

    def _note_motion(self, frame: AdmittedFrame) -> None:
        """Rectify the current image by how the camera came to its pose; and tell a keyframe just before of what came
        after it: between two frames it moved as over both steps, and the first had no step at all.
        """
        if self.direct is not None:
            if self.config.mapping.enabled and self._is_due(frame):
                self.images.rectify_current(self.direct.motion)
            return
        motion = self._motion(frame)
        self.images.rectify_current(motion)
        last = self.keyframes[-1] if self.keyframes else None
        if last is None or self.history.last_known != frame.index:
            return
        if frame.index - last.index <= (1 if self.history.follows(last.index) else TWIST_STEPS):
            last.motion = last.motion.with_twist(np.array(motion.twist))

    def _is_keyframe(self, frame: AdmittedFrame) -> bool:
        config = self.config.keyframes
        if self.direct is not None:
            return False  # it makes them itself
        if not self.keyframes:
            return True
        if config.policy == "interval":
            return frame.index - self.keyframes[-1].index >= config.every
        return self.tracker.explained_share(config.known_error) < config.known_share

    def _map(self, frame: AdmittedFrame, account: _Account) -> None:
        """Have a frame mapped."""
        is_first, pose = self.scene.is_empty, self.history.pose(frame.index)
        with account.timed("mapping"):
            depth = frame.depth if self.images.motion.is_none else self.images.current_depth()
            extent = measured_extent(depth, pose, self.intrinsics)
            task = MappingTask("first" if is_first else "frame", frame.index, pose, extent)
            keyframes = self.keyframes  # the list itself: the frame may become one while it is mapped
            if self.direct is not None:  # it may be one already
                keyframes = [keyframe for keyframe in keyframes if keyframe.index != frame.index]
            self.scheduler.start(task, keyframes)
            if self.loops is not None:
                self.loops.made.note(frame.index, pose)
            self._seen.append(SeenDepth.of(frame.index, depth))
            account.losses.update(self._take_over(wait=is_first))

    def _take_over(self, *, wait: bool = False) -> dict[str, float]:
        """What the mapper has finished since: the map, the poses it refined, and its losses, which are returned."""
        finished = self.scheduler.finished(wait=wait)
        if finished is None:
            return {}
        index, result = finished
        if result.again and self.loops is not None:
            self.loops.note_remapped(len(result.window), result.seconds)
            return result.losses
        self._mapped = index
        if result.adjusted:
            self.history.correct(self._mapped, result.pose)
            for keyframe in self.keyframes:
                self.history.correct(keyframe.index, keyframe.pose)
        return result.losses

    def _insert_keyframe(self, frame: AdmittedFrame, account: _Account) -> None:
        with account.timed("keyframe"):
            image = self.images.keep_current()
            self.keyframes.append(Keyframe(frame.index, image, self.history.pose(frame.index), self.images.motion))

    @property
    def _refinement_rounds(self) -> int:
        """Rounds that `finish` has."""
        return self.config.mapping.rounds_for(len(self.keyframes))

    def _refine(self, index: int, first_round: int, rounds: int) -> None:
        which = range(first_round, first_round + rounds)
        task = MappingTask("refinement", index, self.history.pose(index), rounds=which)
        self.scheduler.start(task, self.keyframes)
        self.wait()

    def _result(self, frame: AdmittedFrame, located: Located, account: _Account) -> FrameResult:
        return FrameResult(
            frame.index,
            frame.timestamp,
            self.history.pose(frame.index),
            located.status,
            account.losses,
            located.inliers,
            located.depth_error,
            correlation=located.correlation,
            covariance=located.covariance,
            reference=located.reference,
            timings=account.seconds,
            message=located.why_lost,
        )

    # -- what came out -------------------------------------------------------------------------------------------

    @property
    def _timing(self) -> SensorTiming:
        """As it is corrected for."""
        return self.timing if self.config.sensor_timing else ONE_MOMENT

    @property
    @exclusive
    def trajectory(self) -> Trajectory:
        """All poses so far; keyframes and mapped frames with the corrections of bundle adjustment."""
        return self.history.trajectory

    @property
    @exclusive
    def views(self) -> list[ObservedView]:
        """What the mapped frames saw, from the poses that they have by now."""
        return [seen.view(self.intrinsics, self.history.pose(seen.index)) for seen in self._seen]

    @exclusive
    def render(self, T_world_camera: np.ndarray, *, depth: np.ndarray | None = None, stride: int = 1) -> RenderedImage:
        """View of the map from a pose, every ``stride``-th pixel; a ``depth`` image [m] guides the samples if given.

        Raises:
            InputError: The map is empty, the pose is no rigid transform or farther than 10 km from the origin, or
                ``depth`` or ``stride`` do not fit the camera.
        """
        if self.scene.is_empty:
            raise InputError("the map is empty: step at least one frame first")
        T = check_transform(T_world_camera)
        if not is_near(T):
            raise InputError(f"T_world_camera lies farther than {MAX_DISTANCE:g} m from the origin")
        arrays = self.scene.arrays()
        return render_image(arrays, self.intrinsics, T, self.config.sampling, self.device, depth=depth, stride=stride)

    @exclusive
    def mesh(self, voxel: float | None = None, *, forecast: bool = False) -> trimesh.Trimesh:
        """Coloured mesh of what the mapped frames saw (A.4), in the world frame.

        Args:
            voxel: Edge of a marching-cubes cell [m]; `MeshingConfig.voxel` by default.
            forecast: Add what the coarse level suggests where nothing was seen, in cyan.

        Raises:
            MeshError: Nothing was seen, or there is no surface.
            InputError: ``voxel`` is no positive number, or so small that the mesh would take too much time or memory.
        """
        self.wait()
        config = self.config.meshing
        return extract_mesh(
            self.scene,
            self.views,
            voxel=config.voxel if voxel is None else voxel,
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

    @exclusive
    def inventory(self) -> dict[str, Any]:
        """Figures of the map for metrics.json; see `warpslam.scene.inventory.take_inventory`."""
        found = take_inventory(self.scene, self.images, self.keyframes, self._seen, self.views)
        return found if self.loops is None else {**found, "loops": self.loops.account()}

    # -- saved ---------------------------------------------------------------------------------------------------

    @exclusive
    def save(self, path: str | Path) -> None:
        """Write map, keyframes, trajectory and settings to one file (plain arrays, no code).

        Raises:
            CheckpointError: The file can't be written.
        """
        write_slam(Path(path), self.state())

    @classmethod
    def load(
        cls,
        path: str | Path,
        device: str | None = None,
        *,
        config: Config | None = None,
        localize_only: bool = False,
        timing: SensorTiming | None = None,
    ) -> Slam:
        """Read what `save` wrote; the result goes on from the last frame.

        Args:
            path: File.
            device: As in `Slam`.
            config: Settings from now on, those saved by default; the grids' spacings are the map's.
            localize_only: The map stays as it is, and the camera may be anywhere in it: `mapping.enabled` is off, and
                `forget_pose` was called.
            timing: Of the frames to come, if it is not that of the frames before.

        Raises:
            CheckpointError: The file is missing, damaged, or of another version.
            ConfigError: ``config`` does not fit the map.
        """
        state = read_slam(Path(path), config)
        state = state if timing is None else replace(state, timing=timing, timing_state=None)
        slam = cls.from_state(state, device, localize_only=localize_only)
        if localize_only:
            slam.forget_pose()
        return slam

    @exclusive
    def state(self) -> SlamState:
        """All that the next frame depends on; on the CPU the large arrays are those of the map, not copies."""
        self.wait()
        return SlamState(
            config=self.config,
            intrinsics=self.intrinsics,
            timing=self.timing,
            seed=self.seed,
            device=self.device,
            history=self.history.state(),
            scene=self.scene.state(),
            current_image=self.images.current(),
            current_motion=self.images.motion,
            keyframes=[(keyframe, self.images.kept(keyframe.image)) for keyframe in self.keyframes],
            seen=self._seen,
            current=self._current,
            mapped=self._mapped,
            direct=None if self.direct is None else self.direct.state(),
            digest=self._digest,
            timing_state=None if self.timing_estimator is None else self.timing_estimator.state(),
            loops=None if self.loops is None else self.loops.state(),
            optimizer=self.mapper.state(),
        )

    @classmethod
    def from_state(cls, state: SlamState, device: str | None = None, *, localize_only: bool = False) -> Slam:
        """The `Slam` that a state was taken from.

        Args:
            state: As `state` gives it, or `read_slam` reads it.
            device: As in `Slam`.
            localize_only: The map stays as it is: `mapping.enabled` is off.
        """
        config = state.config.model_copy(deep=True)
        config.mapping.enabled &= not localize_only
        slam = cls(state.intrinsics, config, device, state.seed, decoders=state.scene.decoders, timing=state.timing)
        slam.history = FrameHistory.restored(state.history)
        slam.scene.restore(state.scene)
        slam.mapper.restore(state.optimizer)
        images = [image for _, image in state.keyframes]
        slam.images.restore(state.current_image, state.current_motion, images)
        slam.keyframes = [
            Keyframe(one.index, n, one.pose.copy(), one.motion) for n, (one, _) in enumerate(state.keyframes)
        ]
        slam._seen = list(state.seen)
        slam._current, slam._mapped, slam._digest = state.current, state.mapped, state.digest
        if slam.direct is not None:
            slam.direct = direct = slam._direct_tracker()
            if direct is not None and localize_only:
                direct.fixed = len(slam.keyframes)
            if direct is not None and state.direct is not None:
                direct.restore(state.direct, state.current)
            slam.loops = slam._loop_closer()
            if slam.loops is not None and state.loops is not None:
                slam.loops.restore(state.loops)
            elif slam.loops is not None:
                slam.loops.take_up()
        slam.timing_estimator = slam._timing_estimator(len(slam.history))
        if slam.direct is not None and state.timing_state is not None:
            slam.timing_estimator = TimingEstimator.restored(state.timing_state, state.timing)
        return slam


class _Account:
    """Seconds and losses of one frame."""

    def __init__(self, device: wp.Device) -> None:
        self.device = device
        self.seconds: dict[str, float] = {}
        self.losses: dict[str, float] = {}

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Add the wall-clock seconds of a block to ``seconds[name]``; the block is a phase for the profiler."""
        with phase(name):
            start = time.perf_counter()
            try:
                yield
            finally:
                synchronize(self.device)
                self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start
