"""Where the current frame's rays should go under the direct loss: to what the map has wrong, and what it hardly knows.

One ray a cell of the image, with a sample at its measured depth, where the logit should be 0, and one before it, at the
depth of a pixel nearby where that is smaller: beside an outline free space is most likely to be taken for occupied.
Space that few rays have seen is known by its vertices, whose updates are counted.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from warpslam.camera import Intrinsics
from warpslam.config import SupervisionConfig
from warpslam.field.arrays import FieldArrays, camera_struct, struct
from warpslam.field.ray_batch import RayBatch, image_struct
from warpslam.field.supervision import place_band, query_geometry
from warpslam.kernels import pixels, supervision
from warpslam.kernels.supervision import Band, Target
from warpslam.poses import vector_from_pose
from warpslam.runtime.launching import Launcher
from warpslam.runtime.phases import phase

CELLS = (60, 45)
"""Cells of an image, across and down."""

LARGEST_ERROR = 0.15  # [m]: an outline, which no map gets right, must not draw all rays
YOUNG_ERROR = 0.1  # [m], of a vertex that was never updated


class Probe:
    """Errors of the cells of the current frame.

    active: What `RayBatch.draw` takes, for a ``share`` of the rays of a window whose last frames are the current one.
    """

    def __init__(
        self,
        frame_count: int,
        share: float,
        settings: SupervisionConfig,
        target: Target,
        band: Band,
        device: wp.Device,
        launcher: Launcher,
    ) -> None:
        self.settings, self._target, self._launcher = settings, target, launcher
        self._band = struct(
            Band,
            free=1,
            edge=1,
            front=band.front,
            behind=band.behind,
            radius=band.radius,
            edge_front=band.edge_front,
            edge_behind=band.edge_behind,
        )
        count = CELLS[0] * CELLS[1]
        self._batch = RayBatch(count, 2, device, launcher)
        self._batch.count = count
        self._window = wp.zeros(1, dtype=int, device=device)  # slot 0 of the pool
        self._pose = wp.zeros((1, 7), dtype=float, device=device)
        self._cumulative = wp.zeros((frame_count, count), dtype=float, device=device)
        self.active = share, CELLS, self._cumulative

    @phase("active sampling")
    def measure(
        self,
        arrays: FieldArrays,
        updates: wp.array,
        images: tuple[wp.array, wp.array, wp.array],
        pose: np.ndarray,
        camera: Intrinsics,
        first_current: int,
        seed: int,
    ) -> None:
        """Errors of the image in slot 0.

        Args:
            arrays: The map.
            updates: How often each row of the fine level was updated.
            images: As `RayBatch.draw` takes them.
            pose: T_world_camera of the current frame (4, 4).
            camera: Intrinsics.
            first_current: First frame of the window that is the current one; rays of those before stay uniform.
            seed: Of the pixels.
        """
        batch, launch = self._batch, self._launcher.launch
        batch.set_seeds([seed])
        self._pose.assign(vector_from_pose(pose)[None].astype(np.float32))
        inputs = [batch.draws, self._window, wp.vec2i(*CELLS), camera_struct(camera), image_struct(images)]
        launch(pixels.probe_pixels, batch.count, [*inputs, batch.pixels])
        batch.cast(self._pose, differentiate=False)
        batch.bound(arrays)
        place_band(batch, self._band, images, self._window, camera)
        query_geometry(batch, arrays)
        inputs = [first_current, self._target, LARGEST_ERROR, YOUNG_ERROR, float(self.settings.young_updates)]
        inputs += [arrays.lattices["fine"], updates, batch.rays, batch.keep, batch.logit, self._cumulative]
        launch(supervision.probe_errors, self._cumulative.shape[0], inputs)
