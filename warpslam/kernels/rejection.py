"""Rays that are left out although the map's bound keeps them (ours, not the paper's)."""

import warp as wp

from warpslam.kernels.grid import Lattice, find_cell, row_of
from warpslam.kernels.pixels import MODULE, Camera, Images, measured, nearest_pixel
from warpslam.kernels.samples import Rays

MAX_STEPS = wp.constant(1 << 16)
"""Places at which a ray is looked at, at most."""


@wp.func
def least_and_largest_depth(images: Images, slot: int, pixel: wp.vec2i) -> wp.vec2:
    """Of a pixel and its eight neighbours; (0, 0) if one of them is missing or outside."""
    least = float(1.0e30)
    largest = float(0.0)
    for dv in range(-1, 2):
        for du in range(-1, 2):
            x = pixel[0] + du
            y = pixel[1] + dv
            if x < 0 or x >= images.depth.shape[2] or y < 0 or y >= images.depth.shape[1]:
                return wp.vec2(0.0, 0.0)
            depth = measured(images, slot, x, y)
            if depth <= 0.0:
                return wp.vec2(0.0, 0.0)
            least = wp.min(least, depth)
            largest = wp.max(largest, depth)
    return wp.vec2(least, largest)


@wp.func
def is_seen(lattice: Lattice, seen: wp.array[wp.uint8], p: wp.vec3) -> bool:
    """Whether a mapped frame has seen all vertices of the cell in which a point lies."""
    corner = find_cell(lattice, p).corner
    result = bool(True)
    for di in range(2):
        for dj in range(2):
            for dk in range(2):
                if seen[row_of(lattice, corner[0] + di, corner[1] + dj, corner[2] + dk)] == wp.uint8(0):
                    result = False
    return result


@wp.kernel(module=MODULE, enable_backward=False)
def drop_unseen(lattice: Lattice, seen: wp.array[wp.uint8], rays: Rays, depth: wp.array[float], keep: wp.array[int]):
    """Leave out rays that end in a cell with a vertex that no mapped frame has seen."""
    tid = wp.tid()
    if keep[tid] == 0 or depth[tid] <= 0.0:
        return
    if not is_seen(lattice, seen, rays.origin[tid] + depth[tid] * rays.direction[tid]):
        keep[tid] = 0


@wp.kernel(module=MODULE, enable_backward=False)
def keep_unseen(lattice: Lattice, seen: wp.array[wp.uint8], rays: Rays, depth: wp.array[float], keep: wp.array[int]):
    """Keep those rays alone that `drop_unseen` leaves out."""
    tid = wp.tid()
    if keep[tid] != 0:
        if depth[tid] <= 0.0 or is_seen(lattice, seen, rays.origin[tid] + depth[tid] * rays.direction[tid]):
            keep[tid] = 0


@wp.kernel(module=MODULE, enable_backward=False)
def drop_contradicted(
    current: int,
    margin: float,
    T_camera_world: wp.mat44,
    camera: Camera,
    images: Images,
    frame: wp.array[int],
    rays: Rays,
    depth: wp.array[float],
    keep: wp.array[int],
):
    """Leave out the rays of earlier frames, those before ``current`` in the window, that the current depth image, in
    slot 0, contradicts by ``margin``: it sees through the point they measured, or measures a surface that they pass
    through.

    A ray is looked at every half ``margin``. A pixel speaks only where its neighbours agree, so that outlines, where a
    little shift of the camera changes everything, contradict nothing.
    """
    tid = wp.tid()
    if keep[tid] == 0 or frame[tid] >= current or depth[tid] <= 0.0:
        return
    count = wp.clamp(int(depth[tid] / (0.5 * margin)), 0, MAX_STEPS) + 1
    for n in range(count):
        # The last one is the point that was measured.
        z = depth[tid] * float(n + 1) / float(count)
        q = wp.transform_point(T_camera_world, rays.origin[tid] + z * rays.direction[tid])
        if q[2] > 0.0:
            seen = least_and_largest_depth(images, 0, nearest_pixel(q, camera))
            sees_through = n + 1 == count and q[2] < seen[0] - margin
            is_behind = q[2] > seen[1] + 0.5 * margin and q[2] < seen[0] + 1.5 * margin
            if seen[0] > 0.0 and (sees_through or (z < depth[tid] - margin and is_behind)):
                keep[tid] = 0
                return
