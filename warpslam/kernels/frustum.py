"""Frustum feature selection (A.1, Sec. 3.3): which vertices of a grid the current frame may change.

A vertex is selected if it projects inside the image and lies in front of the camera, no deeper than 0.5 m behind the
measured surface (bilinear depth at its pixel; the largest looked-up depth where there is none), or if it is within
0.5 m of the camera centre.
"""

import warp as wp

from warpslam.kernels.grid import Lattice, row_position
from warpslam.kernels.pixels import Camera, place_of

MODULE = "warpslam.views"
"""What a depth image says of vertices and points compiles as one Warp module."""


@wp.func
def bilinear_depth(image: wp.array2d[float], u: float, v: float) -> float:
    """Bilinear lookup, 0 outside the image."""
    height = image.shape[0]
    width = image.shape[1]
    u0 = place_of(wp.floor(u))
    v0 = place_of(wp.floor(v))
    fu = u - float(u0)
    fv = v - float(v0)
    total = float(0.0)
    for dv in range(2):
        for du in range(2):
            x = u0 + du
            y = v0 + dv
            if x >= 0 and x < width and y >= 0 and y < height:
                total += wp.where(du == 1, fu, 1.0 - fu) * wp.where(dv == 1, fv, 1.0 - fv) * image[y, x]
    return total


@wp.kernel(module=MODULE, enable_backward=False)
def project_vertices(
    lattice: Lattice,
    T_camera_world: wp.mat44,
    camera: Camera,
    image: wp.array2d[float],
    looked_up: wp.array[float],
    vertex_depth: wp.array[float],
    max_depth: wp.array[float],
):
    """First pass: depth of the vertex (-1 where it projects outside the image) and measured depth at its pixel."""
    row = lattice.shared + wp.tid()
    p = row_position(lattice, row)
    q = wp.transform_point(T_camera_world, p)
    # The released code divides by (z - 1e-5) with its camera looking along -z.
    depth = q[2] - 1.0e-5
    u = camera.focal[0] * q[0] / depth + camera.center[0]
    v = camera.focal[1] * q[1] / depth + camera.center[1]
    measured = bilinear_depth(image, u, v)
    wp.atomic_max(max_depth, 0, measured)
    inside = u > 0.0 and u < float(image.shape[1]) and v > 0.0 and v < float(image.shape[0]) and depth >= 0.0
    vertex_depth[row] = wp.where(inside, depth, -1.0)
    looked_up[row] = measured


@wp.kernel(module=MODULE, enable_backward=False)
def select_vertices(
    lattice: Lattice,
    camera_center: wp.vec3,
    margin: float,
    looked_up: wp.array[float],
    vertex_depth: wp.array[float],
    max_depth: wp.array[float],
    selected: wp.array[wp.uint8],
):
    row = lattice.shared + wp.tid()
    p = row_position(lattice, row)
    measured = looked_up[row]
    if measured == 0.0:
        measured = max_depth[0]
    depth = vertex_depth[row]
    chosen = (depth >= 0.0 and depth <= measured + margin) or wp.length(p - camera_center) < margin
    selected[row] = wp.where(chosen, wp.uint8(1), wp.uint8(0))
