"""Frustum feature selection (A.1, Sec. 3.3): which vertices of a grid the current frame may change.

`mark_seen` and `start_from_depth` are ours: see `RayBatch.drop_unseen` and `warpslam.mapping.depth_start`.

A vertex is selected if it projects inside the image and lies in front of the camera, no deeper than 0.5 m behind the
measured surface
(bilinear depth at its pixel; the largest looked-up depth where there is none), or if it is within 0.5 m of the camera
centre.
"""

import warp as wp

from warpslam.kernels.grid import Lattice, Vec32, row_of, vertex_position
from warpslam.kernels.rays import nearest_pixel


@wp.func
def bilinear_depth(image: wp.array2d[float], u: float, v: float) -> float:
    """Bilinear lookup, 0 outside the image."""
    height = image.shape[0]
    width = image.shape[1]
    u0 = int(wp.floor(u))
    v0 = int(wp.floor(v))
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


@wp.kernel(enable_backward=False)
def project_vertices(
    lattice: Lattice,
    T_camera_world: wp.mat44,
    focal: wp.vec2,
    center: wp.vec2,
    image: wp.array2d[float],
    looked_up: wp.array[float],
    vertex_depth: wp.array[float],
    max_depth: wp.array[float],
):
    """First pass: depth of the vertex (-1 where it projects outside the image) and measured depth at its pixel."""
    i, j, k = wp.tid()
    row = row_of(lattice, i, j, k)
    p = vertex_position(lattice, i, j, k)
    q = wp.transform_point(T_camera_world, p)
    # The released code divides by (z - 1e-5) with its camera looking along -z.
    depth = q[2] - 1.0e-5
    u = focal[0] * q[0] / depth + center[0]
    v = focal[1] * q[1] / depth + center[1]
    measured = bilinear_depth(image, u, v)
    wp.atomic_max(max_depth, 0, measured)
    inside = u > 0.0 and u < float(image.shape[1]) and v > 0.0 and v < float(image.shape[0]) and depth >= 0.0
    vertex_depth[row] = wp.where(inside, depth, -1.0)
    looked_up[row] = measured


@wp.kernel(enable_backward=False)
def select_vertices(
    lattice: Lattice,
    camera_center: wp.vec3,
    margin: float,
    looked_up: wp.array[float],
    vertex_depth: wp.array[float],
    max_depth: wp.array[float],
    selected: wp.array[wp.uint8],
):
    i, j, k = wp.tid()
    row = row_of(lattice, i, j, k)
    p = vertex_position(lattice, i, j, k)
    measured = looked_up[row]
    if measured == 0.0:
        measured = max_depth[0]
    depth = vertex_depth[row]
    chosen = (depth >= 0.0 and depth <= measured + margin) or wp.length(p - camera_center) < margin
    selected[row] = wp.where(chosen, wp.uint8(1), wp.uint8(0))


@wp.func
def behind_surface(
    p: wp.vec3, T_camera_world: wp.mat44, focal: wp.vec2, center: wp.vec2, image: wp.array2d[float]
) -> float:
    """How far a point lies behind the surface that its nearest pixel measures [m]; infinite where none does.

    The nearest pixel: a mean over an outline is the depth of nothing.
    """
    q = wp.transform_point(T_camera_world, p)
    if q[2] <= 0.0:
        return wp.inf
    pixel = nearest_pixel(q, focal, center)
    u = pixel[0]
    v = pixel[1]
    if u < 0 or u >= image.shape[1] or v < 0 or v >= image.shape[0]:
        return wp.inf
    measured = image[v, u]
    if measured <= 0.0:
        return wp.inf
    return q[2] - measured


@wp.kernel(enable_backward=False)
def mark_seen(
    lattice: Lattice,
    T_camera_world: wp.mat44,
    focal: wp.vec2,
    center: wp.vec2,
    image: wp.array2d[float],
    reach: float,
    seen: wp.array[wp.uint8],
):
    """Vertices in view that lie in front of the measured surface or less than ``reach`` behind it."""
    i, j, k = wp.tid()
    if behind_surface(vertex_position(lattice, i, j, k), T_camera_world, focal, center, image) <= reach:
        seen[row_of(lattice, i, j, k)] = wp.uint8(1)


@wp.kernel(enable_backward=False)
def start_from_depth(
    lattice: Lattice,
    T_camera_world: wp.mat44,
    focal: wp.vec2,
    center: wp.vec2,
    image: wp.array2d[float],
    selected: wp.array[wp.uint8],
    base: Vec32,
    slope: Vec32,
    truncation: float,
    reach: float,
    seen: wp.array[wp.uint8],
    features: wp.array[Vec32],
):
    """Vertices seen for the first time. Once started, a vertex is the optimiser's."""
    i, j, k = wp.tid()
    row = row_of(lattice, i, j, k)
    if selected[row] == wp.uint8(0) or seen[row] != wp.uint8(0):
        return
    distance = behind_surface(vertex_position(lattice, i, j, k), T_camera_world, focal, center, image)
    if distance > reach:
        return
    seen[row] = wp.uint8(1)
    features[row] = base + wp.clamp(distance, -truncation, truncation) * slope
