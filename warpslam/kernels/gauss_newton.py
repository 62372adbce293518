"""Gauss-Newton on the pose of one frame (Eq. 12): derivatives of rendered depth and grey value, equations, step.

With o' = o + t and d' = d + w x d for a motion (t, w) in world axes, turning about the camera centre, a sample at p
moves by t + z w x d. Compositing gives the derivative of a ray's depth, or grey value, by each logit; the decoders'
adjoints give that of a logit by its point once for both, since they are linear in what comes in:

    d depth / d p_i = (d depth / d logit_i) (d logit_i / d p_i)
    d grey  / d p_i = (d grey / d logit_i) (d logit_i / d p_i) + w_i mean_c (d color_i / d p_i)

Absolute residuals of Eq. 11 are reweighted as squares, |r| ~ r^2 / max(|r|, floor). One thread sums and solves, so
that the sum has one order; on CUDA, where that takes half as long as the rendering, threads sum parts of it, in one
order, too (`normal_parts`), and the stages along rays have a thread a sample (`warpslam.kernels.by_sample`).
"""

import warp as wp

from warpslam.kernels.compositing import OUTSIDE_LOGIT, Listed, Rendered, count_index, occupancy
from warpslam.kernels.samples import Rays

wp.set_module_options({"enable_backward": False, "max_unroll": 1, "block_dim": 32})

Vec6 = wp.types.vector(length=6, dtype=wp.float32)
Vec6d = wp.types.vector(length=6, dtype=wp.float64)
Mat66d = wp.types.matrix(shape=(6, 6), dtype=wp.float64)

CHUNK = 16
"""Rays that a thread of `normal_parts` sums over."""

ENTRIES = 27

# Residuals below the floors count as squares; damping; largest step.
DEPTH_FLOOR = wp.constant(0.005)
SIGMA_FLOOR = wp.constant(0.005)
GREY_FLOOR = wp.constant(0.02)
DAMPING = wp.constant(wp.float64(1.0e-3))
MAX_TRANSLATION = wp.constant(wp.float64(0.05))
MAX_ROTATION = wp.constant(wp.float64(0.05))


@wp.kernel
def ray_derivatives(
    start: int,
    listed: Listed,
    rays: Rays,
    inlier: wp.array[int],
    rendered: Rendered,
    min_weight: float,
    min_gradient: float,
    by_logit: wp.array[wp.vec2],
    wanted: wp.array[float],
    color_grad: wp.array[wp.vec3],
):
    """Derivatives of depth and grey value by each logit; ``wanted`` is 1 where one of them exceeds ``min_gradient``.
    Also empties the list that `warpslam.kernels.compositing.list_steep` fills next.
    """
    tid = start + wp.tid()
    if wp.tid() == 0:
        listed.counts[count_index(listed.slot)] = 0
    depth_behind = float(0.0)
    grey_behind = float(0.0)
    for m in range(rays.sample_count):
        i = (tid + 1) * rays.sample_count - 1 - m
        derivatives = wp.vec2()
        want = float(0.0)
        by_color = wp.vec3()
        if inlier[tid] != 0:
            w = rendered.weight[i]
            grey = (rendered.color[i][0] + rendered.color[i][1] + rendered.color[i][2]) / 3.0
            if w >= min_weight:
                by_color = wp.vec3(w / 3.0, w / 3.0, w / 3.0)
            if rendered.logit[i] != OUTSIDE_LOGIT:
                alpha = occupancy(rendered.logit[i])
                free = 1.0 - alpha
                blocked = alpha / (free + 1.0e-10)
                derivatives = (
                    10.0 * free * wp.vec2(rays.z[i] * w - blocked * depth_behind, grey * w - blocked * grey_behind)
                )
                want = wp.where(wp.max(wp.abs(derivatives[0]), wp.abs(derivatives[1])) > min_gradient, 1.0, 0.0)
            depth_behind += rays.z[i] * w
            grey_behind += grey * w
        by_logit[i] = derivatives
        wanted[i] = want
        color_grad[i] = by_color


@wp.func
def by_motion(direction: wp.vec3, by_origin: wp.vec3, by_direction: wp.vec3) -> Vec6:
    turned = wp.cross(direction, by_direction)
    return Vec6(by_origin[0], by_origin[1], by_origin[2], turned[0], turned[1], turned[2])


@wp.kernel
def ray_jacobians(
    start: int,
    rays: Rays,
    by_logit: wp.array[wp.vec2],
    logit_by_point: wp.array[wp.vec3],
    grey_by_point: wp.array[wp.vec3],
    depth_by_motion: wp.array[Vec6],
    grey_by_motion: wp.array[Vec6],
):
    """Rows of the Jacobian, one ray a thread; clears the derivatives by points for the next iteration."""
    tid = start + wp.tid()
    depth_origin = wp.vec3()
    depth_direction = wp.vec3()
    grey_origin = wp.vec3()
    grey_direction = wp.vec3()
    for n in range(rays.sample_count):
        i = tid * rays.sample_count + n
        d = by_logit[i][0] * logit_by_point[i]
        g = by_logit[i][1] * logit_by_point[i] + grey_by_point[i]
        depth_origin += d
        depth_direction += rays.z[i] * d
        grey_origin += g
        grey_direction += rays.z[i] * g
        logit_by_point[i] = wp.vec3()
        grey_by_point[i] = wp.vec3()
    depth_by_motion[tid] = by_motion(rays.direction[tid], depth_origin, depth_direction)
    grey_by_motion[tid] = by_motion(rays.direction[tid], grey_origin, grey_direction)


@wp.func
def solve(A: Mat66d, b: Vec6d) -> Vec6d:
    """A x = b for a symmetric positive definite A, by elimination without pivoting."""
    for k in range(6):
        for i in range(k + 1, 6):
            factor = A[i, k] / A[k, k]
            for j in range(k, 6):
                A[i, j] = A[i, j] - factor * A[k, j]
            b[i] = b[i] - factor * b[k]
    x = Vec6d()
    for m in range(6):
        i = 5 - m
        total = b[i]
        for j in range(i + 1, 6):
            total = total - A[i, j] * x[j]
        x[i] = total / A[i, i]
    return x


@wp.func
def limited(v: wp.vec3d, longest: wp.float64) -> wp.float64:
    """Factor that brings a vector to at most this length."""
    return wp.min(wp.float64(1.0), longest / wp.max(wp.length(v), wp.float64(1.0e-12)))


@wp.func
def is_finite6(v: Vec6) -> bool:
    total = float(0.0)
    for k in range(6):
        total += wp.abs(v[k])
    return wp.isfinite(total)


@wp.struct
class Residuals:
    """What rays measure and render, which of them count, and the rows of the Jacobian."""

    ray_count: int
    color_weight: float
    inlier: wp.array[int]
    sigma: wp.array[float]
    measured_depth: wp.array[float]
    measured_rgb: wp.array[wp.vec3]
    depth: wp.array[float]
    rgb: wp.array[wp.vec3]
    depth_by_motion: wp.array[Vec6]
    grey_by_motion: wp.array[Vec6]


@wp.func
def sum_rays(
    residuals: Residuals,
    normal: wp.array[Mat66d],
    right: wp.array[Vec6d],
):
    H = Mat66d()
    b = Vec6d()
    for n in range(residuals.ray_count):
        if residuals.inlier[n] != 0:
            error = residuals.measured_depth[n] - residuals.depth[n]
            weight = 1.0 / (wp.max(residuals.sigma[n], SIGMA_FLOOR) * wp.max(wp.abs(error), DEPTH_FLOOR))
            if is_finite6(residuals.depth_by_motion[n]) and wp.isfinite(weight * error):
                J = Vec6d(residuals.depth_by_motion[n])
                H += wp.float64(weight) * wp.outer(J, J)
                b += wp.float64(weight * error) * J
            difference = residuals.measured_rgb[n] - residuals.rgb[n]
            error = (difference[0] + difference[1] + difference[2]) / 3.0
            weight = 3.0 * residuals.color_weight / wp.max(wp.abs(error), GREY_FLOOR)
            if is_finite6(residuals.grey_by_motion[n]) and wp.isfinite(weight * error):
                J = Vec6d(residuals.grey_by_motion[n])
                H += wp.float64(weight) * wp.outer(J, J)
                b += wp.float64(weight * error) * J
    normal[0] = H
    right[0] = b


@wp.kernel
def gauss_newton_step(
    residuals: Residuals,
    normal: wp.array[Mat66d],
    right: wp.array[Vec6d],
    poses: wp.array2d[float],
):
    """One damped step on the first pose vector (qw, qx, qy, qz, tx, ty, tz), by one thread."""
    sum_rays(residuals, normal, right)
    step_pose(normal[0], right[0], poses)


@wp.kernel
def normal_parts(residuals: Residuals, parts: wp.array2d[wp.float64]):
    """Sums over `CHUNK` rays: one thread an entry of the normal equations, the upper triangle and the right side."""
    chunk, entry = wp.tid()
    if entry >= ENTRIES:
        return
    a = int(0)
    b = int(entry)
    while b >= 6 - a and a < 6:
        b -= 6 - a
        a += 1
    is_right = a == 6
    if is_right:
        a = b
    b += a
    total = wp.float64(0.0)
    last = wp.min(chunk * CHUNK + CHUNK, residuals.ray_count)
    for n in range(chunk * CHUNK, last):
        if residuals.inlier[n] != 0:
            error = residuals.measured_depth[n] - residuals.depth[n]
            weight = 1.0 / (wp.max(residuals.sigma[n], SIGMA_FLOOR) * wp.max(wp.abs(error), DEPTH_FLOOR))
            total += ray_entry(residuals.depth_by_motion[n], weight, error, a, b, is_right)
            difference = residuals.measured_rgb[n] - residuals.rgb[n]
            error = (difference[0] + difference[1] + difference[2]) / 3.0
            weight = 3.0 * residuals.color_weight / wp.max(wp.abs(error), GREY_FLOOR)
            total += ray_entry(residuals.grey_by_motion[n], weight, error, a, b, is_right)
    parts[chunk, entry] = total


@wp.kernel
def sum_parts(chunks: int, parts: wp.array2d[wp.float64], normal: wp.array[wp.float64]):
    """The entries from the sums of `normal_parts`, one thread each."""
    entry = wp.tid()
    total = wp.float64(0.0)
    for chunk in range(chunks):
        total += parts[chunk, entry]
    normal[entry] = total


@wp.kernel
def gauss_newton_step_of_entries(normal: wp.array[wp.float64], poses: wp.array2d[float]):
    """`gauss_newton_step` from the entries that `sum_parts` leaves."""
    H = Mat66d()
    right = Vec6d()
    entry = int(0)
    for a in range(6):
        for b in range(a, 6):
            H[a, b] = normal[entry]
            H[b, a] = normal[entry]
            entry += 1
        right[a] = normal[21 + a]
    step_pose(H, right, poses)


@wp.func
def ray_entry(J: Vec6, weight: float, error: float, a: int, b: int, is_right: bool) -> wp.float64:
    """What a ray adds to an entry."""
    if not is_finite6(J) or not wp.isfinite(weight * error):
        return wp.float64(0.0)
    if is_right:
        return wp.float64(weight * error) * wp.float64(J[a])
    return wp.float64(weight) * wp.float64(J[a]) * wp.float64(J[b])


@wp.func
def step_pose(normal: Mat66d, right: Vec6d, poses: wp.array2d[float]):
    H = Mat66d(normal)
    for k in range(6):
        H[k, k] = H[k, k] * (wp.float64(1.0) + DAMPING) + wp.float64(1.0e-9)
    step = solve(H, right)
    # A single step never leaves the basin that the samples around the surface can see.
    step = step * limited(wp.vec3d(step[0], step[1], step[2]), MAX_TRANSLATION)
    turn = wp.vec3d(step[3], step[4], step[5])
    factor = limited(turn, MAX_ROTATION)
    step = step * factor
    turn = turn * factor
    half = wp.float64(0.5) * wp.length(turn)
    c = wp.cos(half)
    axis = wp.float64(0.5) * turn
    if half > wp.float64(0.0):
        axis = (wp.sin(half) / half) * axis
    q = wp.vec3d(wp.float64(poses[0, 1]), wp.float64(poses[0, 2]), wp.float64(poses[0, 3]))
    w = wp.float64(poses[0, 0])
    vector = c * q + w * axis + wp.cross(axis, q)
    scalar = c * w - wp.dot(axis, q)
    length = wp.sqrt(scalar * scalar + wp.dot(vector, vector))
    poses[0, 0] = float(scalar / length)
    for k in range(3):
        poses[0, 1 + k] = float(vector[k] / length)
        poses[0, 4 + k] = poses[0, 4 + k] + float(step[k])
