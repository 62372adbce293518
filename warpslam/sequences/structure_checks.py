"""What the images show of themselves: whether edges of depth lie on edges of colour, whether depth is along the ray,
and whether there is anything to see in every direction.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from warpslam.sequences.base import Frame, RgbdSequence
from warpslam.sequences.findings import WARNING, Finding
from warpslam.sequences.images import ImageSequence
from warpslam.sequences.pose_checks import along_ray_remedy
from warpslam.sequences.registration import ray_lengths
from warpslam.spread import spread

_STEP = 0.06  # relative step of depth from pixel to pixel that is an edge
_MIN_EDGES = 400  # pixels, over all frames
_EDGES_KEPT, _FRAMES_KEPT = 1000, 8
_SCALES = np.round(np.arange(0.64, 1.57, 0.04), 2)
_SHIFTS = np.array([-0.06, -0.03, 0.0, 0.03, 0.06])  # of the width
_NEAR_SCALE, _NEAR_SHIFT = 0.045, 0.035  # of the right one: no more is seen at edges that are a few pixels wide
_BETTER, _MEANINGFUL = 1.25, 1.4  # contrast at the edges against that where they are, and against that of the image
_MIN_PLANES = 5  # patches in which a plane was found
_FLAT = 0.003  # relative residual of depth that lies in a plane
_PLANE_SHARE = 0.95
_DULL = 2.0  # grey values a pixel of the direction that shows least


def check_registration(frames: Sequence[Frame]) -> Iterator[Finding]:
    """Whether the edges of depth would lie on edges of colour if images were scaled or shifted: they are of two
    cameras, and depth was not registered.
    """
    few = [frames[i] for i in spread(len(frames), min(len(frames), _FRAMES_KEPT))]
    views = [view for frame in few if (view := _edges(frame)) is not None]
    if sum(len(u) for u, _, _ in views) < _MIN_EDGES or len(views) < 2:
        return
    points = _EdgePoints.of(views)
    here = points.mean(1.0, 0.0, 0.0)
    candidates = {(s, x, y): points.mean(s, x, y) for s, x, y in product(_SCALES, _SHIFTS, _SHIFTS)}
    (scale, x, y), best = max(candidates.items(), key=lambda item: item[1])
    is_near = abs(scale - 1) < _NEAR_SCALE and max(abs(x), abs(y)) < _NEAR_SHIFT
    if is_near or best < _MEANINGFUL or best < _BETTER * here:
        return
    # Chance finds another place for each half of the frames.
    halves = (_EdgePoints.of(half) for half in (views[::2], views[1::2]))
    if any(half.mean(scale, x, y) < _BETTER * half.mean(1.0, 0.0, 0.0) for half in halves):
        return
    width = frames[0].rgb.shape[1]
    text = f"edges of depth do not lie on edges of colour; they would with colour scaled by {1 / scale:.2f}"
    if max(abs(x), abs(y)) > 0:
        text += f" and shifted by {abs(x) * width:.0f}, {abs(y) * width:.0f} pixels"
    remedy = "record depth registered to colour, or give both cameras: color and T_color_depth in camera.yaml"
    yield Finding("registration", WARNING, f"{text}: depth is not registered to colour", remedy)


def check_structure(sequence: RgbdSequence, frames: Sequence[Frame]) -> Iterator[Finding]:
    """Whether depth is bent as depth along the ray is, and whether a wall without features fills the image."""
    camera = sequence.intrinsics
    rays = ray_lengths(camera)
    fits = [fit for frame in frames for fit in _plane_fits(frame.depth, rays)]
    if isinstance(sequence, ImageSequence) and len(fits) >= _MIN_PLANES:
        along_axis, along_ray = np.median(np.array(fits), axis=0)
        if along_ray < 0.3 * along_axis and along_axis > 1e-3:
            text = "planes come out bent, and would be flat if depth were the distance along the ray"
            yield Finding("depth along the ray", WARNING, text, along_ray_remedy(sequence))
    dull = [frame.index for frame in frames if _is_plane(frame.depth) and _least_texture(frame.rgb) < _DULL]
    if dull:
        named = ", ".join(map(str, dull[:3])) + (", ..." if len(dull) > 3 else "")
        text = f"{len(dull)} of the {len(frames)} frames looked at show a plain wall, which tells nothing about motion "
        text += f"along it: frame {named}"
        remedy = "keep something in view that sticks out or has a pattern; the pose drifts where nothing does"
        yield Finding("structure", WARNING, text, remedy)


def _edges(frame: Frame) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Columns and rows, from the middle in pixels, of the nearer side of steps in depth, and the contrast of the image
    (H, W), 1 on average; None where the image has none.
    """
    import cv2

    depth = frame.depth
    grey = cv2.GaussianBlur(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), 1.0)
    contrast = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1))
    contrast = np.minimum(contrast, np.percentile(contrast, 95))  # a few bright edges must not decide
    # Where colour sees nothing, as beside the view of another camera, there is no edge of the scene.
    unseen = (frame.rgb == 0).all(axis=2).astype(np.uint8)
    contrast[cv2.dilate(unseen, np.ones((7, 7), np.uint8)) > 0] = 0
    if contrast.mean() <= 0:
        return None
    edge = np.zeros(depth.shape, bool)
    for axis in (0, 1):
        a, b = (depth[:-1], depth[1:]) if axis == 0 else (depth[:, :-1], depth[:, 1:])
        step = (a > 0) & (b > 0) & (np.abs(a - b) > _STEP * np.minimum(a, b))
        near_a, near_b = step & (a < b), step & (a > b)
        if axis == 0:
            edge[:-1] |= near_a
            edge[1:] |= near_b
        else:
            edge[:, :-1] |= near_a
            edge[:, 1:] |= near_b
    v, u = np.nonzero(edge)
    chosen = spread(len(u), min(len(u), _EDGES_KEPT))
    v, u = v[chosen], u[chosen]
    height, width = depth.shape
    return u - (width - 1) / 2, v - (height - 1) / 2, contrast / contrast.mean()


@dataclass(frozen=True)
class _EdgePoints:
    """Edges of depth in several frames, and the contrast of colour there."""

    contrast: np.ndarray
    """(F, H, W), 1 on average."""
    frame: np.ndarray
    """Of each point, int (N,)."""
    u: np.ndarray
    """Columns from the middle [px], (N,)."""
    v: np.ndarray
    """Rows from the middle [px], (N,)."""

    @classmethod
    def of(cls, views: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> _EdgePoints:
        frame = np.concatenate([np.full(len(u), i) for i, (u, _, _) in enumerate(views)])
        u, v = (np.concatenate([view[k] for view in views]) for k in (0, 1))
        return cls(np.stack([contrast for _, _, contrast in views]), frame, u, v)

    def mean(self, scale: float, x: float, y: float) -> float:
        """Mean contrast of colour at the points, if they were scaled and shifted (by shares of the width)."""
        height, width = self.contrast.shape[1:]
        column = np.rint(scale * self.u + (x * width + (width - 1) / 2)).astype(np.int32)
        row = np.rint(scale * self.v + (y * width + (height - 1) / 2)).astype(np.int32)
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        found = self.contrast[self.frame[inside], row[inside], column[inside]]
        # Edges that leave the image prove nothing, but a transform that throws most out has not won.
        return float(found.sum()) / max(len(found), len(self.u) // 2, 1)


def _plane_fits(depth: np.ndarray, rays: np.ndarray) -> Iterator[tuple[float, float]]:
    """Relative residuals of planes in large patches, as depth along the axis and as along the ray, where one fits."""
    height, width = depth.shape
    size_v, size_u = height // 3, width // 3
    for top, left in product((0, height // 3, 2 * height // 3), (0, width // 3, 2 * width // 3)):
        patch = slice(top, top + size_v), slice(left, left + size_u)
        residuals = (_residual(depth[patch]), _residual(depth[patch] / rays[patch]))
        if min(residuals) < _FLAT:
            yield residuals


def _residual(depth: np.ndarray) -> float:
    """Median relative residual of a plane, whose inverse depth is linear in the pixels; infinite where depth is scarce
    or not one surface.
    """
    stride = max(1, int(np.sqrt(depth.size / 400)))
    v, u = np.nonzero(depth[::stride, ::stride] > 0)
    if len(u) < 0.9 * depth[::stride, ::stride].size or len(u) < 30:
        return np.inf
    inverse = 1 / depth[::stride, ::stride][v, u].astype(np.float64)
    A = np.column_stack([u, v, np.ones(len(u))])
    residual = np.abs(A @ np.linalg.lstsq(A, inverse, rcond=None)[0] - inverse) / inverse
    return float(np.median(residual)) if np.percentile(residual, 90) < 5 * _FLAT else np.inf


def _is_plane(depth: np.ndarray) -> bool:
    """Whether nearly all that is measured lies in one plane."""
    stride = max(1, int(np.sqrt(depth.size / 2000)))
    v, u = np.nonzero(depth[::stride, ::stride] > 0)
    if len(u) < 100:
        return False
    inverse = 1 / depth[::stride, ::stride][v, u].astype(np.float64)
    A = np.column_stack([u, v, np.ones(len(u))])
    keep = np.ones(len(u), bool)
    for _ in range(3):
        plane = np.linalg.lstsq(A[keep], inverse[keep], rcond=None)[0]
        residual = np.abs(A @ plane - inverse) / inverse
        keep = residual < max(5 * _FLAT, 2 * float(np.median(residual)))
    return bool(np.mean(residual < 5 * _FLAT) > _PLANE_SHARE)


def _least_texture(rgb: np.ndarray) -> float:
    """Root mean square of the derivative of grey values along the direction in which it is least [a pixel]."""
    import cv2

    grey = cv2.GaussianBlur(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), 1.5)
    gv, gu = np.gradient(grey)
    tensor = np.array([[np.mean(gu * gu), np.mean(gu * gv)], [np.mean(gu * gv), np.mean(gv * gv)]])
    return float(np.sqrt(max(np.linalg.eigvalsh(tensor)[0], 0.0)))
