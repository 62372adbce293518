"""From pixels to rays in the world, and back from samples to rays.

    o, d   = t, R(q) d_camera                       pose vector (qw, qx, qy, qz, tx, ty, tz), q of any length
    t_exit = min over axes of max over the two planes of (plane - o) / d
    kept   : t_exit >= D                            D = 0 (no measurement) passes; see `warpslam.kernels.rejection`

Gradients reach o and d: `cast_rays` is differentiated by the tape, and

    d_o = sum over samples of d_p,   d_d = sum over samples of z d_p

is written by hand. The other kernels have no gradient.
"""

import warp as wp

from warpslam.kernels.pixels import MODULE
from warpslam.kernels.samples import Rays


@wp.func
def rotation_from_quaternion(w: float, x: float, y: float, z: float) -> wp.mat33:
    s = 2.0 / (w * w + x * x + y * y + z * z)
    return wp.mat33(
        1.0 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w),
        s * (x * y + z * w), 1.0 - s * (x * x + z * z), s * (y * z - x * w),
        s * (x * z - y * w), s * (y * z + x * w), 1.0 - s * (x * x + y * y),
    )  # fmt: skip


@wp.kernel(module=MODULE)
def cast_rays(
    poses: wp.array2d[float],
    frame: wp.array[int],
    direction_camera: wp.array[wp.vec3],
    ray_origin: wp.array[wp.vec3],
    ray_direction: wp.array[wp.vec3],
):
    # Plain arrays: the generated adjoint takes the gradients of these.
    tid = wp.tid()
    f = frame[tid]
    R = rotation_from_quaternion(poses[f, 0], poses[f, 1], poses[f, 2], poses[f, 3])
    ray_direction[tid] = R * direction_camera[tid]
    ray_origin[tid] = wp.vec3(poses[f, 4], poses[f, 5], poses[f, 6])


@wp.kernel(module=MODULE, enable_backward=False)
def bound_rays(
    low: wp.vec3,
    high: wp.vec3,
    rays: Rays,
    depth: wp.array[float],
    use_depth: int,
    t_exit: wp.array[float],
    keep: wp.array[int],
    max_depth: wp.array[float],
):
    """Exit distance from the map's bound, whether the ray is kept, and the largest depth of the kept rays."""
    tid = wp.tid()
    o = rays.origin[tid]
    d = rays.direction[tid]
    t = float(1.0e10)
    for axis in range(3):
        if d[axis] != 0.0:
            t = wp.min(t, wp.max((low[axis] - o[axis]) / d[axis], (high[axis] - o[axis]) / d[axis]))
    t_exit[tid] = t
    kept = int(1)
    if use_depth != 0:
        kept = wp.where(t >= depth[tid], 1, 0)
        if kept == 1:
            wp.atomic_max(max_depth, 0, depth[tid])
    keep[tid] = kept


@wp.kernel(module=MODULE, enable_backward=False)
def collect_ray_gradients(
    start: int,
    rays: Rays,
    keep: wp.array[int],
    counts: wp.array[int],
    point_grad: wp.array[wp.vec3],
    origin_grad: wp.array[wp.vec3],
    direction_grad: wp.array[wp.vec3],
):
    """Adjoint of p = o + z d, summed over the samples of a ray that ``counts``; clears ``point_grad`` for the next
    iteration.
    """
    tid = start + wp.tid()
    if keep[tid] == 0:
        return
    do = wp.vec3()
    dd = wp.vec3()
    for n in range(rays.sample_count):
        g = point_grad[tid * rays.sample_count + n]
        do += g
        dd += rays.z[tid * rays.sample_count + n] * g
        point_grad[tid * rays.sample_count + n] = wp.vec3()
    if counts[tid] != 0:
        origin_grad[tid] = origin_grad[tid] + do
        direction_grad[tid] = direction_grad[tid] + dd
