"""The direct loss of mapping: what a measured depth says of each sample of its ray (ours; the paper renders).

A pixel measures D and I. For a sample at z with s = z - D (z-depth, positive behind the surface), logit l and colour c:

    e = l - k s                 for -f <= s <= b       in the band the logit is the signed distance times the slope k
    e = max(l + k f, 0)         for s < -f             free space: whatever is below the band is right
    no term                     for s > b              nothing was seen
    L = sum w huber(e; delta)  +  lambda sum_{|s| <= r} sum_channels huber(c - I; delta_c)
    w = 1 for s <= 0, w_b behind;   huber(e; delta) = e^2 / (2 delta) for |e| <= delta, |e| - delta / 2 beyond

Adjoint: d_l = w clamp(e / delta, -1, 1) and d_c = lambda clamp((c - I) / delta_c, -1, 1), each times the incoming
gradient of L. No sample knows of another: there is no transmittance and no order along the ray. Per-sample arrays have
shape (ray_count * sample_count,); rays that are not kept have no term. Depths of samples have no gradient.
"""

import warp as wp

from warpslam.kernels.compositing import Listed, count_index
from warpslam.kernels.grid import Lattice, find_cell, row_of
from warpslam.kernels.pixels import Camera, Draw, Images, Pixels, measured
from warpslam.kernels.samples import Rays, sample_point

MODULE = "warpslam.supervision"
"""The direct loss, its samples and its optimiser compile as one Warp module."""

wp.get_module(MODULE).options.update({"enable_backward": False, "max_unroll": 4, "block_dim": 32})


@wp.struct
class Target:
    """Constants of the loss, by their names in the equations above.

    slope: k [1/m]. front, behind: f and b [m]. huber: delta. behind_weight: w_b. color_weight: lambda. color_reach: r
    [m]. color_huber: delta_c.
    """

    slope: float
    front: float
    behind: float
    huber: float
    behind_weight: float
    color_weight: float
    color_reach: float
    color_huber: float


@wp.struct
class Band:
    """How many samples a ray gets, and where.

    free: In strata of [0.05 D, D - front]; the first ``edge`` of them about the depth of a pixel up to ``radius`` px
        away, from ``edge_front`` before it to ``edge_behind`` behind it, where that is a surface before D - front.
    near: In strata of [D - front, D + behind]. One more, the last, lies at D. Lengths in m.
    """

    free: int
    edge: int
    near: int
    front: float
    behind: float
    radius: float
    edge_front: float
    edge_behind: float


@wp.func
def huber(e: float, delta: float) -> float:
    a = wp.abs(e)
    return wp.where(a <= delta, 0.5 * e * e / delta, a - 0.5 * delta)


@wp.func
def huber_derivative(e: float, delta: float) -> float:
    return wp.clamp(e / delta, -1.0, 1.0)


@wp.func
def sample_error(logit: float, s: float, target: Target) -> wp.vec2:
    """(e, w) of a sample; w = 0 where it has no term."""
    if s > target.behind:
        return wp.vec2(0.0, 0.0)
    if s < -target.front:
        return wp.vec2(wp.max(logit + target.slope * target.front, 0.0), 1.0)
    return wp.vec2(logit - target.slope * s, wp.where(s > 0.0, target.behind_weight, 1.0))


@wp.kernel(module=MODULE)
def place_band(
    start: int,
    draw: Draw,
    band: Band,
    camera: Camera,
    window: wp.array[int],
    images: Images,
    pixels: Pixels,
    keep: wp.array[int],
    z: wp.array[float],
):
    """Samples of each ray with a depth; rays without one are not kept. Not in the order of their depth."""
    tid = start + wp.tid()
    depth = pixels.depth[tid]
    count = band.free + band.near + 1
    if depth <= 0.0:
        keep[tid] = 0
    state = wp.rand_init(draw.seeds[draw.iteration[0]] ^ 0x5BD1E995, tid)
    near = 0.05 * depth
    far = wp.max(depth - band.front, near)
    for n in range(band.free):
        value = near + (float(n) + wp.randf(state)) / float(band.free) * (far - near)
        if n < band.edge:
            angle = 6.2831853 * wp.randf(state)
            radius = band.radius * wp.randf(state)
            offset = band.edge_behind * wp.randf(state) - band.edge_front * wp.randf(state)
            d = pixels.direction[tid]
            u = int(wp.rint(d[0] * camera.focal[0] + camera.center[0] + radius * wp.cos(angle)))
            v = int(wp.rint(d[1] * camera.focal[1] + camera.center[1] + radius * wp.sin(angle)))
            if u >= 0 and v >= 0 and u < images.depth.shape[2] and v < images.depth.shape[1]:
                # Beside an outline is where free space is most likely to be taken for occupied.
                other = measured(images, window[pixels.frame[tid]], u, v)
                if other > 0.0 and other < far:
                    value = wp.clamp(other + offset, near, far)
        z[tid * count + n] = value
    for n in range(band.near):
        s = (float(n) + wp.randf(state)) / float(band.near)
        z[tid * count + band.free + n] = depth - band.front + s * (band.front + band.behind)
    z[tid * count + count - 1] = depth


@wp.kernel(module=MODULE)
def list_colored(
    start: int, listed: Listed, rays: Rays, depth: wp.array[float], keep: wp.array[int], reach: float
):  # fmt: skip
    """List the samples of some rays that have a colour term."""
    tid = start + wp.tid()
    if keep[tid] == 0:
        return
    first = tid * rays.sample_count
    count = int(0)
    for n in range(rays.sample_count):
        if wp.abs(rays.z[first + n] - depth[tid]) <= reach:
            count += 1
    place = listed.start + wp.atomic_add(listed.counts, count_index(listed.slot), count)
    for n in range(rays.sample_count):
        if wp.abs(rays.z[first + n] - depth[tid]) <= reach:
            listed.samples[place] = first + n
            place += 1


@wp.kernel(module=MODULE)
def direct_loss(
    target: Target,
    with_color: int,
    rays: Rays,
    pixels: Pixels,
    keep: wp.array[int],
    logit: wp.array[float],
    color: wp.array[wp.vec3],
    loss: wp.array[float],
):
    """Adds the terms of each ray to the loss."""
    tid = wp.tid()
    if keep[tid] == 0:
        return
    total = float(0.0)
    for n in range(rays.sample_count):
        i = tid * rays.sample_count + n
        s = rays.z[i] - pixels.depth[tid]
        term = sample_error(logit[i], s, target)
        total += term[1] * huber(term[0], target.huber)
        if with_color != 0 and wp.abs(s) <= target.color_reach:
            e = color[i] - pixels.rgb[tid]
            total += target.color_weight * (
                huber(e[0], target.color_huber) + huber(e[1], target.color_huber) + huber(e[2], target.color_huber)
            )
    wp.atomic_add(loss, 0, total)


@wp.kernel(module=MODULE)
def direct_loss_backward(
    start: int,
    steep: Listed,
    target: Target,
    with_color: int,
    rays: Rays,
    pixels: Pixels,
    keep: wp.array[int],
    logit: wp.array[float],
    color: wp.array[wp.vec3],
    loss_grad: wp.array[float],
    logit_grad: wp.array[float],
    color_grad: wp.array[wp.vec3],
):
    """Derivatives by the logit and the colour of each sample. Also empties the list that `list_steep` fills next."""
    tid = start + wp.tid()
    if wp.tid() == 0:
        steep.counts[count_index(steep.slot)] = 0
    for n in range(rays.sample_count):
        i = tid * rays.sample_count + n
        by_logit = float(0.0)
        by_color = wp.vec3()
        if keep[tid] != 0:
            s = rays.z[i] - pixels.depth[tid]
            term = sample_error(logit[i], s, target)
            by_logit = loss_grad[0] * term[1] * huber_derivative(term[0], target.huber)
            if with_color != 0 and wp.abs(s) <= target.color_reach:
                e = color[i] - pixels.rgb[tid]
                scale = loss_grad[0] * target.color_weight
                by_color = scale * wp.vec3(
                    huber_derivative(e[0], target.color_huber),
                    huber_derivative(e[1], target.color_huber),
                    huber_derivative(e[2], target.color_huber),
                )
        logit_grad[i] = by_logit
        if with_color != 0:
            color_grad[i] = by_color


@wp.kernel(module=MODULE)
def probe_errors(
    first_current: int,
    target: Target,
    largest: float,
    young_error: float,
    young_updates: float,
    lattice: Lattice,
    updates: wp.array[int],
    rays: Rays,
    keep: wp.array[int],
    logit: wp.array[float],
    cumulative_error: wp.array2d[float],
):
    """Running sums of the errors of cells for each frame of a window, one probed ray a cell.

    A ray has two samples, one in free space and one where it measures. It errs by |e| / slope of each, at most
    ``largest`` [m], and by ``young_error`` more if one of the vertices around the second was never updated, falling to
    none at ``young_updates``. The probe is that of the current frame, which the window repeats from ``first_current``
    on; of the frames before it nothing is known, and all cells are alike.
    """
    f = wp.tid()
    total = float(0.0)
    for cell in range(cumulative_error.shape[1]):
        if f < first_current:
            total += 1.0
        else:
            # Where nothing errs, all cells are alike.
            total += 1.0e-6
            if keep[cell] != 0:
                i = 2 * cell
                free = sample_error(logit[i], rays.z[i] - rays.z[i + 1], target)[0]
                total += wp.min(wp.abs(free) / target.slope, largest)
                total += wp.min(wp.abs(logit[i + 1]) / target.slope, largest)
                least = float(young_updates)
                corner = find_cell(lattice, sample_point(i + 1, rays)).corner
                for di in range(2):
                    for dj in range(2):
                        for dk in range(2):
                            row = row_of(lattice, corner[0] + di, corner[1] + dj, corner[2] + dk)
                            least = wp.min(least, float(updates[row]))
                total += young_error * (1.0 - least / young_updates)
        cumulative_error[f, cell] = total
