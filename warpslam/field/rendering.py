"""Whole images of the map: depth, colour and variance (Eq. 6-7)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import warp as wp

from warpslam.camera import Intrinsics
from warpslam.config import SamplingConfig
from warpslam.errors import InputError
from warpslam.field.arrays import FieldArrays, Thresholds, struct
from warpslam.field.passes import query, render, take_surface_depth
from warpslam.field.ray_batch import RayBatch
from warpslam.kernels.free_space import Looks
from warpslam.poses import MAX_DISTANCE, as_numbers, vector_from_pose
from warpslam.runtime.phases import phase

RAYS_PER_CHUNK = 8192
FIRST_PASS_SAMPLES = 128
FIRST_PASS_OCCUPANCY = 0.3
LOOK_STRIDE = 4
"""Of the pixels along whose rays `find_free_space` looks, to those of the picture."""


@dataclass(frozen=True)
class RenderedImage:
    """A view of the map.

    depth: z-depth [m], float32 (H, W). rgb: Colour in [0, 1], float32 (H, W, 3). variance: Of the depth [m^2], float32
    (H, W).
    """

    depth: np.ndarray
    rgb: np.ndarray
    variance: np.ndarray


@phase("rendering")
def render_image(
    arrays: FieldArrays,
    camera: Intrinsics,
    T_world_camera: np.ndarray,
    sampling: SamplingConfig,
    device: wp.Device,
    *,
    depth: np.ndarray | None = None,
    stride: int = 1,
) -> RenderedImage:
    """Render the view from ``T_world_camera``, every ``stride``-th pixel.

    With a ``depth`` image (H, W) [m], samples are placed around it as in mapping. Without one, a first pass spreads
    its samples evenly over the map, and the depth it finds places those of the second: nothing but the map enters.
    Samples that do not count are left out as in mapping, and those in free space (`SamplingConfig`).
    """
    if (
        not isinstance(stride, int | np.integer)
        or isinstance(stride, bool)
        or not 1 <= stride <= max(camera.width, camera.height)
    ):
        raise InputError(f"stride = {stride!r} must be a whole number from 1 to the size of the image")
    stride = int(stride)
    if depth is not None:
        depth = as_numbers(depth, "depth")
        if depth.shape != (camera.height, camera.width):
            raise InputError(f"depth has shape {depth.shape}, expected {(camera.height, camera.width)}")
        depth = np.ascontiguousarray(depth[::stride, ::stride], np.float32)
        depth = np.where((depth > 0) & (depth <= MAX_DISTANCE), depth, np.float32(0.0))  # NaN is missing
    view = _View(arrays, camera, T_world_camera, sampling, device)
    view.find_free_space(LOOK_STRIDE * stride)
    if depth is None:
        depth = view.render(None, stride).depth
    return view.render(depth, stride)


class _View:
    """What the passes of a picture share."""

    def __init__(
        self,
        arrays: FieldArrays,
        camera: Intrinsics,
        T_world_camera: np.ndarray,
        sampling: SamplingConfig,
        device: wp.Device,
    ) -> None:
        self.arrays, self.camera, self.sampling, self.device = arrays, camera, sampling, device
        self._pose = wp.array(vector_from_pose(T_world_camera)[None].astype(np.float32), dtype=float, device=device)
        self._free_space: Looks | None = None

    def find_free_space(self, stride: int) -> None:
        """Look along the rays of every ``stride``-th pixel for cells of the fine level where nothing is."""
        if self.sampling.min_occupancy == 0:
            return
        cells = self.arrays.features["fine"].shape[0]
        looked, occupied = (wp.zeros(cells, dtype=wp.uint8, device=self.device) for _ in range(2))
        looks = struct(Looks, looked=looked, occupied=occupied)
        limit = float(np.log(self.sampling.min_occupancy / (1 - self.sampling.min_occupancy)) / 10)
        batch = self._batch(stride, FIRST_PASS_SAMPLES)
        for _ in self._chunks(batch, stride, None):
            batch.place_samples(FIRST_PASS_SAMPLES, 0, use_depth=False)
            query(batch, self.arrays, "fine")
            batch.look(self.arrays, limit, looks)
        self._free_space = looks

    def render(self, depth: np.ndarray | None, stride: int) -> RenderedImage:
        """One pass; samples are placed around a ``depth`` if it is given, of every ``stride``-th pixel [m]."""
        sampling, guided = self.sampling, depth is not None
        stratified = sampling.stratified if guided else FIRST_PASS_SAMPLES
        thresholds = Thresholds(sampling.min_weight, 0.0, sampling.min_transmittance)
        batch = self._batch(stride, max(stratified, sampling.stratified + sampling.surface))
        width, height = -(-self.camera.width // stride), -(-self.camera.height // stride)
        out = RenderedImage(*(np.zeros((height, width, *c), np.float32) for c in ((), (3,), ())))
        for first, count in self._chunks(batch, stride, depth):
            batch.place_samples(stratified, sampling.surface, use_depth=guided)
            if self._free_space is not None:
                batch.leave_out_free(self.arrays, self._free_space)
            render(batch, self.arrays, "color" if guided else "fine", thresholds=thresholds)
            if not guided:
                # A mean between two surfaces would send the second pass's samples to where nothing is.
                take_surface_depth(batch, FIRST_PASS_OCCUPANCY)
            for image, array in ((out.depth, batch.depth), (out.rgb, batch.rgb), (out.variance, batch.variance)):
                image[first : first + count] = array.numpy()[: batch.count].reshape(count, width, *image.shape[2:])
        np.clip(out.rgb, 0.0, 1.0, out=out.rgb)
        return out

    def _batch(self, stride: int, samples: int) -> RayBatch:
        width, height = -(-self.camera.width // stride), -(-self.camera.height // stride)
        return RayBatch(min(height, max(1, RAYS_PER_CHUNK // width)) * width, samples, self.device)

    def _chunks(self, batch: RayBatch, stride: int, depth: np.ndarray | None) -> Iterator[tuple[int, int]]:
        """First row and number of rows of each part of a picture, whose rays are then in the batch."""
        camera, width = self.camera, -(-self.camera.width // stride)
        height = -(-camera.height // stride)
        rows = batch.capacity // width
        for first in range(0, height, rows):
            count = min(rows, height - first)
            batch.set_pixels(first, count, camera, stride)
            batch.cast(self._pose)
            if depth is not None:
                batch.measured_depth[: batch.count].assign(depth[first : first + count].reshape(-1))
            batch.bound(self.arrays, use_depth=depth is not None)
            yield first, count
