"""Samples along rays, and volume rendering, of a density (iMAP*).

    alpha_i = 1 - exp(-relu(density_i) delta_i |d|),   delta_i = z_{i+1} - z_i, of the last sample 1e10
    w_i = alpha_i T_i,   T_i = prod_{j < i} (1 - alpha_j + 1e-10)
    depth = sum w_i z_i,   rgb = sum w_i c_i,   variance = sum w_i (z_i - depth)^2

Adjoint, for incoming d_depth and d_rgb (the losses detach the variance), with g_i = d_depth z_i + d_rgb . c_i:

    d_alpha_i = g_i T_i - sum_{k > i} g_k w_k / (1 - alpha_i + 1e-10)
    d_density_i = d_alpha_i (1 - alpha_i) delta_i |d| where density_i > 0;   d_c_i = w_i d_rgb

A sample outside the map's bound counts as density 100 and has no gradient. Gradients never reach z, and |d| does not
depend on the pose. Lengths are in network units (metres times the scale of the settings).

Per-sample arrays have shape (ray_count * sample_count,); samples of a ray are stored in the order in which they are
made (stratified, importance, empty space), and ``order`` tells the order along the ray. Rays that are not kept render 0
and have no gradient.
"""

import warp as wp

from warpslam.kernels.compositing import Box, is_inside
from warpslam.kernels.pixels import Draw
from warpslam.kernels.samples import Rays, stratum

wp.set_module_options({"enable_backward": False, "max_unroll": 4})

OUTSIDE_DENSITY = wp.constant(100.0)
_FARTHEST = wp.constant(1.0e10)


@wp.struct
class Composited:
    """Samples by their order along the ray: density, colour, weight, and the transmittance in front of each."""

    order: wp.array[int]
    density: wp.array[float]
    color: wp.array[wp.vec3]
    weight: wp.array[float]
    transmittance: wp.array[float]


@wp.struct
class CompositeGradient:
    """Gradients by depth and colour of each ray, which are consumed, and by density and colour of each sample."""

    depth_grad: wp.array[float]
    rgb_grad: wp.array[wp.vec3]
    density_grad: wp.array[float]
    color_grad: wp.array[wp.vec3]


@wp.func
def density_at(i: int, ray: int, bound: Box, rays: Rays, density: wp.array[float]) -> float:
    """Density of a sample, that of outside where it is."""
    if not is_inside(rays.origin[ray] + rays.z[i] * rays.direction[ray], bound.low, bound.high):
        return OUTSIDE_DENSITY
    return density[i]


@wp.kernel(enable_backward=False)
def place_stratified(
    start: int,
    draw: Draw,
    jitter: int,
    count: int,
    use_depth: int,
    depth: wp.array[float],
    t_exit: wp.array[float],
    max_depth: wp.array[float],
    rays: Rays,
):
    """The strata of `warpslam.kernels.samples`, without samples near the surface."""
    ray = start + wp.tid()
    near = float(0.01)
    far = t_exit[ray] + 0.01
    if use_depth != 0:
        near = 0.01 * depth[ray]
        far = wp.clamp(far, 0.0, 1.2 * max_depth[0])
    state = wp.rand_init(draw.seeds[draw.iteration[0]] ^ 0x5BD1E995, ray)
    for n in range(count):
        rays.z[ray * rays.sample_count + n] = stratum(n, count, near, far, jitter, state)


@wp.kernel(enable_backward=False)
def place_importance(
    start: int,
    stratified: int,
    importance: int,
    keep: wp.array[int],
    bound: Box,
    rays: Rays,
    density: wp.array[float],
    weight: wp.array[float],
    order: wp.array[int],
):
    """Inverse CDF of the inner stratified weights over the midpoints between samples, at even steps; and the order
    of all samples along the ray.
    """
    ray = start + wp.tid()
    first = ray * rays.sample_count
    if keep[ray] == 0:
        return
    norm = wp.length(rays.direction[ray])
    passed = float(1.0)
    total = float(0.0)
    for n in range(stratified):
        i = first + n
        delta = _FARTHEST
        if n + 1 < stratified:
            delta = rays.z[i + 1] - rays.z[i]
        sigma = density_at(i, ray, bound, rays, density)
        alpha = 1.0 - wp.exp(-wp.max(sigma, 0.0) * delta * norm)
        w = alpha * passed
        passed *= 1.0 - alpha + 1.0e-10
        weight[i] = w
        if n > 0 and n + 1 < stratified:
            total += w + 1.0e-5
    # Bin b reaches from midpoint b to midpoint b + 1 and has the weight of sample b + 1.
    cell = int(0)
    below = float(0.0)
    above = (weight[first + 1] + 1.0e-5) / total
    for n in range(importance):
        u = float(n) / float(importance - 1)
        while u >= above and cell + 3 < stratified:
            cell += 1
            below = above
            above += (weight[first + cell + 1] + 1.0e-5) / total
        left = 0.5 * (rays.z[first + cell] + rays.z[first + cell + 1])
        right = 0.5 * (rays.z[first + cell + 1] + rays.z[first + cell + 2])
        share = wp.clamp((u - below) / (above - below), 0.0, 1.0)
        rays.z[first + stratified + n] = left + share * (right - left)
    a = int(0)
    b = int(0)
    for n in range(stratified + importance):
        take_a = a < stratified
        if take_a and b < importance:
            take_a = rays.z[first + a] <= rays.z[first + stratified + b]
        if take_a:
            order[first + n] = first + a
            a += 1
        else:
            order[first + n] = first + stratified + b
            b += 1


@wp.kernel(enable_backward=False)
def place_empty(
    start: int,
    draw: Draw,
    first_sample: int,
    count: int,
    depth: wp.array[float],
    rays: Rays,
):
    """Jittered samples in [0, 0.85 D], where nothing should be."""
    ray = start + wp.tid()
    state = wp.rand_init(draw.seeds[draw.iteration[0]] ^ 0x3C6EF372, ray)
    for n in range(count):
        s = (float(n) + wp.randf(state)) / float(count)
        rays.z[ray * rays.sample_count + first_sample + n] = 0.85 * depth[ray] * s


@wp.kernel(enable_backward=False)
def composite(
    start: int,
    visible: int,
    keep: wp.array[int],
    bound: Box,
    rays: Rays,
    composited: Composited,
    depth: wp.array[float],
    variance: wp.array[float],
    rgb: wp.array[wp.vec3],
):
    """Weight of, and transmittance in front of, each of the ``visible`` samples; depth, variance, colour."""
    ray = start + wp.tid()
    first = ray * rays.sample_count
    d = float(0.0)
    v = float(0.0)
    c = wp.vec3()
    if keep[ray] != 0:
        norm = wp.length(rays.direction[ray])
        passed = float(1.0)
        for n in range(visible):
            i = composited.order[first + n]
            delta = _FARTHEST
            if n + 1 < visible:
                delta = rays.z[composited.order[first + n + 1]] - rays.z[i]
            sigma = density_at(i, ray, bound, rays, composited.density)
            alpha = 1.0 - wp.exp(-wp.max(sigma, 0.0) * delta * norm)
            composited.weight[i] = alpha * passed
            composited.transmittance[i] = passed
            d += composited.weight[i] * rays.z[i]
            c += composited.weight[i] * composited.color[i]
            passed *= 1.0 - alpha + 1.0e-10
        for n in range(visible):
            i = composited.order[first + n]
            v += composited.weight[i] * (rays.z[i] - d) * (rays.z[i] - d)
    depth[ray] = d
    variance[ray] = v
    rgb[ray] = c


@wp.kernel(enable_backward=False)
def composite_backward(
    start: int,
    visible: int,
    keep: wp.array[int],
    bound: Box,
    rays: Rays,
    composited: Composited,
    empty_weight: float,
    gradient: CompositeGradient,
):
    """Adjoint of `composite`; samples behind the ``visible`` ones get that of ``empty_weight`` |density|."""
    ray = start + wp.tid()
    first = ray * rays.sample_count
    d_depth = gradient.depth_grad[ray]
    d_rgb = gradient.rgb_grad[ray]
    # Consumed here, like the adjoint of a store: the next iteration's losses add to zero.
    gradient.depth_grad[ray] = 0.0
    gradient.rgb_grad[ray] = wp.vec3()
    norm = wp.length(rays.direction[ray])
    behind = float(0.0)
    for m in range(visible):
        n = visible - 1 - m
        i = first + n
        by_density = float(0.0)
        by_color = wp.vec3()
        if keep[ray] != 0:
            i = composited.order[first + n]
            delta = _FARTHEST
            if m > 0:
                delta = rays.z[composited.order[first + n + 1]] - rays.z[i]
            g = d_depth * rays.z[i] + wp.dot(d_rgb, composited.color[i])
            by_color = composited.weight[i] * d_rgb
            inside = is_inside(rays.origin[ray] + rays.z[i] * rays.direction[ray], bound.low, bound.high)
            if inside and composited.density[i] > 0.0:
                free = wp.exp(-composited.density[i] * delta * norm)
                by_density = (g * composited.transmittance[i] - behind / (free + 1.0e-10)) * free * delta * norm
            behind += g * composited.weight[i]
        gradient.density_grad[i] = by_density
        gradient.color_grad[i] = by_color
    for n in range(visible, rays.sample_count):
        i = first + n
        gradient.density_grad[i] = wp.where(keep[ray] != 0, empty_weight * wp.sign(composited.density[i]), 0.0)
        gradient.color_grad[i] = wp.vec3()


@wp.kernel(enable_backward=False)
def empty_loss(
    visible: int,
    sample_count: int,
    empty_weight: float,
    keep: wp.array[int],
    density: wp.array[float],
    loss: wp.array[float],
):
    ray = wp.tid()
    if keep[ray] != 0:
        total = float(0.0)
        for n in range(visible, sample_count):
            total += wp.abs(density[ray * sample_count + n])
        wp.atomic_add(loss, 0, empty_weight * total)
