"""Features of a frame: ORB corners (Rublee et al., ICCV 2011) spread over the image, with the depth beneath them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache
from operator import attrgetter
from typing import Any

import cv2
import numpy as np

from warpslam.camera import Intrinsics
from warpslam.tracking.features.settings import FeatureSettings

DEPTH_STRIDE = 4
"""`FeatureFrame.thin_depth` keeps every so many rows and columns."""
STEP = (0.02, 0.03)
"""Depth steps where a 3x3 neighbourhood spans more than this [m] and this share of its median."""
MAX_FEATURES = 2**16 - 1


@dataclass(frozen=True, eq=False)
class FeatureFrame:
    """Features of one frame, n of them, ordered by cell of the image, row by row."""

    pixels: np.ndarray
    """Column and row in the image [px], float32 (n, 2)."""
    octaves: np.ndarray
    """Level of the pyramid, int32 (n,)."""
    descriptors: np.ndarray
    """256 bits each, uint8 (n, 32)."""
    depth: np.ndarray
    """z-depth [m], float32 (n,), 0 = missing."""
    on_edge: np.ndarray
    """Whether depth steps beside the feature, bool (n,)."""
    points: np.ndarray
    """In camera axes at the time of the image's middle row [m], float32 (n, 3); zeros where depth is missing."""
    starts: np.ndarray
    """First feature of each cell, and n at the end; int32 (rows * columns + 1,)."""
    thin_depth: np.ndarray
    """z-depth [m], float32, every `DEPTH_STRIDE`-th row and column."""
    row_times: np.ndarray
    """When a feature's row was seen, against the middle row [s], float32 (n,)."""
    twist: np.ndarray = field(default_factory=lambda: np.zeros(6))
    """Of the camera in its own axes (translation [m/s], rotation [rad/s]), float64 (6,); see `retimed`."""

    def __len__(self) -> int:
        return len(self.pixels)


@dataclass(frozen=True)
class SensorTiming:
    """When a camera sees what it delivers as one frame."""

    depth_delay: float = 0.0
    """Time of the depth image less that of the colour image [s]."""
    readout: float = 0.0
    """From the first row to the last, of both images [s]."""


def detect(
    grey: np.ndarray, depth: np.ndarray, camera: Intrinsics, settings: FeatureSettings | None = None
) -> FeatureFrame:
    """Features of a frame; the same images give the same features.

    Args:
        grey: uint8 (H, W), without lens distortion.
        depth: z-depth [m], float32 (H, W), 0 = missing.
        camera: Of both images.
        settings: Constants.
    """
    settings = settings or FeatureSettings()
    scale = 0.5 if camera.width >= settings.halved_from else 1.0
    image = grey if scale == 1.0 else cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    orb = _detector(settings)
    corners = orb.detect(image, None)
    positions = _pixels(corners, scale, settings)
    strength = np.fromiter(map(attrgetter("response"), corners), np.float32, len(corners))
    cell, _ = _cells(positions, camera, settings)
    order = np.lexsort((-strength, cell))
    rank = np.arange(len(order)) - np.searchsorted(cell[order], cell[order], side="left")
    chosen = order[rank < settings.per_cell][:MAX_FEATURES]
    # ORB describes octave by octave, and would change the order.
    chosen = chosen[np.lexsort((chosen, _octaves(corners)[chosen]))]
    corners, descriptors = orb.compute(image, [corners[i] for i in chosen])
    if descriptors is None:
        descriptors = np.zeros((0, 32), np.uint8)
    octaves = _octaves(corners)
    pixels = _pixels(corners, scale, settings)
    cell, count = _cells(pixels, camera, settings)
    order = np.argsort(cell, kind="stable")
    pixels = pixels[order]
    measured, on_edge = depth_at(depth, pixels, settings.max_depth)
    return FeatureFrame(
        pixels=pixels,
        octaves=octaves[order],
        descriptors=np.ascontiguousarray(descriptors[order]),
        depth=measured,
        on_edge=on_edge,
        points=_points(pixels, measured, camera),
        starts=np.searchsorted(cell[order], np.arange(count + 1)).astype(np.int32),
        thin_depth=np.ascontiguousarray(depth[::DEPTH_STRIDE, ::DEPTH_STRIDE]),
        row_times=np.zeros(len(pixels), np.float32),
    )


def retimed(
    frame: FeatureFrame,
    depth: np.ndarray,
    camera: Intrinsics,
    settings: FeatureSettings,
    timing: SensorTiming,
    twist: np.ndarray,
) -> FeatureFrame:
    """The frame with the depth beneath its features as it was when their rows of the colour image were seen.

    With u the camera's twist, a point moves by -dt (u_v + u_w x X) in camera axes within dt: depth is read where the
    feature is at the time of the depth image, and carried back from there. Points are then those of the middle row.

    Args:
        frame: As `detect` returns it.
        depth: Depth image of the frame [m], float32 (H, W).
        camera: Of both images.
        settings: Constants.
        timing: Of the sensor.
        twist: u, (6,): translation [m/s] and rotation [rad/s] in camera axes.
    """
    twist = np.asarray(twist, dtype=np.float64)

    def velocity(points: np.ndarray) -> np.ndarray:
        return -(twist[:3] + np.cross(twist[3:], points))

    columns, rows = frame.pixels[:, 0].astype(np.float64), frame.pixels[:, 1].astype(np.float64)
    row_times = (rows / camera.height - 0.5) * timing.readout
    known = frame.depth > 0
    later = camera.backproject(columns, rows, np.where(known, frame.depth, 1.0).astype(np.float64))
    later = later + timing.depth_delay * velocity(later)
    looked_up = np.column_stack(camera.project(*later.T)).astype(np.float32)
    measured, on_edge = depth_at(depth, np.where(known[:, None], looked_up, frame.pixels), settings.max_depth)
    at_depth = camera.backproject(looked_up[:, 0].astype(float), looked_up[:, 1].astype(float), measured.astype(float))
    z = (at_depth - timing.depth_delay * velocity(at_depth))[:, 2]
    z = np.where(known & (measured > 0), z, 0.0)
    points = camera.backproject(columns, rows, z)
    points = np.where(z[:, None] > 0, points - row_times[:, None] * velocity(points), 0.0)
    return replace(
        frame,
        depth=z.astype(np.float32),
        on_edge=on_edge,
        points=points.astype(np.float32),
        row_times=row_times.astype(np.float32),
        twist=twist,
    )


def depth_at(depth: np.ndarray, pixels: np.ndarray, max_depth: float) -> tuple[np.ndarray, np.ndarray]:
    """Depth beneath pixels, and where it steps.

    Args:
        depth: z-depth [m], float32 (H, W), 0 = missing.
        pixels: Columns and rows, (n, 2); those outside have no depth.
        max_depth: Larger depth counts as missing [m].

    Returns:
        float32 (n,) [m]: that of the nearest pixel, else the median of its neighbours, 0 = missing; bool (n,).
    """
    if len(pixels) == 0:
        return np.zeros(0, np.float32), np.zeros(0, bool)
    height, width = depth.shape
    u, v = np.floor(pixels + 0.5).astype(np.int64).T
    dv, du = np.mgrid[-1:2, -1:2].reshape(2, 9, 1)
    x, y = u + du, v + dv
    inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
    near = np.where(inside, depth[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)], np.float32(0.0))
    center = near[4]
    count = (near > 0).sum(axis=0)
    ascending = np.sort(np.where(near > 0, near, np.float32(np.inf)), axis=0)
    each = np.arange(len(pixels))
    median = ascending[count // 2 * (count > 0), each]
    with np.errstate(invalid="ignore"):
        on_edge = ascending[np.maximum(count - 1, 0), each] - ascending[0] > STEP[0] + STEP[1] * median
    found = np.where(center > 0, center, np.where(count > 0, median, np.float32(0.0)))
    found[found > max_depth] = 0.0
    return found.astype(np.float32), on_edge & (found > 0)


@lru_cache(maxsize=8)
def _detector(settings: FeatureSettings) -> Any:
    return cv2.ORB.create(
        settings.detected,
        settings.octave_factor,
        settings.octaves,
        edgeThreshold=settings.edge,
        fastThreshold=settings.fast_threshold,
    )


def _octaves(corners: Any) -> np.ndarray:
    return np.fromiter(map(attrgetter("octave"), corners), np.int32, len(corners))


def _pixels(corners: Any, scale: float, settings: FeatureSettings) -> np.ndarray:
    """Positions in the image as it came in.

    Pixel centres are at whole numbers in every image. OpenCV only multiplies a position in a level by the level's
    scale s, which leaves it (s - 1) / 2 too far to the left and top.
    """
    positions = np.asarray(cv2.KeyPoint.convert(corners), dtype=np.float32).reshape(-1, 2)
    positions = positions + 0.5 * (settings.scales[_octaves(corners)][:, None] - 1.0)
    return ((positions + 0.5) / scale - 0.5).astype(np.float32)


def cell_layout(camera: Intrinsics, settings: FeatureSettings) -> tuple[int, int]:
    """Columns and rows of cells."""
    return -(-camera.width // settings.cell), -(-camera.height // settings.cell)


def _cells(pixels: np.ndarray, camera: Intrinsics, settings: FeatureSettings) -> tuple[np.ndarray, int]:
    """Cell of each pixel, and how many cells there are."""
    columns, rows = cell_layout(camera, settings)
    x = np.clip(pixels[:, 0] // settings.cell, 0, columns - 1).astype(np.int64)
    y = np.clip(pixels[:, 1] // settings.cell, 0, rows - 1).astype(np.int64)
    return y * columns + x, columns * rows


def _points(pixels: np.ndarray, depth: np.ndarray, camera: Intrinsics) -> np.ndarray:
    return camera.backproject(pixels[:, 0], pixels[:, 1], depth).astype(np.float32)
