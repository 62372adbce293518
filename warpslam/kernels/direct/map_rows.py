"""Points of a frame against the surface of the map, as rows of the normal equations of its pose.

A point p of the frame lies at x = T_world_frame p, where the map's logit l is 0 on the surface and grows into it:

    e = l(x) / |grad l(x)|     signed distance behind the surface [m]
    J = [-n, -(p x n)] / s(z),   n = grad l / |grad l| in the frame's axes,   s(z) as for depth

for T_frame_world <- exp(xi) T_frame_world. Only where the surface is sharp: |grad l| above a least slope.
"""

import warp as wp

from warpslam.kernels.compositing import Listed, count_index, is_inside
from warpslam.kernels.direct.equations import (
    BINS,
    DEPTH_BIN,
    Triangle,
    Vec8,
    Vec16,
    add_outer,
    depth_sigma,
    group_sum_counts,
    group_sum_triangle,
    group_sum_vector,
    group_wait,
    inverted,
    median_of,
    student,
    whole,
)
from warpslam.kernels.direct.images import MODULE
from warpslam.kernels.direct.points import Points
from warpslam.kernels.direct.registration import OtherRows, Result
from warpslam.kernels.grid import Lattice, find_cell, row_of

MAX_DISTANCE = wp.constant(0.1)
"""Points further from the surface say nothing of it [m]."""
MIN_POINTS = wp.constant(100.0)
"""Fewer are not enough to believe the map."""

_BINS = wp.constant(BINS)
_DEPTH_BIN = wp.constant(DEPTH_BIN)


@wp.func
def is_seen(lattice: Lattice, seen: wp.array[wp.uint8], x: wp.vec3) -> bool:
    """Whether mapped frames have seen all of a point's cell."""
    corner = find_cell(lattice, x).corner
    count = int(0)
    for di in range(2):
        for dj in range(2):
            for dk in range(2):
                count += int(seen[row_of(lattice, corner[0] + di, corner[1] + dj, corner[2] + dk)])
    return count == 8


@wp.kernel(module=MODULE, enable_backward=False)
def place_points(
    points: Points,
    keyframe: int,
    first: int,
    pose: wp.array[Result],
    T_world_reference: wp.mat44,
    low: wp.vec3,
    high: wp.vec3,
    lattice: Lattice,
    seen: wp.array[wp.uint8],
    origin: wp.array[wp.vec3],
    keep: wp.array[int],
    logit_grad: wp.array[float],
    point_grad: wp.array[wp.vec3],
):
    """Points with a normal in the world's axes; those inside the bound, in cells that mapped frames have seen, are kept
    and their logits get a gradient of 1.
    """
    k = wp.tid()
    X = points.position[keyframe, first + k]
    n = points.normal[keyframe, first + k]
    x = wp.transform_point(T_world_reference * inverted(pose[0].T), X)
    kept = int(0)
    if X[2] > 0.0 and wp.dot(n, n) > 0.5 and is_inside(x, low, high):
        if is_seen(lattice, seen, x):
            kept = 1
    else:
        x = 0.5 * (low + high)
    origin[k] = x
    keep[k] = kept
    logit_grad[k] = float(kept)
    point_grad[k] = wp.vec3()


@wp.kernel(module=MODULE, enable_backward=False)
def list_all(listed: Listed, count: int):
    """Put all points of a slice on its list; those that are not kept have no gradient."""
    i = wp.tid()
    if i == 0:
        listed.counts[count_index(listed.slot)] = count
    listed.samples[listed.start + i] = listed.start + i


@wp.kernel(module=MODULE, enable_backward=False)
def sum_map_rows(
    points: Points,
    keyframe: int,
    first: int,
    count: int,
    pose: wp.array[Result],
    T_world_reference: wp.mat44,
    keep: wp.array[int],
    logit: wp.array[float],
    point_grad: wp.array[wp.vec3],
    least_slope: float,
    least_scale: float,
    weight: float,
    lanes: int,
    histograms: wp.array2d[int],
    rows: wp.array[OtherRows],
    at: int,
):
    """Normal equations of all points, weighted as a t-distribution by their own scale; ``lanes`` threads."""
    lane = wp.tid()
    bins = histograms[0]
    T = pose[0].T
    T_frame_world = T * inverted(T_world_reference)
    counts = Vec16()
    for k in range(lane, 2 * _BINS, lanes):
        bins[k] = 0
    group_wait()
    for k in range(lane, count, lanes):
        slope = wp.length(point_grad[k])
        if keep[k] != 0 and slope > least_slope and wp.abs(logit[k]) < MAX_DISTANCE * slope:
            counts[0] += 1.0
            r = logit[k] / slope / depth_sigma(points.position[keyframe, first + k][2])
            wp.atomic_add(bins, _BINS + wp.min(int(wp.abs(r) / _DEPTH_BIN), _BINS - 1), 1)
    group_wait()
    counts = group_sum_counts(counts)
    scale = wp.max(least_scale, 1.4826 * median_of(bins, _BINS, _DEPTH_BIN, counts[0]))
    H = Triangle()
    g = Vec8()
    if counts[0] >= MIN_POINTS:
        for k in range(lane, count, lanes):
            slope = wp.length(point_grad[k])
            if keep[k] != 0 and slope > least_slope and wp.abs(logit[k]) < MAX_DISTANCE * slope:
                p = points.position[keyframe, first + k]
                s = depth_sigma(p[2])
                r = logit[k] / slope / s
                n = wp.transform_vector(T_frame_world, point_grad[k]) / slope
                turn = wp.cross(p, n)
                J = Vec8(-n[0], -n[1], -n[2], -turn[0], -turn[1], -turn[2], 0.0, 0.0) / s
                w = weight * student(r / scale) / (scale * scale)
                H = add_outer(H, J, w)
                g += (w * r) * J
    A = whole(group_sum_triangle(H))
    b = group_sum_vector(g)
    out = OtherRows()
    out.T = T
    for i in range(6):
        out.g[i] = b[i]
        for j in range(6):
            out.H[i, j] = A[i, j]
    if lane == 0:
        rows[at] = out
