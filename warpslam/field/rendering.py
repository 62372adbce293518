"""Whole images of the map: depth, colour and variance (Eq. 6-7)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from warpslam.camera import Intrinsics
from warpslam.config import SamplingConfig
from warpslam.errors import InputError
from warpslam.field.arrays import FieldArrays, Thresholds
from warpslam.field.passes import render, take_surface_depth
from warpslam.field.ray_batch import RayBatch
from warpslam.poses import MAX_DISTANCE, as_numbers, vector_from_pose
from warpslam.runtime.phases import phase

RAYS_PER_CHUNK = 8192
FIRST_PASS_SAMPLES = 128
FIRST_PASS_OCCUPANCY = 0.3


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
    Samples that do not count are left out as in mapping (`SamplingConfig`).
    """
    if (
        not isinstance(stride, int | np.integer)
        or isinstance(stride, bool)
        or not 1 <= stride <= max(camera.width, camera.height)
    ):
        raise InputError(f"stride = {stride!r} must be a whole number from 1 to the size of the image")
    stride = int(stride)
    if depth is None:
        coarse = _render(arrays, camera, T_world_camera, sampling, device, None, stride)
        depth = coarse.depth
    else:
        depth = as_numbers(depth, "depth")
        if depth.shape != (camera.height, camera.width):
            raise InputError(f"depth has shape {depth.shape}, expected {(camera.height, camera.width)}")
        depth = np.ascontiguousarray(depth[::stride, ::stride], np.float32)
        depth = np.where((depth > 0) & (depth <= MAX_DISTANCE), depth, np.float32(0.0))  # NaN is missing
    return _render(arrays, camera, T_world_camera, sampling, device, depth, stride)


def _render(
    arrays: FieldArrays,
    camera: Intrinsics,
    T_world_camera: np.ndarray,
    sampling: SamplingConfig,
    device: wp.Device,
    depth: np.ndarray | None,
    stride: int,
) -> RenderedImage:
    width = -(-camera.width // stride)
    height = -(-camera.height // stride)
    rows = min(height, max(1, RAYS_PER_CHUNK // width))
    guided = depth is not None
    stratified = sampling.stratified if guided else FIRST_PASS_SAMPLES
    batch = RayBatch(rows * width, max(stratified, sampling.stratified + sampling.surface), device)
    thresholds = Thresholds(sampling.min_weight, 0.0, sampling.min_transmittance)
    pose = wp.array(vector_from_pose(T_world_camera)[None].astype(np.float32), dtype=float, device=device)
    out = RenderedImage(*(np.zeros((height, width, *c), np.float32) for c in ((), (3,), ())))
    for first in range(0, height, rows):
        count = min(rows, height - first)
        batch.set_pixels(first, count, camera, stride)
        batch.cast(pose)
        if depth is not None:
            batch.measured_depth[: batch.count].assign(depth[first : first + count].reshape(-1))
        batch.bound(arrays, use_depth=guided)
        batch.place_samples(stratified, sampling.surface, use_depth=guided)
        render(batch, arrays, "color" if guided else "fine", thresholds=thresholds)
        if not guided:
            # A mean between two surfaces would send the second pass's samples to where nothing is.
            take_surface_depth(batch, FIRST_PASS_OCCUPANCY)
        for image, array in ((out.depth, batch.depth), (out.rgb, batch.rgb), (out.variance, batch.variance)):
            image[first : first + count] = array.numpy()[: batch.count].reshape(count, width, *image.shape[2:])
    np.clip(out.rgb, 0.0, 1.0, out=out.rgb)
    return out
