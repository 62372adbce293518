"""How the residuals of a pair change with the delay of depth and with the readout time.

A pair is a keyframe's points and a frame. T takes points from the axes of one to those of the other, u_k and u_c are
the twists of the camera at the two. Depth that is taken ``delay`` later, and rows that are read over ``readout`` more,
move the keyframe's points against the frame by

    geometric residual    delay (Ad_T u_k - u_c) + readout (s_k Ad_T u_k - s_c u_c)
    photometric residual                           readout (s_k Ad_T u_k - s_c u_c)

with s, from -1/2 to 1/2, the row's place in the image of the keyframe and of the frame. Delay leaves the photometric
residual as it is, to first order: a point has the grey value of the place where it falls in the colour image.

J = [pose (6), gain, bias, delay, readout, residual]; a pair's sums are those of w J J^T.
"""

import warp as wp

from warpslam.kernels.direct.equations import (
    _GROUP_SUM,
    DEPTH_COUNT,
    GREY_COUNT,
    SUM_BOTH,
    SUM_GREY,
    SUM_KEY,
    SUM_KEY2,
    Vec6,
    Vec16,
    depth_at,
    depth_sigma,
    evaluate,
    scaled,
    student,
)
from warpslam.kernels.direct.images import Images, Level
from warpslam.kernels.direct.points import MIN_DEPTH, Motion, Points, bilinear, inside, rolled
from warpslam.kernels.direct.registration import Floors, with_scales

MODULE = "warpslam.timing"
wp.get_module(MODULE).options.update({"enable_backward": False, "max_unroll": 1, "block_dim": 32})

COLUMNS = 11
"""Of J."""
ENTRIES = COLUMNS * (COLUMNS + 1) // 2
Row = wp.types.vector(length=COLUMNS, dtype=wp.float32)
Entries = wp.types.vector(length=ENTRIES, dtype=wp.float32)
"""Lower triangle of w J J^T, row by row."""

_GREY_COUNT = wp.constant(GREY_COUNT)
_DEPTH_COUNT = wp.constant(DEPTH_COUNT)
_SUM_GREY = wp.constant(SUM_GREY)
_SUM_KEY = wp.constant(SUM_KEY)
_SUM_KEY2 = wp.constant(SUM_KEY2)
_SUM_BOTH = wp.constant(SUM_BOTH)


@wp.struct
class TimedPair:
    """A keyframe's points and the frame that they are evaluated in."""

    keyframe: int
    row: int
    T: wp.mat44
    frame_twist: Vec6
    """u_c [m/s, rad/s]."""
    keyframe_twist: Vec6
    """Ad_T u_k."""


@wp.struct
class TimedSums:
    """What a `TimedPair` comes to."""

    entries: Entries
    grey_count: float
    depth_count: float


@wp.func_native(_GROUP_SUM.replace("COUNT", str(ENTRIES)).replace("ENTRY", "x.c[i]"))
def group_sum_entries(x: Entries) -> Entries: ...


@wp.func_native(f"""
    #pragma unroll
    for (int i = 0; i < {COLUMNS}; ++i) {{
        const wp::float32 w_i = w * J.c[i];
        #pragma unroll
        for (int j = 0; j <= i; ++j) H.c[i * (i + 1) / 2 + j] += w_i * J.c[j];
    }}
    return H;
""")
def add_row(H: Entries, J: Row, w: wp.float32) -> Entries: ...


@wp.func
def along(twist: Vec6, p: wp.vec3) -> wp.vec3:
    """Velocity of a point that moves with a twist."""
    return wp.vec3(twist[0], twist[1], twist[2]) + wp.cross(wp.vec3(twist[3], twist[4], twist[5]), p)


@wp.func
def share_of(p: wp.vec3, level: Level) -> float:
    """Place of the row that a point falls into, from -1/2 at the first to 1/2 at the last."""
    return (level.fy * p[1] / p[2] + level.cy) / float(level.height) - 0.5


@wp.func
def exposure_of(counts: Vec16) -> wp.vec2:
    """Gain and bias of the frame against the keyframe."""
    n = wp.max(counts[_GREY_COUNT], 1.0)
    grey = counts[_SUM_GREY] / n
    key = counts[_SUM_KEY] / n
    spread = counts[_SUM_KEY2] / n - key * key
    gain = wp.clamp((counts[_SUM_BOTH] / n - grey * key) / wp.max(spread, 1.0), 0.3, 3.0)
    return wp.vec2(gain, grey - gain * key)


@wp.kernel(module=MODULE, enable_backward=False)
def sum_timing(
    levels: wp.array[Level],
    n: int,
    grey: float,
    depth: float,
    floors: Floors,
    points: Points,
    images: Images,
    motions: wp.array[Motion],
    pairs: wp.array[TimedPair],
    first: int,
    lanes: int,
    histograms: wp.array2d[int],
    sums: wp.array[TimedSums],
):
    """Pairs from number ``first`` on, ``lanes`` threads each: exposure, then scales, then the sums."""
    tid = wp.tid()
    number = first + tid // lanes
    lane = tid - (tid // lanes) * lanes
    pair = pairs[number]
    level = levels[n]
    motion = motions[pair.row]
    exposure = wp.vec2(1.0, 0.0)
    weights = with_scales(grey, depth, 20.0, 5.0)
    out = TimedSums()
    for look in range(2):
        found = evaluate(
            level,
            points,
            pair.keyframe,
            images,
            pair.row,
            motion,
            pair.T,
            exposure,
            weights,
            level.gate,
            1,
            lane,
            lanes,
            histograms[number],
        )
        weights = scaled(weights, found.counts, histograms[number], floors.grey, floors.depth)
        if look == 0:
            exposure = exposure_of(found.counts)
        else:
            out.grey_count = found.counts[_GREY_COUNT]
            out.depth_count = found.counts[_DEPTH_COUNT]
    H = Entries()
    G = motion.to_depth * pair.T
    for k in range(level.first_point + lane, level.first_point + level.points, lanes):
        X = points.position[pair.keyframe, k]
        if X[2] > 0.0:
            p = rolled(wp.transform_point(pair.T, X), level, motion)
            q = rolled(wp.transform_point(G, X), level, motion)
            if p[2] > MIN_DEPTH and q[2] > MIN_DEPTH:
                u = level.fx * p[0] / p[2] + level.cx
                v = level.fy * p[1] / p[2] + level.cy
                ud = level.fx * q[0] / q[2] + level.cx
                vd = level.fy * q[1] / q[2] + level.cy
                if inside(u, v, level):
                    key_share = share_of(X, level)
                    hidden = bool(False)
                    d = float(0.0)
                    if inside(ud, vd, level):
                        d = depth_at(images, pair.row, level, ud, vd)
                    if d > 0.0:
                        s = depth_sigma(q[2])
                        hidden = d < q[2] - wp.max(level.gate, wp.max(6.0 * s, 0.02 * q[2]))
                        normal = wp.transform_vector(G, points.normal[pair.keyframe, k])
                        if wp.abs(d - q[2]) < wp.max(level.gate, 4.0 * s) and wp.dot(normal, normal) > 0.5:
                            P = (d / q[2]) * q
                            r = wp.dot(normal, P - q) / s
                            a = wp.cross(P, normal)
                            own = along(pair.frame_twist, P)
                            keyframes = along(pair.keyframe_twist, P)
                            late = keyframes - own
                            rows = key_share * keyframes - share_of(q, level) * own
                            J = Row(
                                -normal[0], -normal[1], -normal[2], -a[0], -a[1], -a[2], 0.0, 0.0,
                                -wp.dot(normal, late), -wp.dot(normal, rows), r * s,
                            ) / s  # fmt: skip
                            ratio = r / weights.depth_scale
                            w = weights.depth * student(ratio) / (weights.depth_scale * weights.depth_scale)
                            H = add_row(H, J, w)
                    if weights.grey > 0.0 and not hidden:
                        shade = bilinear(images, pair.row, level, u, v)
                        key = points.grey[pair.keyframe, k]
                        r = shade[0] - exposure[0] * key - exposure[1]
                        jx = shade[1] * level.fx / p[2]
                        jy = shade[2] * level.fy / p[2]
                        j = wp.vec3(jx, jy, -(jx * p[0] + jy * p[1]) / p[2])
                        a = wp.cross(p, j)
                        own = along(pair.frame_twist, p)
                        keyframes = along(pair.keyframe_twist, p)
                        rows = key_share * keyframes - share_of(p, level) * own
                        J = Row(j[0], j[1], j[2], a[0], a[1], a[2], -key, -1.0, 0.0, wp.dot(j, rows), r)
                        ratio = r / weights.grey_scale
                        w = weights.grey * student(ratio) / (weights.grey_scale * weights.grey_scale)
                        H = add_row(H, J, w)
    out.entries = group_sum_entries(H)
    if lane == 0:
        sums[number] = out
