"""Mapping (Sec. 3.3): staged optimisation of the grids over a window of frames, Eq. 8-10, with local bundle
adjustment.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import numpy as np
import warp as wp

from warpslam.camera import Intrinsics
from warpslam.config import MappingConfig, SamplingConfig
from warpslam.field.arrays import Gradients
from warpslam.field.decoders import LEVELS
from warpslam.field.objectives import choose_inliers, mapping_loss
from warpslam.field.passes import render
from warpslam.field.ray_batch import RayBatch
from warpslam.field.seeds import ray_seed
from warpslam.mapping.active_sampling import CellErrors
from warpslam.mapping.coarse import optimize_coarse
from warpslam.mapping.depth_start import DepthStart
from warpslam.mapping.frustum import mark_seen, select_in_frustum
from warpslam.mapping.rays import draw_rays
from warpslam.mapping.window import overlapping_window, random_window
from warpslam.poses import pose_from_vector, vector_from_pose
from warpslam.runtime.launching import Launcher
from warpslam.scene.block_grid import reach_of
from warpslam.scene.image_pool import ImagePool
from warpslam.scene.keyframes import Keyframe, PlacedImage, placed
from warpslam.scene.optimizers import ColorDecoderOptimizer, GridOptimizer, PoseOptimizer
from warpslam.scene.scene_map import SceneMap
from warpslam.scene.touched_rows import TouchedRowsState

# What each stage optimises; the learning rates by stage are those of the authors' released code.
_STAGE_LEVELS = {
    "coarse": ("coarse",),
    "middle": ("middle",),
    "fine": ("middle", "fine"),
    "color": ("middle", "fine", "color"),
}


_log = logging.getLogger(__name__)


@dataclass
class MappingResult:
    """Outcome of one mapping call."""

    pose: np.ndarray
    """T_world_camera of the current frame (4, 4), refined if bundle adjustment ran."""
    losses: dict[str, float] = field(default_factory=dict)
    """Mean loss per kept ray in the last iteration of each stage."""
    window: list[int] = field(default_factory=list)
    """Frame numbers of the keyframes that took part."""
    adjusted: bool = False
    """Whether poses were refined."""
    again: bool = False
    """Whether it was keyframes that were mapped once more, and no frame."""
    seconds: float = 0.0
    """That this took, in that case."""


@dataclass
class _Call:
    """One mapping call."""

    frame: int
    """Number of the current frame."""
    pose: np.ndarray
    """Of the current frame, before bundle adjustment (4, 4)."""
    rate_factor: float
    """Of all learning rates of features."""
    adjust: bool
    """Whether poses are refined."""
    refinement: bool
    """Whether it is the final refinement (Sec. 3.1)."""
    round: int
    """Number of the refinement's round."""
    window: list[Keyframe] = field(default_factory=list)
    """Keyframes that take part, the oldest first."""
    ray_counts: dict[str, int] = field(default_factory=dict)
    """Rays of an iteration, by stages that have run."""


class Mapper:
    """Optimises a `SceneMap` from the current frame and selected keyframes.

    scene: The map it optimises.
    """

    def __init__(
        self,
        scene: SceneMap,
        camera: Intrinsics,
        config: MappingConfig,
        sampling: SamplingConfig,
        device: wp.Device,
        seed: int,
    ) -> None:
        self.scene, self.camera, self.config, self.sampling = scene, camera, config, sampling
        self.device, self.seed = device, seed
        self._launcher = Launcher(device)
        self._grids = {level: GridOptimizer(self._launcher) for level in LEVELS}
        self._decoder = ColorDecoderOptimizer(self._launcher, scene.layout)
        # Refinement doubles the window; the last keyframe and the current frame come on top.
        frame_count = 2 * config.window + 2
        self._poses = PoseOptimizer(frame_count, self._launcher)
        samples = sampling.stratified + sampling.surface
        self._batch = RayBatch(config.pixels, samples, device, self._launcher)
        self._losses = wp.zeros(len(LEVELS), dtype=float, device=device)
        self._errors: CellErrors | None = None
        if config.active_share > 0:
            self._errors = CellErrors(frame_count, config.active_share, sampling, device, self._launcher)
        self._changed: set[str] = set()
        self._free: dict[str, np.ndarray] | None = None
        self._is_restricted = False
        self._depth_start: DepthStart | None = None
        if config.depth_start and config.optimize_middle:
            self._depth_start = DepthStart(scene.decoder_weights.middle, scene.grids["middle"].spacing)
        wanted = {"middle": config.optimize_middle, "fine": config.optimize_fine}
        self._frozen = {level for level, is_optimized in wanted.items() if not is_optimized}

    def start_first(
        self, images: ImagePool, frame: int, pose: np.ndarray, on_iteration: Callable | None = None
    ) -> Callable[[], MappingResult]:
        """The first frame: many iterations at higher rates. What is returned waits for the device, and reads the
        outcome.
        """
        config = self.config
        return self._optimize(
            images, frame, pose, [], config.first_iterations, config.first_rate_factor, on_iteration=on_iteration
        )

    def start_frame(
        self, images: ImagePool, frame: int, pose: np.ndarray, keyframes: list[Keyframe]
    ) -> Callable[[], MappingResult]:
        """A later frame: window, frustum selection, three stages, bundle adjustment once there are enough keyframes.
        What is returned waits for the device, and reads the outcome.
        """
        return self._optimize(images, frame, pose, keyframes, self.config.iterations, 1.0)

    def refine(
        self,
        images: ImagePool,
        frame: int,
        pose: np.ndarray,
        keyframes: list[Keyframe],
        rounds: range,
    ) -> MappingResult:
        """Final colour refinement: a doubled window, all vertices, colour stage only, colour decoder fixed, several
        rounds, whose numbers are part of the seeds.
        """
        result = MappingResult(pose)
        iterations = self.config.refinement_iterations or self.config.iterations
        for round_ in rounds:
            result = self._optimize(
                images, frame, result.pose, keyframes, iterations, 1.0, refinement=True, round_=round_
            )()
        return result

    def restrict(self, free: dict[str, np.ndarray] | None, renewed: dict[str, np.ndarray]) -> None:
        """From now on only rows that are true change, bool (rows,) by level, and no decoder; None ends it.

        renewed: Rows, int (n,) by level, whose features were begun again.
        """
        self._is_restricted = free is not None
        self._free = self._free if free is None else free  # what was free has changed, until the next call

    def make_room(self, images: ImagePool, pose: np.ndarray, window: list[PlacedImage]) -> None:
        """Have rows wherever a call on the image in slot 0 may select vertices, and where a window has measured."""
        if self.scene.layout == "dense":
            return
        margin = self.config.frustum_margin
        current, missing = PlacedImage(0, pose), float(images.current_depth().max())
        self.scene.make_room(images.arrays, [current], self.camera, reach_of(margin, missing), around=margin)
        self.scene.make_room(images.arrays, window, self.camera, reach_of(0.0))

    def map_again(
        self, images: ImagePool, keyframe: Keyframe, keyframes: list[Keyframe], iterations: int, round_: int
    ) -> MappingResult:
        """Map a keyframe, whose image is in slot 0, together with others that see the same."""
        return self._optimize(images, keyframe.index, keyframe.pose, keyframes, iterations, 1.0, round_=round_)()

    def changed_rows(self) -> dict[str, wp.array]:
        """Rows of each level that the last call may have changed, int (n,); levels it left alone are absent."""
        if self._free is not None:
            return all_rows(self._free, self.device)
        return {level: self._grids[level].rows for level in self._changed}

    def state(self) -> dict[str, TouchedRowsState]:
        """Nothing: a call begins with fresh moments."""
        return {}

    def restore(self, state: dict[str, TouchedRowsState]) -> None:
        """Nothing to put back; see `state`."""

    # -- one call ------------------------------------------------------------------------------------------------

    def _optimize(
        self,
        images: ImagePool,
        frame: int,
        pose: np.ndarray,
        keyframes: list[Keyframe],
        iterations: int,
        rate_factor: float,
        *,
        refinement: bool = False,
        round_: int = 0,
        on_iteration: Callable | None = None,
    ) -> Callable[[], MappingResult]:
        """Launch a whole call; what is returned reads its outcome."""
        config = self.config
        if not self._is_restricted:
            self._free = None
        call = _Call(frame, pose, rate_factor, self._adjusts(keyframes), refinement, round_)
        coarse = self._choose_windows(call, images, keyframes)
        self._poses.begin(_vectors(call.window, pose), np.full((1, 2), config.bundle_adjustment_rate))
        # Both windows at once: they must be on the device together.
        together = (*call.window, *coarse)
        in_use = images.bring([one.image for one in together], [one.motion for one in together])
        slots = wp.array([*in_use[: len(call.window)], 0], dtype=int, device=self.device)
        self.make_room(images, pose, placed(together, in_use))
        self._select(images, pose, everything=refinement)
        self._launcher.forget()

        if config.coarse and not refinement and not self._is_restricted:
            coarse_slots = wp.array([*in_use[len(call.window) :], 0], dtype=int, device=self.device)
            coarse_poses = wp.array(_vectors(coarse, pose).astype(np.float32), dtype=float, device=self.device)
            count = config.first_iterations if not keyframes and rate_factor != 1.0 else config.coarse_iterations
            self._run_coarse(images, frame, coarse_slots, coarse_poses, count, rate_factor)
            self._note_loss("coarse", call)
        self._run_stages(call, images, slots, self._schedule(iterations, refinement), on_iteration)
        self._changed = {level for stage in call.ray_counts for level in _STAGE_LEVELS[stage]}
        return partial(self._outcome, call)

    def _adjusts(self, keyframes: list[Keyframe]) -> bool:
        """Whether poses are refined."""
        config = self.config
        enough = len(keyframes) >= config.bundle_adjustment_keyframes
        moves = config.bundle_adjustment and config.bundle_adjustment_rate > 0 and not self._is_restricted
        return moves and enough

    def _choose_windows(self, call: _Call, images: ImagePool, keyframes: list[Keyframe]) -> list[Keyframe]:
        """Sets the call's window; returns that of the coarse level."""
        config = self.config
        rng = np.random.default_rng([self.seed, 2, call.frame, call.round])
        size = config.window * (2 if call.refinement else 1)
        if config.selection == "overlap":
            window = overlapping_window(keyframes, size, rng, images.current_depth(), call.pose, self.camera)
        else:
            window = random_window(keyframes, size, rng)
        # The oldest keyframe holds the window in place: it comes first, and its pose stays.
        call.window = sorted(window, key=lambda keyframe: keyframe.index)
        if not config.coarse or call.refinement:
            return []
        # The last keyframe takes part in the coarse level however small the window.
        return random_window(keyframes, max(config.window, 2), rng)

    def _run_stages(
        self, call: _Call, images: ImagePool, slots: wp.array, stages: list[str], on_iteration: Callable | None
    ) -> None:
        """All iterations of the middle, fine and colour stages, Eq. 8-10."""
        frame, round_ = call.frame, call.round
        self._batch.set_seeds([ray_seed(self.seed, 3, frame, n, round_) for n in range(len(stages))])
        for iteration, stage in enumerate(stages):
            if self._errors is not None and (iteration == 0 or stage != stages[iteration - 1]):
                seed = ray_seed(self.seed, 5, frame, iteration, round_)
                self._errors.measure(self.scene.arrays(), images.arrays, slots, self._poses.poses, self.camera, seed)
            self._launcher.iterate(stage, (), partial(self._iterate, call, images, slots, stage))
            if iteration + 1 == len(stages) or stages[iteration + 1] != stage:
                self._note_loss(stage, call)
            if on_iteration is not None:
                on_iteration(stage, iteration, len(stages))

    def _outcome(self, call: _Call) -> MappingResult:
        """Wait for a call, write the refined poses into its keyframes, and tell what came out."""
        for name, optimizer in (*self._grids.items(), ("colour decoder", self._decoder)):
            if optimizer.has_rejected:
                _log.warning("frame %d: gradients of the %s were not finite and have been left out", call.frame, name)
        result = MappingResult(call.pose, window=[keyframe.index for keyframe in call.window], adjusted=call.adjust)
        losses = self._losses.numpy()
        result.losses = {s: float(losses[LEVELS.index(s)]) / max(count, 1) for s, count in call.ray_counts.items()}
        if call.adjust:
            # Adam moves the length of a quaternion freely, which changes nothing but the step sizes.
            poses = [pose_from_vector(vector) for vector in self._poses.vectors()]
            for keyframe, refined in zip(call.window[1:], poses[1:-1], strict=True):
                keyframe.pose = refined
            result.pose = poses[-1]
        return result

    def _schedule(self, iterations: int, refinement: bool) -> list[str]:
        """Stage of each iteration; both comparisons are inclusive, as in the released code."""
        if refinement:
            return ["color"] * iterations
        middle, fine = int(self.config.middle_share * iterations), int(self.config.fine_share * iterations)
        # Without middle features to optimise the first stage is the one that optimises fine ones.
        first = "middle" if self.config.optimize_middle else "fine"
        return [first if j <= middle else "fine" if j <= fine else "color" for j in range(iterations)]

    def _select(self, images: ImagePool, T_world_camera: np.ndarray, *, everything: bool) -> None:
        """Which vertices of each level may change during this call; and note those that the frame has measured."""
        depth = images.metres()
        for level, optimizer in self._grids.items():
            grid = self.scene.grids[level]
            if level in self._frozen:
                mask = np.zeros(grid.row_count, bool)
            elif level == "coarse" or everything or not self.config.frustum_selection:
                mask = np.arange(grid.row_count) >= grid.lattice.shared
            else:
                mask = select_in_frustum(
                    grid.lattice, grid.row_count, self.camera, T_world_camera, depth, self.config.frustum_margin
                )
            if self._is_restricted and self._free is not None:
                # Rows that are newer are held, too.
                free = self._free.get(level, np.zeros(0, bool))
                mask = mask & np.pad(free, (0, len(mask) - len(free)))
            optimizer.begin(grid, mask)
            if level == "middle" and self._depth_start is not None and not everything:
                self._depth_start.apply(grid, self.camera, T_world_camera, depth, optimizer.selected)
        mark_seen(self.scene.grids["color"], self.camera, T_world_camera, depth)
        self._decoder.begin()

    def _iterate(self, call: _Call, images: ImagePool, slots: wp.array, stage: str) -> None:
        """One iteration of a stage; nothing in it may depend on the iteration's number, because it is replayed."""
        adjust, refinement, rate_factor, T_world_camera = call.adjust, call.refinement, call.rate_factor, call.pose
        config, batch, arrays = self.config, self._batch, self.scene.arrays()
        color = stage == "color"
        train_decoder = color and config.train_color_decoder and not refinement and not self._is_restricted
        gradients = Gradients(
            grids={level: self._grids[level].wanted() for level in _STAGE_LEVELS[stage]},
            points=adjust and color,
            inliers_move=config.bundle_adjustment_filter > 0,
            color_weights=self._decoder.gradient if train_decoder else None,
        )
        with self._launcher.tape() as tape:
            scale, thresholds = draw_rays(
                batch,
                arrays,
                images,
                slots,
                self._poses.poses,
                T_world_camera,
                self.camera,
                config,
                self.sampling,
                self._errors,
                differentiate=gradients.points,
            )
            render(batch, arrays, stage, gradients, tape, thresholds=thresholds)
            if gradients.points and gradients.inliers_move:
                choose_inliers(batch, config.bundle_adjustment_filter, normalized=False)
            mapping_loss(batch, config.color_weight * scale if color else 0.0, scale)
        self._launcher.call(partial(tape.backward, batch.loss))
        rates = {
            "middle": config.middle_rate if stage == "middle" else config.geometry_rate,
            "fine": config.geometry_rate,
            "color": config.color_rate,
        }
        for level in _STAGE_LEVELS[stage]:
            self._grids[level].update(self.scene.grids[level].features, rates[level] * rate_factor)
        if train_decoder:
            self._decoder.update_decoder(self.scene.decoders["color"], config.color_rate * rate_factor)
        if adjust and color:
            # Moments start in the colour stage: the earlier stages never ask for pose gradients.
            self._poses.update(first=1)
        batch.next_iteration()

    # -- the coarse level (Sec. 3.1), for forecasts and, if wanted, the coarse term of tracking -------------------

    def _run_coarse(
        self,
        images: ImagePool,
        frame: int,
        slots: wp.array,
        poses: wp.array,
        iterations: int,
        rate_factor: float,
    ) -> None:
        """Coarse stage: no depth guidance, depth loss only, all vertices."""
        config = self.config
        optimize_coarse(
            self.scene,
            self._grids["coarse"],
            images,
            slots,
            poses,
            self.camera,
            config,
            self.sampling,
            self._batch,
            self._launcher,
            [ray_seed(self.seed, 4, frame, n) for n in range(iterations)],
            config.coarse_rate * rate_factor,
        )

    def _note_loss(self, stage: str, call: _Call) -> None:
        """Keep the loss of the last iteration on the device until the end of the call."""
        call.ray_counts[stage] = self._batch.count
        wp.copy(self._losses, self._batch.loss, dest_offset=LEVELS.index(stage), count=1)


def all_rows(free: dict[str, np.ndarray], device: wp.Device) -> dict[str, wp.array]:
    """Rows that are true, bool (rows,) by level, as int (n,)."""
    rows = {level: np.flatnonzero(mask).astype(np.int32) for level, mask in free.items()}
    return {level: wp.array(which, dtype=int, device=device) for level, which in rows.items()}


def _vectors(keyframes: list[Keyframe], pose: np.ndarray) -> np.ndarray:
    """Pose vectors of keyframes and, last, of the current frame, float64 (frames, 7)."""
    return np.stack([vector_from_pose(T) for T in (*(keyframe.pose for keyframe in keyframes), pose)])
