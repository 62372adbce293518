"""The stages along rays with one thread a sample (CUDA), equal to those with one thread a ray (Eq. 5-7).

    T_i = prod_{j < i} (1 - alpha_j + 1e-10),   behind_i = sum_{k > i} g_k w_k

A thread forms the product or the sum of its own sample, over those in front of it or behind it and in the order in
which a thread a ray would: 48 steps of what its neighbours read as well, instead of 48 loads and stores one after the
other, 32 rays apart. Equations and adjoints are those of `warpslam.kernels.compositing`, `warpslam.kernels.samples` and
`warpslam.kernels.gauss_newton`.
"""

import warp as wp

from warpslam.kernels.compositing import (
    OUTSIDE_LOGIT,
    Box,
    Listed,
    Rendered,
    count_index,
    is_inside,
    logit_gradient,
    occupancy,
)
from warpslam.kernels.gauss_newton import Vec6, by_motion
from warpslam.kernels.pixels import Draw
from warpslam.kernels.samples import Placement, Rays, stratum, surface_sample

wp.set_module_options({"enable_backward": False, "max_unroll": 4, "block_dim": 32})

PARTS = 8
"""Threads that sum the samples of a ray, every eighth one each."""

Vec12 = wp.types.vector(length=12, dtype=wp.float32)


@wp.kernel
def place_samples(
    draw: Draw,
    placement: Placement,
    depth: wp.array[float],
    t_exit: wp.array[float],
    keep: wp.array[int],
    max_depth: wp.array[float],
    z: wp.array[float],
):
    """A sample's place along the ray is its place in its own sequence and how many of the other come before it."""
    i = wp.tid()
    total = placement.stratified + placement.surface
    ray = i // total
    if keep[ray] == 0:
        return
    near = float(0.01)
    far = t_exit[ray] + 0.01
    largest = float(0.0)
    measured = float(0.0)
    if placement.use_depth != 0:
        measured = depth[ray]
        largest = max_depth[0]
        near = 0.01 * measured
        far = wp.clamp(far, 0.0, 1.2 * largest)
    state = wp.rand_init(draw.seeds[draw.iteration[0]] ^ 0x5BD1E995, ray)
    n = i - ray * total
    value = float(0.0)
    place = int(0)
    if n < placement.stratified:
        place = n
        value = stratum(n, placement.stratified, near, far, placement.jitter, state)
        for k in range(placement.surface):
            if surface_sample(k, placement.surface, measured, largest, placement.jitter, state) < value:
                place += 1
    else:
        place = n - placement.stratified
        value = surface_sample(place, placement.surface, measured, largest, placement.jitter, state)
        for k in range(placement.stratified):
            if stratum(k, placement.stratified, near, far, placement.jitter, state) <= value:
                place += 1
    z[ray * total + place] = value


@wp.func
def alpha_of(i: int, o: wp.vec3, d: wp.vec3, bound: Box, rays: Rays, logit: wp.array[float]) -> float:
    """Occupancy of a sample, whether its thread has noted by now that it is outside or not."""
    value = logit[i]
    if not is_inside(o + rays.z[i] * d, bound.low, bound.high):
        value = OUTSIDE_LOGIT
    return occupancy(value)


@wp.kernel
def weigh_samples(bound: Box, rays: Rays, keep: wp.array[int], rendered: Rendered, min_weight: float):
    """Weights (Eq. 6); samples below ``min_weight`` are made black."""
    i = wp.tid()
    ray = i // rays.sample_count
    if keep[ray] == 0:
        return
    o = rays.origin[ray]
    d = rays.direction[ray]
    passed = float(1.0)
    for j in range(ray * rays.sample_count, i):
        passed *= 1.0 - alpha_of(j, o, d, bound, rays, rendered.logit) + 1.0e-10
    w = alpha_of(i, o, d, bound, rays, rendered.logit) * passed
    if not is_inside(o + rays.z[i] * d, bound.low, bound.high):
        rendered.logit[i] = OUTSIDE_LOGIT
    rendered.weight[i] = w
    if w < min_weight:
        rendered.color[i] = wp.vec3()


@wp.kernel
def sum_rays(
    listed: Listed,
    rays: Rays,
    keep: wp.array[int],
    weight: wp.array[float],
    with_color: int,
    min_weight: float,
    depth: wp.array[float],
    variance: wp.array[float],
):
    """Depth and variance of a ray (Eq. 7), and the list of its samples that need colour."""
    ray = wp.tid()
    if keep[ray] == 0:
        return
    first = ray * rays.sample_count
    d = float(0.0)
    count = int(0)
    for n in range(rays.sample_count):
        w = weight[first + n]
        d += w * rays.z[first + n]
        if w >= min_weight:
            count += 1
    v = float(0.0)
    for n in range(rays.sample_count):
        e = rays.z[first + n] - d
        v += weight[first + n] * e * e
    depth[ray] = d
    variance[ray] = v
    if with_color != 0:
        place = listed.start + wp.atomic_add(listed.counts, count_index(listed.slot), count)
        for n in range(rays.sample_count):
            if weight[first + n] >= min_weight:
                listed.samples[place] = first + n
                place += 1


@wp.kernel
def composite_backward(
    listed: Listed,
    rays: Rays,
    keep: wp.array[int],
    rendered: Rendered,
    with_color: int,
    min_weight: float,
    depth_grad: wp.array[float],
    rgb_grad: wp.array[wp.vec3],
    logit_grad: wp.array[float],
    color_grad: wp.array[wp.vec3],
):
    """Adjoint of compositing. Also empties the list that `list_steep` fills next, which takes the rays' gradients."""
    i = wp.tid()
    if i == 0:
        listed.counts[count_index(listed.slot)] = 0
    ray = i // rays.sample_count
    gradient = float(0.0)
    by_color = wp.vec3()
    if keep[ray] != 0:
        d_depth = depth_grad[ray]
        d_rgb = rgb_grad[ray]
        behind = float(0.0)
        last = (ray + 1) * rays.sample_count - 1
        for m in range(last - i):
            k = last - m
            g = d_depth * rays.z[k]
            if with_color != 0:
                g += wp.dot(d_rgb, rendered.color[k])
            behind += g * rendered.weight[k]
        w = rendered.weight[i]
        g = d_depth * rays.z[i]
        if with_color != 0:
            g += wp.dot(d_rgb, rendered.color[i])
            by_color = wp.where(w < min_weight, wp.vec3(), w * d_rgb)
        gradient = logit_gradient(rendered.logit[i], g, w, behind)
    if with_color != 0:
        color_grad[i] = by_color
    logit_grad[i] = gradient


@wp.kernel
def list_steep(
    listed: Listed,
    sample_count: int,
    logit_grad: wp.array[float],
    min_gradient: float,
    depth_grad: wp.array[float],
    rgb_grad: wp.array[wp.vec3],
):
    """List the samples with a gradient beyond ``min_gradient``. Clears the gradients of the rays: the next iteration's
    losses add to zero.
    """
    ray = wp.tid()
    depth_grad[ray] = 0.0
    rgb_grad[ray] = wp.vec3()
    first = ray * sample_count
    count = int(0)
    for n in range(sample_count):
        if wp.abs(logit_grad[first + n]) > min_gradient:
            count += 1
    place = listed.start + wp.atomic_add(listed.counts, count_index(listed.slot), count)
    for n in range(sample_count):
        if wp.abs(logit_grad[first + n]) > min_gradient:
            listed.samples[place] = first + n
            place += 1


@wp.kernel
def ray_derivatives(
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
    """`warpslam.kernels.gauss_newton.ray_derivatives`."""
    i = wp.tid()
    if i == 0:
        listed.counts[count_index(listed.slot)] = 0
    ray = i // rays.sample_count
    derivatives = wp.vec2()
    want = float(0.0)
    by_color = wp.vec3()
    if inlier[ray] != 0:
        depth_behind = float(0.0)
        grey_behind = float(0.0)
        last = (ray + 1) * rays.sample_count - 1
        for m in range(last - i):
            k = last - m
            w = rendered.weight[k]
            color = rendered.color[k]
            depth_behind += rays.z[k] * w
            grey_behind += (color[0] + color[1] + color[2]) / 3.0 * w
        w = rendered.weight[i]
        color = rendered.color[i]
        grey = (color[0] + color[1] + color[2]) / 3.0
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
    by_logit[i] = derivatives
    wanted[i] = want
    color_grad[i] = by_color


@wp.kernel
def jacobian_parts(
    rays: Rays,
    by_logit: wp.array[wp.vec2],
    logit_by_point: wp.array[wp.vec3],
    grey_by_point: wp.array[wp.vec3],
    parts: wp.array2d[Vec12],
):
    """Sums over every eighth sample of a ray; clears the derivatives by points for the next iteration."""
    ray, part = wp.tid()
    depth_origin = wp.vec3()
    depth_direction = wp.vec3()
    grey_origin = wp.vec3()
    grey_direction = wp.vec3()
    first = ray * rays.sample_count
    for n in range(part, rays.sample_count, PARTS):
        i = first + n
        d = by_logit[i][0] * logit_by_point[i]
        g = by_logit[i][1] * logit_by_point[i] + grey_by_point[i]
        depth_origin += d
        depth_direction += rays.z[i] * d
        grey_origin += g
        grey_direction += rays.z[i] * g
    for n in range(part, rays.sample_count, PARTS):
        logit_by_point[first + n] = wp.vec3()
        grey_by_point[first + n] = wp.vec3()
    total = Vec12()
    for k in range(3):
        total[k] = depth_origin[k]
        total[3 + k] = depth_direction[k]
        total[6 + k] = grey_origin[k]
        total[9 + k] = grey_direction[k]
    parts[ray, part] = total


@wp.kernel
def ray_jacobians(
    direction: wp.array[wp.vec3],
    parts: wp.array2d[Vec12],
    depth_by_motion: wp.array[Vec6],
    grey_by_motion: wp.array[Vec6],
):
    """Rows of the Jacobian from the sums of `jacobian_parts`."""
    ray = wp.tid()
    total = Vec12()
    for part in range(PARTS):
        total += parts[ray, part]
    d = direction[ray]
    depth_by_motion[ray] = by_motion(d, wp.vec3(total[0], total[1], total[2]), wp.vec3(total[3], total[4], total[5]))
    grey_by_motion[ray] = by_motion(d, wp.vec3(total[6], total[7], total[8]), wp.vec3(total[9], total[10], total[11]))


@wp.kernel
def collect_ray_gradients(
    rays: Rays,
    keep: wp.array[int],
    counts: wp.array[int],
    point_grad: wp.array[wp.vec3],
    origin_grad: wp.array[wp.vec3],
    direction_grad: wp.array[wp.vec3],
):
    """`warpslam.kernels.rays.collect_ray_gradients`, eight threads a ray; the gradients of rays are added to."""
    ray, part = wp.tid()
    if keep[ray] == 0:
        return
    do = wp.vec3()
    dd = wp.vec3()
    first = ray * rays.sample_count
    for n in range(part, rays.sample_count, PARTS):
        g = point_grad[first + n]
        do += g
        dd += rays.z[first + n] * g
    for n in range(part, rays.sample_count, PARTS):
        point_grad[first + n] = wp.vec3()
    if counts[ray] != 0:
        wp.atomic_add(origin_grad, ray, do)
        wp.atomic_add(direction_grad, ray, dd)
