"""The final refinement of a map that the direct loss has made: whole rays, by the rendering loss (Eq. 8-10).

The direct loss gets surfaces right where there are samples, one by one. What it can't see is the sum along a ray: a
little haze before a wall, and outlines a pixel too wide. A few iterations of rendering over keyframes take both away.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import partial

import numpy as np
import warp as wp

from warpslam.camera import Intrinsics
from warpslam.config import Config
from warpslam.field.arrays import Gradients
from warpslam.field.objectives import mapping_loss
from warpslam.field.passes import render
from warpslam.field.ray_batch import RayBatch
from warpslam.field.seeds import ray_seed
from warpslam.mapping.active_sampling import CellErrors
from warpslam.mapping.coarse import optimize_coarse
from warpslam.mapping.rays import draw_rays
from warpslam.mapping.window import keyframes_in_turn
from warpslam.poses import vector_from_pose
from warpslam.runtime.launching import Launcher
from warpslam.scene.image_pool import ImagePool
from warpslam.scene.keyframes import Keyframe, PlacedImage, placed
from warpslam.scene.optimizers import GridOptimizer
from warpslam.scene.scene_map import SceneMap
from warpslam.scene.touched_rows import TouchedRows

_log = logging.getLogger(__name__)


class Refinement:
    """Features of all levels under the rendering loss; decoders and poses stay. Moments are those of one refinement.

    Args:
        scene: The map.
        camera: Intrinsics.
        config: Settings.
        levels: Levels whose features change.
        make_room: As `DirectMapper.make_room`.
        device: Where.
        seed: Of keyframes and rays.
    """

    def __init__(
        self,
        scene: SceneMap,
        camera: Intrinsics,
        config: Config,
        levels: list[str],
        make_room: Callable[[ImagePool, np.ndarray, list[PlacedImage]], None],
        device: wp.Device,
        seed: int,
    ) -> None:
        self.scene, self.camera, self.config, self.seed = scene, camera, config.mapping, seed
        self._make_room = make_room
        sampling = self.sampling = config.sampling
        self._launcher = Launcher(device)
        samples = sampling.stratified + sampling.surface
        self._batch = RayBatch(self.config.pixels, samples, device, self._launcher)
        self.rows = {
            level: TouchedRows(self._launcher, scene.grids[level], 8 * samples * self.config.pixels) for level in levels
        }
        self._coarse: GridOptimizer | None = None
        if self.config.coarse:
            self._coarse = GridOptimizer(self._launcher)
            grid = scene.grids["coarse"]
            self._coarse.begin(grid, np.arange(grid.row_count) >= grid.lattice.shared)
        self._errors: CellErrors | None = None
        if self.config.active_share > 0:
            frames = self.config.refinement_frames
            self._errors = CellErrors(frames, self.config.active_share, sampling, device, self._launcher)

    def run(
        self, images: ImagePool, frame: int, pose: np.ndarray, keyframes: list[Keyframe], round_: int
    ) -> tuple[float, list[Keyframe]]:
        """A round over some keyframes, in turn with other rounds, and the current frame, whose image is in slot 0.
        Returns the loss of a ray in its last iteration, and the keyframes.

        Args:
            images: Images of keyframes and of the current frame.
            frame: Its number.
            pose: T_world_camera of the current frame (4, 4).
            keyframes: All of them.
            round_: Number of the round, as part of the seeds.
        """
        config, batch, device = self.config, self._batch, self._batch.device
        rng, count = np.random.default_rng([self.seed, 2, frame]), config.refinement_frames - 1
        window = keyframes_in_turn(keyframes, round_ * count, min(count, len(keyframes)), rng)
        in_use = images.bring([one.image for one in window], [one.motion for one in window])
        self._make_room(images, pose, placed(window, in_use))
        for level, rows in self.rows.items():
            rows.fit(self.scene.grids[level])
            rows.begin()
        slots = wp.array([*in_use, 0], dtype=int, device=device)
        vectors = [vector_from_pose(T) for T in (*(one.pose for one in window), pose)]
        poses = wp.array(np.array(vectors, np.float32), dtype=float, device=device)
        self._launcher.forget()
        if self._coarse is not None:
            self._run_coarse(images, frame, slots, poses, round_)
        iterations = config.refinement_iterations or config.iterations
        if self._errors is not None:
            arrays, seed = self.scene.arrays(), ray_seed(self.seed, 5, frame, 0, round_)
            self._errors.measure(arrays, images.arrays, slots, poses, self.camera, seed)
        batch.set_seeds([ray_seed(self.seed, 3, frame, n, round_) for n in range(iterations)])
        for _ in range(iterations):
            self._launcher.iterate("refinement", (), partial(self._iterate, images, slots, poses, pose))
        for level, rows in self.rows.items():
            if rows.has_rejected:
                _log.warning("refinement: gradients of the %s were not finite and have been left out", level)
        return float(batch.loss.numpy()[0]) / max(batch.count, 1), window

    def changed_rows(self) -> dict[str, wp.array]:
        """Rows of each level that the last round may have changed, int (n,)."""
        changed = {level: rows.changed_rows() for level, rows in self.rows.items()}
        return changed if self._coarse is None else {**changed, "coarse": self._coarse.rows}

    def _run_coarse(self, images: ImagePool, frame: int, slots: wp.array, poses: wp.array, round_: int) -> None:
        """The coarse level, which no other call has formed."""
        assert self._coarse is not None
        config = self.config
        optimize_coarse(
            self.scene,
            self._coarse,
            images,
            slots,
            poses,
            self.camera,
            config,
            self.sampling,
            self._batch,
            self._launcher,
            [ray_seed(self.seed, 4, frame, n, round_) for n in range(config.coarse_iterations)],
            config.coarse_rate * config.first_rate_factor,
        )

    def _iterate(self, images: ImagePool, slots: wp.array, poses: wp.array, pose: np.ndarray) -> None:
        """One iteration; nothing in it may depend on its number, because it is replayed."""
        config, batch, arrays = self.config, self._batch, self.scene.arrays()
        gradients = Gradients(grids={level: rows.wanted() for level, rows in self.rows.items()})
        with self._launcher.tape() as tape:
            scale, thresholds = draw_rays(
                batch, arrays, images, slots, poses, pose, self.camera, config, self.sampling, self._errors
            )
            render(batch, arrays, "color", gradients, tape, thresholds=thresholds)
            mapping_loss(batch, config.color_weight * scale, scale)
        self._launcher.call(partial(tape.backward, batch.loss))
        rates = {"middle": config.geometry_rate, "fine": config.geometry_rate, "color": config.color_rate}
        for level, rows in self.rows.items():
            rows.update(self.scene.grids[level].features, rates[level])
        batch.next_iteration()
