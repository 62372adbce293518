"""Samples along rays (Sec. 3.3, "stratified and near-surface sampling"; constants of the released code).

Along a kept ray, with s in [0, 1] evenly spaced and D_max the largest D of the kept rays of the batch:

    32 over [near, far]: near = 0.01 D, far = clamp(t_exit + 0.01, 0, 1.2 D_max); without depth near = 0.01, far =
    t_exit + 0.01
    16 near the surface: D > 0: [0.95 D, 1.05 D]; D = 0: [0.001, D_max]

merged in ascending order into ``z``, shape (ray_count * sample_count,). Gradients never reach z.
"""

import warp as wp

from warpslam.kernels.pixels import MODULE, Draw


@wp.struct
class Rays:
    """Rays o + z d, and the depths of their samples: sample n of ray r is number ``r * sample_count + n``.

    origin, direction: (rays,), world axes. z: (rays * sample_count,).
    """

    sample_count: int
    origin: wp.array[wp.vec3]
    direction: wp.array[wp.vec3]
    z: wp.array[float]


@wp.struct
class Span:
    """Samples of a launch: ``first_sample`` to ``first_sample + width`` of the rays from ``first_ray`` on."""

    point_count: int
    first_ray: int
    first_sample: int
    width: int


@wp.struct
class Placement:
    """How many samples a ray gets over its length and near the surface, whether they are random, and whether depth
    places them.
    """

    stratified: int
    surface: int
    jitter: int
    use_depth: int


@wp.func
def sample_index(point: int, span: Span, sample_count: int) -> int:
    """Sample of a point of a launch."""
    return (span.first_ray + point // span.width) * sample_count + span.first_sample + point % span.width


@wp.func
def sample_point(sample: int, rays: Rays) -> wp.vec3:
    """Where a sample lies [m]."""
    ray = sample // rays.sample_count
    return rays.origin[ray] + rays.z[sample] * rays.direction[ray]


@wp.func
def fraction(k: int, count: int, jitter: int, state: wp.uint32) -> float:
    """s of sample k of ``count``: even, or (Sec. 3.3) uniform between the midpoints to its neighbours."""
    s = float(k) / float(count - 1)
    if jitter != 0:
        step = 1.0 / float(count - 1)
        low = wp.max(s - 0.5 * step, 0.0)
        high = wp.min(s + 0.5 * step, 1.0)
        random = wp.rand_init(int(state), k)
        s = low + (high - low) * wp.randf(random)
    return s


@wp.func
def stratum(k: int, count: int, near: float, far: float, jitter: int, state: wp.uint32) -> float:
    s = fraction(k, count, jitter, state)
    return near * (1.0 - s) + far * s


@wp.func
def surface_sample(k: int, count: int, depth: float, max_depth: float, jitter: int, state: wp.uint32) -> float:
    # Other random numbers than those of the strata.
    s = fraction(k, count, jitter, state + wp.uint32(1000003))
    if depth > 0.0:
        return 0.95 * depth * (1.0 - s) + 1.05 * depth * s
    return 0.001 * (1.0 - s) + max_depth * s


@wp.func
def place_ray(
    tid: int, placement: Placement, near: float, far: float, depth: float, max_depth: float, state: wp.uint32,
    z: wp.array[float],
):  # fmt: skip
    # Both sequences ascend, so that sorting is one merge.
    count = placement.stratified
    surface_count = placement.surface
    jitter = placement.jitter
    total = count + surface_count
    a = int(0)
    b = int(0)
    za = stratum(0, count, near, far, jitter, state)
    zb = float(0.0)
    if surface_count > 0:
        zb = surface_sample(0, surface_count, depth, max_depth, jitter, state)
    for n in range(total):
        take_a = a < count
        if take_a and b < surface_count:
            take_a = za <= zb
        if take_a:
            z[tid * total + n] = za
            a += 1
            if a < count:
                za = stratum(a, count, near, far, jitter, state)
        else:
            z[tid * total + n] = zb
            b += 1
            if b < surface_count:
                zb = surface_sample(b, surface_count, depth, max_depth, jitter, state)


@wp.kernel(module=MODULE, enable_backward=False)
def place_samples(
    start: int,
    draw: Draw,
    placement: Placement,
    depth: wp.array[float],
    t_exit: wp.array[float],
    keep: wp.array[int],
    max_depth: wp.array[float],
    z: wp.array[float],
):
    tid = start + wp.tid()
    if keep[tid] == 0:
        return
    near = float(0.01)
    far = t_exit[tid] + 0.01
    largest = float(0.0)
    measured = float(0.0)
    if placement.use_depth != 0:
        measured = depth[tid]
        largest = max_depth[0]
        near = 0.01 * measured
        far = wp.clamp(far, 0.0, 1.2 * largest)
    state = wp.rand_init(draw.seeds[draw.iteration[0]] ^ 0x5BD1E995, tid)
    place_ray(tid, placement, near, far, measured, largest, state, z)
