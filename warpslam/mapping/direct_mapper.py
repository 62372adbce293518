"""Mapping by the direct loss: every sample of a ray against its measured depth, all levels at once, few iterations.

A call takes `PARTS` equal parts of rays: of keyframes that see the same, and of the current frame, half of these where
the map errs. There are no stages and no choice of vertices: a sample reaches no vertex but those of its cell, and
moments persist, with a step count a row.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import partial

import numpy as np
import warp as wp

from warpslam.camera import Intrinsics
from warpslam.config import Config
from warpslam.field.arrays import Gradients, struct
from warpslam.field.ray_batch import RayBatch
from warpslam.field.seeds import ray_seed
from warpslam.field.supervision import place_band, supervise
from warpslam.kernels.supervision import Band, Target
from warpslam.mapping.frustum import mark_seen
from warpslam.mapping.mapper import MappingResult, all_rows
from warpslam.mapping.probe import Probe
from warpslam.mapping.refinement import Refinement
from warpslam.mapping.window import random_keyframes, replayed_keyframes
from warpslam.poses import vector_from_pose
from warpslam.runtime.launching import Launcher
from warpslam.scene.block_grid import reach_of
from warpslam.scene.image_pool import ImagePool
from warpslam.scene.keyframes import Keyframe, PlacedImage, placed
from warpslam.scene.optimizers import ColorDecoderOptimizer
from warpslam.scene.scene_map import SceneMap
from warpslam.scene.touched_rows import TouchedRows, TouchedRowsState

PARTS = 8
"""Equal parts of the rays of an iteration, of one image each."""

HUBER = 0.1  # of the logit
COLOR_HUBER = 0.05
EDGE_RADIUS = 20.0  # [px]
EDGE_FRONT, EDGE_BEHIND = 0.06, 0.1  # [m]
PROBED_SHARE = 0.5

_log = logging.getLogger(__name__)


class DirectMapper:
    """Optimises a `SceneMap` from the current frame and keyframes.

    scene: The map it optimises.
    """

    def __init__(self, scene: SceneMap, camera: Intrinsics, config: Config, device: wp.Device, seed: int) -> None:
        self.scene, self.camera, self.device, self.seed = scene, camera, device, seed
        self.settings, self.config, self.supervision = config, config.mapping, config.supervision
        settings = self.supervision
        self._launcher = Launcher(device)
        samples = settings.free_samples + settings.near_samples + 1
        rays = max(self.config.pixels // PARTS, 1)
        self._rays_per_part = rays
        self._batch = RayBatch(PARTS * rays, samples, device, self._launcher)
        self._target = struct(
            Target,
            slope=settings.slope,
            front=settings.front,
            behind=settings.behind,
            huber=HUBER,
            behind_weight=settings.behind_weight,
            color_weight=1.0,
            color_reach=settings.color_reach,
            color_huber=COLOR_HUBER,
        )
        self._band = struct(
            Band,
            free=settings.free_samples,
            edge=min(settings.edge_samples, settings.free_samples),
            near=settings.near_samples,
            front=settings.front,
            behind=settings.behind,
            radius=EDGE_RADIUS,
            edge_front=EDGE_FRONT,
            edge_behind=EDGE_BEHIND,
        )
        wanted = {"middle": self.config.optimize_middle, "fine": self.config.optimize_fine, "color": True}
        self._rates = {name: getattr(settings, f"{name}_rate") for name, is_optimized in wanted.items() if is_optimized}
        capacity = 8 * PARTS * rays * samples
        self._rows = {
            level: TouchedRows(self._launcher, scene.grids[level], capacity) for level in ("middle", "fine", "color")
        }
        self._decoder = ColorDecoderOptimizer(self._launcher, scene.layout)
        self._decoder.begin()
        self._free: dict[str, np.ndarray] | None = None
        self._is_restricted = False
        self._changed: dict[str, wp.array] | None = None
        self._probe = Probe(PARTS, PROBED_SHARE, settings, self._target, self._band, device, self._launcher)
        self._window = wp.zeros(PARTS, dtype=int, device=device)
        self._poses = wp.zeros((PARTS, 7), dtype=float, device=device)

    # -- as `Mapper` ---------------------------------------------------------------------------------------------

    def start_first(
        self, images: ImagePool, frame: int, pose: np.ndarray, on_iteration: Callable | None = None
    ) -> Callable[[], MappingResult]:
        """The first frame: more iterations. What is returned waits for the device, and reads the outcome."""
        return self._optimize(images, frame, pose, [], self.config.first_iterations, on_iteration=on_iteration)

    def start_frame(
        self, images: ImagePool, frame: int, pose: np.ndarray, keyframes: list[Keyframe]
    ) -> Callable[[], MappingResult]:
        """A later frame. What is returned waits for the device, and reads the outcome."""
        return self._optimize(
            images, frame, pose, self._replayed(images, frame, pose, keyframes, 0), self.config.iterations
        )

    def refine(
        self, images: ImagePool, frame: int, pose: np.ndarray, keyframes: list[Keyframe], rounds: range
    ) -> MappingResult:
        """Final refinement: rounds by the direct loss over random keyframes, which completes what was seen for a short
        time, and as many by the rendering loss. Their numbers are part of the seeds.
        """
        changed = []
        for round_ in rounds:
            rng = np.random.default_rng([self.seed, 2, frame, 1 + round_])
            window = random_keyframes(keyframes, PARTS - 1, rng)
            self._optimize(images, frame, pose, window, self.config.refined_directly, round_=1 + round_)()
            changed.append(self.changed_rows())
        refinement = Refinement(
            self.scene, self.camera, self.settings, list(self._rates), self.make_room, self.device, self.seed
        )
        loss, window = 0.0, []
        for round_ in rounds:
            loss, window = refinement.run(images, frame, pose, keyframes, round_)
            changed.append(refinement.changed_rows())
        self._changed = _union(changed, self.device)
        return MappingResult(pose, {"color": loss}, sorted({keyframe.index for keyframe in window}))

    def restrict(self, free: dict[str, np.ndarray] | None, renewed: dict[str, np.ndarray]) -> None:
        """From now on only rows that are true change, bool (rows,) by level, and no decoder; None ends it.

        renewed: Rows, int (n,) by level, whose features were begun again.
        """
        self._fit()
        for level, rows in self._rows.items():
            rows.hold(None if free is None else ~free[level])
            if level in renewed:
                rows.forget(renewed[level])
        self._is_restricted = free is not None
        self._free = self._free if free is None else free  # what was free has changed, until the next call

    def make_room(self, images: ImagePool, pose: np.ndarray, window: list[PlacedImage]) -> None:
        """Have rows wherever a call on the image in slot 0 and a window may have samples."""
        views = [PlacedImage(0, pose), *window]
        self.scene.make_room(images.arrays, views, self.camera, reach_of(self.supervision.behind))

    def map_again(
        self, images: ImagePool, keyframe: Keyframe, keyframes: list[Keyframe], iterations: int, round_: int
    ) -> MappingResult:
        """Map a keyframe, whose image is in slot 0, together with others that see the same."""
        frame, pose = keyframe.index, keyframe.pose
        replayed = self._replayed(images, frame, pose, keyframes, round_)
        return self._optimize(images, frame, pose, replayed, iterations, round_=round_)()

    def changed_rows(self) -> dict[str, wp.array]:
        """Rows of each level that the last call may have changed, int (n,); levels it left alone are absent."""
        if self._free is not None:
            return all_rows(self._free, self.device)
        if self._changed is not None:
            return self._changed
        return {level: self._rows[level].changed_rows() for level in self._rates}

    def state(self) -> dict[str, TouchedRowsState]:
        """What the next call depends on beside the map: by level, and of the colour decoder as ``decoder``."""
        return {**{level: rows.state() for level, rows in self._rows.items()}, "decoder": self._decoder.state()}

    def restore(self, state: dict[str, TouchedRowsState]) -> None:
        """Put back what `state` was; the map is already what it was."""
        self._fit()
        for level, rows in self._rows.items():
            if level in state:
                rows.restore(state[level])
        if "decoder" in state:
            self._decoder.restore(state["decoder"])

    def _replayed(
        self, images: ImagePool, frame: int, pose: np.ndarray, keyframes: list[Keyframe], round_: int
    ) -> list[Keyframe]:
        """Keyframes that share a call with a frame."""
        rng = np.random.default_rng([self.seed, 2, frame, round_])
        count = round(PARTS * self.supervision.replay_share)
        return replayed_keyframes(keyframes, count, rng, images, pose, self.camera)

    # -- one call ------------------------------------------------------------------------------------------------

    def _fit(self) -> None:
        for level, rows in self._rows.items():
            rows.fit(self.scene.grids[level])

    def _optimize(
        self,
        images: ImagePool,
        frame: int,
        pose: np.ndarray,
        window: list[Keyframe],
        iterations: int,
        *,
        round_: int = 0,
        on_iteration: Callable | None = None,
    ) -> Callable[[], MappingResult]:
        """Launch a whole call; what is returned reads its outcome."""
        if not self._is_restricted:
            self._free = None
        self._changed = None
        slots = images.bring([one.image for one in window], [one.motion for one in window])
        self.make_room(images, pose, placed(window, slots))
        self._fit()
        for rows in self._rows.values():
            rows.begin()
        mark_seen(self.scene.grids["color"], self.camera, pose, images.metres())
        repeats = PARTS - len(window)
        self._window.assign(np.array([*slots, *[0] * repeats], np.int32))
        poses = [vector_from_pose(T) for T in (*(one.pose for one in window), *[pose] * repeats)]
        self._poses.assign(np.array(poses, np.float32))
        arrays, updates = self.scene.arrays(), self._rows["fine"].updates
        seed = ray_seed(self.seed, 5, frame, 0, round_)
        self._probe.measure(arrays, updates, images.arrays, pose, self.camera, len(window), seed)

        self._batch.set_seeds([ray_seed(self.seed, 3, frame, n, round_) for n in range(iterations)])
        uses = [self._batch.seeds, images.rgb, *(grid.lattice for grid in self.scene.grids.values())]
        uses += [grid.features for grid in self.scene.grids.values()]
        uses += [rows.updates for rows in self._rows.values()]
        if self.config.moved_margin > 0:
            uses += [frame, round_]  # the pose is an argument of what is recorded
        if self._is_restricted:
            uses += ["restricted"]
        for n in range(iterations):
            self._launcher.iterate("direct", tuple(uses), partial(self._iterate, images, len(window), pose))
            if on_iteration is not None:
                on_iteration("direct", n, iterations)
        return partial(self._outcome, frame, pose, window)

    def _iterate(self, images: ImagePool, current: int, pose: np.ndarray) -> None:
        """One iteration; nothing in it may depend on its number or the frame, because it is replayed."""
        batch, arrays, launcher = self._batch, self.scene.arrays(), self._launcher
        train_decoder = self.config.train_color_decoder and not self._is_restricted
        gradients = Gradients(
            grids={level: self._rows[level].wanted() for level in self._rates},
            color_weights=self._decoder.gradient if train_decoder else None,
        )
        with launcher.tape() as tape:
            batch.draw(images.arrays, self._window, self._rays_per_part, self.camera, active=self._probe.active)
            batch.cast(self._poses, differentiate=False)
            batch.bound(arrays)
            if self.config.moved_margin > 0 and current > 0:
                batch.drop_contradicted(images.arrays, current, pose, self.camera, self.config.moved_margin)
            place_band(batch, self._band, images.arrays, self._window, self.camera)
            supervise(batch, arrays, self._target, gradients, tape)
        launcher.call(partial(tape.backward, batch.loss))
        for level, rate in self._rates.items():
            self._rows[level].update(self.scene.grids[level].features, rate)
        if train_decoder:
            self._decoder.update_decoder(self.scene.decoders["color"], self.supervision.decoder_rate)
        batch.next_iteration()

    def _outcome(self, frame: int, pose: np.ndarray, window: list[Keyframe]) -> MappingResult:
        """Wait for a call, and tell what came out."""
        rejected = {level: rows.has_rejected for level, rows in self._rows.items()}
        for name, has_rejected in {**rejected, "colour decoder": self._decoder.has_rejected}.items():
            if has_rejected:
                _log.warning("frame %d: gradients of the %s were not finite and have been left out", frame, name)
        loss = float(self._batch.loss.numpy()[0]) / self._batch.count
        return MappingResult(pose, {"direct": loss}, sorted({keyframe.index for keyframe in window}))


def _union(parts: list[dict[str, wp.array]], device: wp.Device) -> dict[str, wp.array]:
    """Rows of several calls, int (n,) by level, each once."""
    levels = sorted({level for part in parts for level in part})
    rows = {level: np.concatenate([part[level].numpy() for part in parts if level in part]) for level in levels}
    return {level: wp.array(np.unique(which), dtype=int, device=device) for level, which in rows.items()}
