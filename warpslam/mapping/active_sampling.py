"""Active sampling, after iMAP (Sucar et al., ICCV 2021, Sec. 3.4): a share of the rays goes where the map errs.

NICE-SLAM draws its pixels uniformly. What covers a small part of a few images, such as the floor that comes into view
at the border, or what shows between the legs of a chair, then gets so few rays that it is not formed when the camera
has moved on.
"""

from __future__ import annotations

import warp as wp

from warpslam.camera import Intrinsics
from warpslam.config import SamplingConfig
from warpslam.field.arrays import EXACT, FieldArrays, camera_struct
from warpslam.field.passes import render
from warpslam.field.ray_batch import RayBatch, image_struct
from warpslam.kernels import pixels
from warpslam.runtime.launching import Launcher
from warpslam.runtime.phases import phase

CELLS = (20, 15)
"""Cells of an image, across and down."""

LARGEST_ERROR = 0.3  # [m]: a pixel on an outline, which no map gets right, must not draw all rays


class CellErrors:
    """How much the map errs in depth in each cell of some images, from one random pixel a cell.

    cumulative: Running sums over the cells of an image, row by row, float (frames, cells).
    active: What `RayBatch.draw` takes, for a ``share`` of the rays.
    """

    def __init__(
        self, capacity: int, share: float, sampling: SamplingConfig, device: wp.Device, launcher: Launcher
    ) -> None:
        self.cell_count = CELLS[0] * CELLS[1]
        self.sampling, self._launcher = sampling, launcher
        self._batch = RayBatch(capacity * self.cell_count, sampling.stratified + sampling.surface, device, launcher)
        self.cumulative = wp.zeros((capacity, self.cell_count), dtype=float, device=device)
        self.active = share, CELLS, self.cumulative

    @phase("active sampling")
    def measure(
        self,
        arrays: FieldArrays,
        images: tuple[wp.array, wp.array, wp.array],
        window: wp.array,
        poses: wp.array,
        camera: Intrinsics,
        seed: int,
    ) -> None:
        """Errors of the images in slots ``window``, int (frames,), seen from pose vectors ``poses`` (frames, 7)."""
        batch = self._batch
        frames = window.shape[0]
        batch.set_seeds([seed])
        batch.count = frames * self.cell_count
        inputs = [batch.draws, window, wp.vec2i(*CELLS), camera_struct(camera), image_struct(images), batch.pixels]
        self._launcher.launch(pixels.probe_pixels, batch.count, inputs)
        batch.cast(poses, differentiate=False)
        batch.bound(arrays)
        batch.place_samples(self.sampling.stratified, self.sampling.surface, jitter=self.sampling.jitter)
        render(batch, arrays, "fine", thresholds=EXACT)
        inputs = [self.cell_count, LARGEST_ERROR, batch.keep, batch.measured_depth, batch.depth, self.cumulative]
        self._launcher.launch(pixels.accumulate_errors, frames, inputs)
