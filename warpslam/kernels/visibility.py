"""What depth images are evidence of: which points they observe, and which they have in reach.

How a point p is judged in a view. Let it project to pixel (u, v) at z-depth Z. The inverse depth of a plane is affine
in (u, v), so four neighbouring depths of one surface give the plane a X + b Y + c Z = 1 (camera coordinates),
    a = fx dw/du,  b = fy dw/dv,  c = w(u, v) - a X/Z - b Y/Z,    w = 1 / depth, interpolated,
and the signed distance of p to it is s = (1 - Z w) / |(a, b, c)|, positive in front. At depth edges s = depth - Z with
the nearest pixel. Along z alone, a floor seen from far would lose the lattice layer below it: 10 cm of z can be 1 cm of
height. p is *observed* if s >= -behind in some view, and *near* a surface if |s| <= band in some view.
"""

import warp as wp

from warpslam.kernels.frustum import MODULE

NOT_SEEN = wp.constant(-1.0e30)
NEAREST_Z = 1.0e-3
# Neighbouring depths that differ by more than this share are two surfaces, not one slanted surface.
DEPTH_EDGE = wp.constant(0.1)

OBSERVED = wp.constant(1)
NEAR = wp.constant(2)


@wp.struct
class Views:
    """Views by number: pose, (fx, fy, cx, cy), and (first pixel, width, height) of the image in ``depth`` [m].

    max_behind, max_front: A surface farther along z before or behind a point says nothing, or no more than that it is
        free [m].
    """

    T_camera_world: wp.array[wp.mat44]
    pinhole: wp.array[wp.vec4]
    image: wp.array[wp.vec3i]
    depth: wp.array[wp.float32]
    max_behind: float
    max_front: float


@wp.func
def signed_distance(
    p: wp.vec3,
    view: int,
    views: Views,
) -> float:
    """Signed distance [m] to the surface that `view` measured on the ray of `p`; NOT_SEEN where it measured none."""
    q = wp.transform_point(views.T_camera_world[view], p)
    if q[2] <= NEAREST_Z:
        return NOT_SEEN
    x = q[0] / q[2]
    y = q[1] / q[2]
    f = views.pinhole[view]
    u = f[0] * x + f[2]
    v = f[1] * y + f[3]
    start = views.image[view][0]
    width = views.image[view][1]
    height = views.image[view][2]
    # So that NaN is outside.
    if not (u >= -0.5 and v >= -0.5 and u < float(width) - 0.5 and v < float(height) - 0.5):
        return NOT_SEEN
    nearest = views.depth[start + wp.min(int(v + 0.5), height - 1) * width + wp.min(int(u + 0.5), width - 1)]
    distance = nearest - q[2]
    if nearest <= 0.0 or distance < -views.max_behind:
        return NOT_SEEN
    if distance > views.max_front:
        return distance
    i = wp.min(int(wp.max(u, 0.0)), width - 2)
    j = wp.min(int(wp.max(v, 0.0)), height - 2)
    corner = start + j * width + i
    d00 = views.depth[corner]
    d01 = views.depth[corner + 1]
    d10 = views.depth[corner + width]
    d11 = views.depth[corner + width + 1]
    least = wp.min(wp.min(d00, d01), wp.min(d10, d11))
    most = wp.max(wp.max(d00, d01), wp.max(d10, d11))
    if least > 0.0 and most - least <= DEPTH_EDGE * least:
        s = u - float(i)
        t = v - float(j)
        w00 = 1.0 / d00
        w01 = 1.0 / d01
        w10 = 1.0 / d10
        w11 = 1.0 / d11
        w = wp.lerp(wp.lerp(w00, w01, s), wp.lerp(w10, w11, s), t)
        a = f[0] * wp.lerp(w01 - w00, w11 - w10, t)
        b = f[1] * wp.lerp(w10 - w00, w11 - w01, s)
        c = w - a * x - b * y
        distance = (1.0 - q[2] * w) / wp.length(wp.vec3(a, b, c))
    return distance


@wp.kernel(module=MODULE, enable_backward=False)
def classify_points(
    layer: int,
    first: wp.vec3i,
    voxel: float,
    visible: wp.array[wp.int32],
    views: Views,
    behind: float,
    band: float,
    state: wp.array3d[wp.uint8],
):
    """State of the points of a box from a layer along x on."""
    i, j, k = wp.tid()
    i += layer
    p = wp.vec3(float(first[0] + i) * voxel, float(first[1] + j) * voxel, float(first[2] + k) * voxel)
    observed = wp.bool(False)
    near = wp.bool(False)
    for n in range(visible.shape[0]):
        s = signed_distance(p, visible[n], views)
        if s > NOT_SEEN:
            observed = observed or s >= -behind
            near = near or wp.abs(s) <= band
        if observed and near:
            break
    if observed:
        state[i, j, k] = wp.uint8(wp.where(near, NEAR, OBSERVED))


@wp.kernel(module=MODULE, enable_backward=False)
def find_facing(
    start: int,
    points: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    centers: wp.array[wp.vec3],
    views: Views,
    least: float,
    most: float,
    facing: wp.array[wp.uint8],
):
    n = start + wp.tid()
    for view in range(centers.shape[0]):
        ray = centers[view] - points[n]
        if wp.dot(normals[n], ray) > 0.0:
            s = signed_distance(points[n], view, views)
            if s >= least and s < most:
                facing[n] = wp.uint8(1)
                break


@wp.kernel(module=MODULE, enable_backward=False)
def find_reached(
    first: wp.vec3i,
    voxel: float,
    visible: wp.array[wp.int32],
    views: Views,
    deepest: wp.array[wp.float32],
    margin: float,
    reached: wp.array3d[wp.uint8],
):
    i, j, k = wp.tid()
    p = wp.vec3(float(first[0] + i) * voxel, float(first[1] + j) * voxel, float(first[2] + k) * voxel)
    for n in range(visible.shape[0]):
        view = visible[n]
        q = wp.transform_point(views.T_camera_world[view], p)
        if q[2] > NEAREST_Z and q[2] <= deepest[view]:
            f = views.pinhole[view]
            # Distance from the image's centre, both in focal lengths.
            u = wp.abs(q[0] / q[2] - (0.5 * float(views.image[view][1] - 1) - f[2]) / f[0])
            v = wp.abs(q[1] / q[2] - (0.5 * float(views.image[view][2] - 1) - f[3]) / f[1])
            if (
                u <= 0.5 * float(views.image[view][1]) / f[0] + margin
                and v <= 0.5 * float(views.image[view][2]) / f[1] + margin
            ):
                reached[i, j, k] = wp.uint8(1)
                break
