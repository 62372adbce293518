"""Occupancy and volume rendering (Sec. 3.2, Eq. 6-7).

    alpha_i = sigmoid(10 logit_i),  1 for samples outside the map's bound (logit 100)
    w_i     = alpha_i T_i,          T_i = prod_{j < i} (1 - alpha_j + 1e-10)
    depth   = sum w_i z_i,   rgb = sum w_i c_i                    Eq. 6
    variance = sum w_i (z_i - depth)^2                            Eq. 7

Adjoint, for incoming d_depth and d_rgb (the losses detach the variance), with g_i = d_depth z_i + d_rgb . c_i:

    d_alpha_i = g_i T_i - sum_{k > i} g_k w_k / (1 - alpha_i + 1e-10),   d_logit_i = 10 alpha_i (1 - alpha_i) d_alpha_i
    d_c_i     = w_i d_rgb

Samples with w_i < ``min_weight`` need no colour: it is taken as black, so that rgb errs by less than sample_count *
min_weight. Where T_i < ``min_transmittance`` at the start of a group of samples, these and all behind are left out:
they count as outside with w = 0. What is left out weighs less than min_transmittance in all, so that depth errs by less
than min_transmittance * z_max, and rgb by less than min_transmittance * the brightest colour.
Per-sample arrays have shape (ray_count * sample_count,). Rays that are not kept render 0 and have no gradient.

The samples that need colour, and those whose logit has a gradient, are listed: see `Listed`.
"""

import warp as wp

from warpslam.kernels.samples import Rays

wp.set_module_options({"block_dim": 32})

OUTSIDE_LOGIT = wp.constant(100.0)
# Slices run side by side: each has a cache line of its own.
COUNT_STRIDE = wp.constant(16)


@wp.struct
class Box:
    """Two opposite corners [m]."""

    low: wp.vec3
    high: wp.vec3


@wp.struct
class Rendered:
    """What the field says of each sample, and what it weighs on its ray."""

    logit: wp.array[float]
    color: wp.array[wp.vec3]
    weight: wp.array[float]


@wp.struct
class Listed:
    """Samples on a list. A slice's part begins at ``start``, and its length is entry `count_index` (slot) of counts."""

    start: int
    slot: int
    samples: wp.array[int]
    counts: wp.array[int]


@wp.func
def is_inside(p: wp.vec3, low: wp.vec3, high: wp.vec3) -> bool:
    return p[0] > low[0] and p[0] < high[0] and p[1] > low[1] and p[1] < high[1] and p[2] > low[2] and p[2] < high[2]


@wp.func
def count_index(slot: int) -> int:
    """Entry of a list's counts for a slice of rays."""
    return COUNT_STRIDE * slot


@wp.func
def listed_count(listed: Listed) -> int:
    """Samples on a slice's part of a list."""
    return listed.counts[count_index(listed.slot)]


@wp.func
def occupancy(logit: float) -> float:
    return 1.0 / (1.0 + wp.exp(-10.0 * logit))


@wp.func
def logit_gradient(logit: float, g: float, w: float, behind: float) -> float:
    """d_logit of a sample with weight w, where ``behind`` is the sum of g_k w_k behind it."""
    gradient = float(0.0)
    # 100 marks a sample outside the bound: opaque, and constant.
    if logit != OUTSIDE_LOGIT:
        alpha = occupancy(logit)
        free = 1.0 - alpha
        # g_i T_i = g_i w_i / alpha_i; alpha > 0 unless the exponential overflowed, and then w and the gradient are 0.
        if alpha > 0.0:
            gradient = 10.0 * free * (g * w - alpha * behind / (free + 1.0e-10))
    return gradient


@wp.kernel(enable_backward=False)
def start_rays(
    start: int,
    listed: Listed,
    keep: wp.array[int],
    transmittance: wp.array[float],
    depth: wp.array[float],
    variance: wp.array[float],
    rgb: wp.array[wp.vec3],
):
    """Nothing absorbed yet, nothing listed; a transmittance of -1 marks rays that are not kept."""
    tid = start + wp.tid()
    if wp.tid() == 0:
        listed.counts[count_index(listed.slot)] = 0
    transmittance[tid] = wp.where(keep[tid] != 0, 1.0, -1.0)
    depth[tid] = 0.0
    variance[tid] = 0.0
    rgb[tid] = wp.vec3()


@wp.kernel(enable_backward=False)
def composite(
    start: int,
    first_sample: int,
    width: int,
    min_transmittance: float,
    bound: Box,
    rays: Rays,
    rendered: Rendered,
    transmittance: wp.array[float],
    depth: wp.array[float],
):
    """Weights of the next samples of each ray, whose transmittance and depth so far are carried along."""
    tid = start + wp.tid()
    passed = transmittance[tid]
    if passed < 0.0:
        return
    first = tid * rays.sample_count + first_sample
    if passed < min_transmittance:
        for n in range(width):
            rendered.logit[first + n] = OUTSIDE_LOGIT
            rendered.weight[first + n] = 0.0
        return
    d = depth[tid]
    for n in range(width):
        i = first + n
        if not is_inside(rays.origin[tid] + rays.z[i] * rays.direction[tid], bound.low, bound.high):
            rendered.logit[i] = OUTSIDE_LOGIT
        alpha = occupancy(rendered.logit[i])
        w = alpha * passed
        passed *= 1.0 - alpha + 1.0e-10
        rendered.weight[i] = w
        d += w * rays.z[i]
    transmittance[tid] = passed
    depth[tid] = d


@wp.kernel(enable_backward=False)
def ray_variance(
    start: int,
    rays: Rays,
    keep: wp.array[int],
    weight: wp.array[float],
    depth: wp.array[float],
    variance: wp.array[float],
):
    tid = start + wp.tid()
    if keep[tid] == 0:
        return
    v = float(0.0)
    for n in range(rays.sample_count):
        e = rays.z[tid * rays.sample_count + n] - depth[tid]
        v += weight[tid * rays.sample_count + n] * e * e
    variance[tid] = v


@wp.kernel(enable_backward=False)
def list_weighty(
    start: int,
    listed: Listed,
    sample_count: int,
    keep: wp.array[int],
    weight: wp.array[float],
    min_weight: float,
    color: wp.array[wp.vec3],
):
    """List the samples that weigh at least ``min_weight``, and make the others black."""
    tid = start + wp.tid()
    if keep[tid] == 0:
        return
    first = tid * sample_count
    count = int(0)
    for n in range(sample_count):
        if weight[first + n] >= min_weight:
            count += 1
        else:
            color[first + n] = wp.vec3()
    place = listed.start + wp.atomic_add(listed.counts, count_index(listed.slot), count)
    for n in range(sample_count):
        if weight[first + n] >= min_weight:
            listed.samples[place] = first + n
            place += 1


@wp.kernel(enable_backward=False)
def list_steep(
    start: int,
    listed: Listed,
    sample_count: int,
    logit_grad: wp.array[float],
    min_gradient: float,
):
    """List the samples with a gradient beyond ``min_gradient``."""
    tid = start + wp.tid()
    first = tid * sample_count
    count = int(0)
    for n in range(sample_count):
        if wp.abs(logit_grad[first + n]) > min_gradient:
            count += 1
    place = listed.start + wp.atomic_add(listed.counts, count_index(listed.slot), count)
    for n in range(sample_count):
        if wp.abs(logit_grad[first + n]) > min_gradient:
            listed.samples[place] = first + n
            place += 1


@wp.kernel(enable_backward=False)
def composite_color(
    start: int,
    sample_count: int,
    keep: wp.array[int],
    color: wp.array[wp.vec3],
    weight: wp.array[float],
    rgb: wp.array[wp.vec3],
):
    tid = start + wp.tid()
    if keep[tid] == 0:
        return
    c = wp.vec3()
    for n in range(sample_count):
        i = tid * sample_count + n
        c += weight[i] * color[i]
    rgb[tid] = c


@wp.kernel(enable_backward=False)
def surface_depth(
    rays: Rays,
    keep: wp.array[int],
    rendered: Rendered,
    min_occupancy: float,
    depth: wp.array[float],
):
    """Depth of the first sample that is occupied, or, where none is, of that at which half of the ray's weight is
    spent.
    """
    tid = wp.tid()
    first = tid * rays.sample_count
    total = float(0.0)
    for n in range(rays.sample_count):
        total += rendered.weight[first + n]
    spent = float(0.0)
    halfway = float(0.0)
    surface = float(0.0)
    if keep[tid] != 0:
        for n in range(rays.sample_count):
            i = first + n
            spent += rendered.weight[i]
            if halfway == 0.0 and spent >= 0.5 * total:
                halfway = rays.z[i]
            if surface == 0.0 and rendered.logit[i] != OUTSIDE_LOGIT and occupancy(rendered.logit[i]) >= min_occupancy:
                surface = rays.z[i]
    depth[tid] = wp.where(surface > 0.0, surface, halfway)


@wp.kernel(enable_backward=False)
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
    """Also empties the list that `list_steep` fills next."""
    tid = listed.start // rays.sample_count + wp.tid()
    if wp.tid() == 0:
        listed.counts[count_index(listed.slot)] = 0
    first = tid * rays.sample_count
    kept = keep[tid] != 0
    d_depth = depth_grad[tid]
    d_rgb = rgb_grad[tid]
    # Consumed here, like the adjoint of a store: the next iteration's losses add to zero.
    depth_grad[tid] = 0.0
    rgb_grad[tid] = wp.vec3()
    behind = float(0.0)
    for m in range(rays.sample_count):
        i = first + rays.sample_count - 1 - m
        gradient = float(0.0)
        if kept:
            w = rendered.weight[i]
            g = d_depth * rays.z[i]
            if with_color != 0:
                g += wp.dot(d_rgb, rendered.color[i])
                color_grad[i] = wp.where(w < min_weight, wp.vec3(), w * d_rgb)
            gradient = logit_gradient(rendered.logit[i], g, w, behind)
            behind += g * w
        else:
            if with_color != 0:
                color_grad[i] = wp.vec3()
        logit_grad[i] = gradient
