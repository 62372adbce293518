"""Residuals of a keyframe's points in another frame, and their normal equations.

T takes points from the keyframe's axes to those of the frame, T <- exp(xi) T with xi = (v, w); a and b are gain and
bias of the pair's exposure.

    photometric  r = I(pi(T X)) - (a I_k + b)
                 J = [j, (T X) x j, -I_k, -1],   j = (gx fx/z, gy fy/z, -(gx fx x + gy fy y)/z^2)
    geometric    r = (R n) . (P - T X) / s(z),   P = the frame's depth on the ray of T X
                 J = [-n, -(P x n)] / s,         s(z) = 0.0012 + 0.0019 (z - 0.4)^2  [m]

Both are weighted as residuals of a t-distribution with five degrees of freedom, w = 6 / (5 + (r/S)^2) / S^2, each kind
by its own scale S: 1.4826 times the median of |r| as it was at the last evaluation. Where the camera moved while it
took the image, the geometric residual uses G = V^-1 T in place of T, and both shift by the row
(`warpslam.kernels.direct.points`).

A group of ``lanes`` threads sums over the points and has the same result in each: a warp of CUDA, or one thread.
"""

import warp as wp

from warpslam.kernels.direct.images import Images, Level
from warpslam.kernels.direct.points import MIN_DEPTH, Motion, Points, bilinear, inside, rolled

Mat66 = wp.types.matrix(shape=(6, 6), dtype=wp.float32)
Mat88 = wp.types.matrix(shape=(8, 8), dtype=wp.float32)
Vec6 = wp.types.vector(length=6, dtype=wp.float32)
Vec8 = wp.types.vector(length=8, dtype=wp.float32)
Vec16 = wp.types.vector(length=16, dtype=wp.float32)
Triangle = wp.types.vector(length=36, dtype=wp.float32)
"""Lower triangle of a symmetric matrix (8, 8), row by row."""
Mat88d = wp.types.matrix(shape=(8, 8), dtype=wp.float64)
Vec8d = wp.types.vector(length=8, dtype=wp.float64)

WARP = 32
"""Threads of a group on CUDA."""

# Positions in the counts of an evaluation.
COST, IN_VIEW, GREY_COUNT, DEPTH_COUNT, AGREE, IN_FRONT, BEHIND, POINTS = range(8)
SUM_GREY, SUM_KEY, SUM_GREY2, SUM_KEY2, SUM_BOTH = range(8, 13)
GREY_SCALE, DEPTH_SCALE = 13, 14
"""Where a record keeps the scales of the residuals."""

BINS = 128
"""Of a histogram of |r|: one for grey values and one for depth lie one after the other."""
GREY_BIN = 0.5
"""[grey values]"""
DEPTH_BIN = 0.1
"""[s(z)]"""

_COST = wp.constant(COST)
_IN_VIEW = wp.constant(IN_VIEW)
_GREY_COUNT = wp.constant(GREY_COUNT)
_DEPTH_COUNT = wp.constant(DEPTH_COUNT)
_AGREE = wp.constant(AGREE)
_IN_FRONT = wp.constant(IN_FRONT)
_BEHIND = wp.constant(BEHIND)
_POINTS = wp.constant(POINTS)
_BINS = wp.constant(BINS)
_GREY_BIN = wp.constant(GREY_BIN)
_DEPTH_BIN = wp.constant(DEPTH_BIN)
_MIN_COUNT = wp.constant(20)


@wp.struct
class Weights:
    """How much the two kinds of residuals count, and what they are measured by."""

    grey: float
    depth: float
    grey_scale: float
    depth_scale: float


@wp.struct
class Sums:
    """What an evaluation comes to."""

    H: Mat88
    g: Vec8
    counts: Vec16


# Unrolled here and not by Warp, so that the sums stay in registers.
_GROUP_SUM = """
#if defined(__CUDA_ARCH__)
    #pragma unroll
    for (int i = 0; i < COUNT; ++i) {
        #pragma unroll
        for (int k = 16; k > 0; k >>= 1) ENTRY += __shfl_xor_sync(0xffffffffu, ENTRY, k);
    }
#endif
    return x;
"""


@wp.func_native(_GROUP_SUM.replace("COUNT", "36").replace("ENTRY", "x.c[i]"))
def group_sum_triangle(x: Triangle) -> Triangle: ...


@wp.func_native("""
    #pragma unroll
    for (int i = 0; i < 8; ++i) {
        const wp::float32 w_i = w * J.c[i];
        #pragma unroll
        for (int j = 0; j <= i; ++j) H.c[i * (i + 1) / 2 + j] += w_i * J.c[j];
    }
    return H;
""")
def add_outer(H: Triangle, J: Vec8, w: wp.float32) -> Triangle: ...


@wp.func_native("""
    wp::mat_t<8, 8, wp::float32> A;
    #pragma unroll
    for (int i = 0; i < 8; ++i)
        #pragma unroll
        for (int j = 0; j < 8; ++j) A.data[i][j] = i < j ? H.c[j * (j + 1) / 2 + i] : H.c[i * (i + 1) / 2 + j];
    return A;
""")
def whole(H: Triangle) -> Mat88: ...


@wp.func_native(_GROUP_SUM.replace("COUNT", "8").replace("ENTRY", "x.c[i]"))
def group_sum_vector(x: Vec8) -> Vec8: ...


@wp.func_native(_GROUP_SUM.replace("COUNT", "16").replace("ENTRY", "x.c[i]"))
def group_sum_counts(x: Vec16) -> Vec16: ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __syncwarp();
#endif
""")
def group_wait(): ...


@wp.func
def depth_sigma(z: float) -> float:
    """Standard deviation of a structured-light sensor [m]."""
    return 0.0012 + 0.0019 * (z - 0.4) * (z - 0.4)


@wp.func
def depth_at(images: Images, row: int, level: Level, u: float, v: float) -> float:
    """Between four pixels of one surface, else that of the nearest."""
    iu = int(u)
    iv = int(v)
    i = level.first + iv * level.width + iu
    d00 = images.depth[row, i]
    d01 = images.depth[row, i + 1]
    d10 = images.depth[row, i + level.width]
    d11 = images.depth[row, i + level.width + 1]
    least = wp.min(wp.min(d00, d01), wp.min(d10, d11))
    if least > 0.0 and wp.max(wp.max(d00, d01), wp.max(d10, d11)) < 1.02 * least + 0.005:
        a = u - float(iu)
        b = v - float(iv)
        return (1.0 - b) * ((1.0 - a) * d00 + a * d01) + b * ((1.0 - a) * d10 + a * d11)
    return images.depth[row, level.first + int(v + 0.5) * level.width + int(u + 0.5)]


@wp.func
def student(ratio: float) -> float:
    """Weight of a residual ``ratio`` scales large, times the squared scale."""
    return 6.0 / (5.0 + ratio * ratio)


@wp.func
def student_cost(ratio: float) -> float:
    return 3.0 * wp.log(1.0 + 0.2 * ratio * ratio)


@wp.func
def evaluate(
    level: Level,
    points: Points,
    keyframe: int,
    images: Images,
    row: int,
    motion: Motion,
    T: wp.mat44,
    exposure: wp.vec2,
    weights: Weights,
    gate: float,
    stride: int,
    lane: int,
    lanes: int,
    bins: wp.array[int],
) -> Sums:
    """Normal equations of a pair at one level, over every ``stride``-th point; ``bins`` gets the histograms of the
    residuals.
    """
    H = Triangle()
    g = Vec8()
    counts = Vec16()
    G = motion.to_depth * T
    for k in range(lane, 2 * _BINS, lanes):
        bins[k] = 0
    group_wait()
    for k in range(level.first_point + stride * lane, level.first_point + level.points, stride * lanes):
        X = points.position[keyframe, k]
        if X[2] <= 0.0:
            continue
        counts[_POINTS] += 1.0
        p = wp.transform_point(T, X)
        q = wp.transform_point(G, X)
        if p[2] < MIN_DEPTH or q[2] < MIN_DEPTH:
            continue
        p = rolled(p, level, motion)
        q = rolled(q, level, motion)
        if p[2] < MIN_DEPTH or q[2] < MIN_DEPTH:
            continue
        u = level.fx * p[0] / p[2] + level.cx
        v = level.fy * p[1] / p[2] + level.cy
        if not inside(u, v, level):
            continue
        counts[_IN_VIEW] += 1.0
        depth = float(0.0)
        ud = level.fx * q[0] / q[2] + level.cx
        vd = level.fy * q[1] / q[2] + level.cy
        if inside(ud, vd, level):
            depth = depth_at(images, row, level, ud, vd)
        hidden = bool(False)
        if depth > 0.0:
            s = depth_sigma(q[2])
            margin = wp.max(6.0 * s, 0.02 * q[2])
            if depth < q[2] - margin:
                counts[_IN_FRONT] += 1.0
            elif depth > q[2] + margin:
                counts[_BEHIND] += 1.0
            else:
                counts[_AGREE] += 1.0
            hidden = depth < q[2] - wp.max(gate, margin)
            if weights.depth > 0.0 and wp.abs(depth - q[2]) < wp.max(gate, 4.0 * s):
                n = wp.transform_vector(G, points.normal[keyframe, k])
                if wp.dot(n, n) > 0.5:
                    P = (depth / q[2]) * q
                    r = wp.dot(n, P - q) / s
                    ratio = r / weights.depth_scale
                    turn = wp.cross(P, n)
                    J = Vec8(-n[0], -n[1], -n[2], -turn[0], -turn[1], -turn[2], 0.0, 0.0) / s
                    w = weights.depth * student(ratio) / (weights.depth_scale * weights.depth_scale)
                    H = add_outer(H, J, w)
                    g += (w * r) * J
                    counts[_DEPTH_COUNT] += 1.0
                    counts[_COST] += weights.depth * student_cost(ratio)
                    wp.atomic_add(bins, _BINS + wp.clamp(int(wp.abs(r) / _DEPTH_BIN), 0, _BINS - 1), 1)
        if weights.grey > 0.0 and not hidden:
            shade = bilinear(images, row, level, u, v)
            key = points.grey[keyframe, k]
            r = shade[0] - exposure[0] * key - exposure[1]
            ratio = r / weights.grey_scale
            jx = shade[1] * level.fx / p[2]
            jy = shade[2] * level.fy / p[2]
            j = wp.vec3(jx, jy, -(jx * p[0] + jy * p[1]) / p[2])
            turn = wp.cross(p, j)
            J = Vec8(j[0], j[1], j[2], turn[0], turn[1], turn[2], -key, -1.0)
            w = weights.grey * student(ratio) / (weights.grey_scale * weights.grey_scale)
            H = add_outer(H, J, w)
            g += (w * r) * J
            counts[_GREY_COUNT] += 1.0
            counts[_COST] += weights.grey * student_cost(ratio)
            counts[8] += shade[0]
            counts[9] += key
            counts[10] += shade[0] * shade[0]
            counts[11] += key * key
            counts[12] += shade[0] * key
            wp.atomic_add(bins, wp.clamp(int(wp.abs(r) / _GREY_BIN), 0, _BINS - 1), 1)
    group_wait()
    sums = Sums()
    sums.H = whole(group_sum_triangle(H))
    sums.g = group_sum_vector(g)
    sums.counts = group_sum_counts(counts)
    return sums


@wp.func
def median_of(bins: wp.array[int], first: int, width: float, count: float) -> float:
    """Median of the values in a histogram, between the edges of its bin."""
    half = 0.5 * count
    below = float(0.0)
    k = int(0)
    n = float(bins[first])
    while k < _BINS - 1 and below + n < half:
        below += n
        k += 1
        n = float(bins[first + k])
    return width * (float(k) + (half - below) / wp.max(n, 1.0))


@wp.func
def scaled(weights: Weights, counts: Vec16, bins: wp.array[int], least_grey: float, least_depth: float) -> Weights:
    """The weights with the scales of the last evaluation."""
    new = Weights()
    new.grey = weights.grey
    new.depth = weights.depth
    new.grey_scale = 20.0
    new.depth_scale = 5.0
    if counts[_GREY_COUNT] > float(_MIN_COUNT):
        new.grey_scale = wp.max(least_grey, 1.4826 * median_of(bins, 0, _GREY_BIN, counts[_GREY_COUNT]))
    if counts[_DEPTH_COUNT] > float(_MIN_COUNT):
        new.depth_scale = wp.max(least_depth, 1.4826 * median_of(bins, _BINS, _DEPTH_BIN, counts[_DEPTH_COUNT]))
    return new


@wp.func
def solve8(H: Mat88, g: Vec8) -> Vec8:
    """Solution of H x = g by L D L^T; H is damped, so that no pivot vanishes."""
    L = Mat88d()
    D = Vec8d()
    y = Vec8d()
    for i in range(8):
        for j in range(i):
            s = wp.float64(H[i, j])
            for k in range(j):
                s -= L[i, k] * L[j, k] * D[k]
            L[i, j] = s / D[j]
        d = wp.float64(H[i, i])
        t = wp.float64(g[i])
        for k in range(i):
            d -= L[i, k] * L[i, k] * D[k]
            t -= L[i, k] * y[k]
        D[i] = wp.max(d, wp.float64(1.0e-12))
        y[i] = t
    x = Vec8()
    for m in range(8):
        i = 7 - m
        t = y[i] / D[i]
        for k in range(i + 1, 8):
            t -= L[k, i] * wp.float64(x[k])
        x[i] = float(t)
    return x


@wp.func
def exponential(v: wp.vec3, w: wp.vec3) -> wp.mat44:
    """exp of a twist."""
    angle = wp.length(w)
    a = float(1.0)
    b = float(0.5)
    c = float(1.0 / 6.0)
    if angle > 1.0e-3:
        a = wp.sin(angle) / angle
        half = wp.sin(0.5 * angle) / angle
        b = 2.0 * half * half
        c = (1.0 - a) / (angle * angle)
    W = wp.skew(w)
    W2 = W * W
    identity = wp.identity(n=3, dtype=float)
    R = identity + a * W + b * W2
    t = (identity + b * W + c * W2) * v
    return rigid(R, t)


@wp.func
def rigid(R: wp.mat33, t: wp.vec3) -> wp.mat44:
    return wp.mat44(
        R[0, 0], R[0, 1], R[0, 2], t[0],
        R[1, 0], R[1, 1], R[1, 2], t[1],
        R[2, 0], R[2, 1], R[2, 2], t[2],
        0.0, 0.0, 0.0, 1.0,
    )  # fmt: skip


@wp.func
def rotation_of(T: wp.mat44) -> wp.mat33:
    return wp.mat33(T[0, 0], T[0, 1], T[0, 2], T[1, 0], T[1, 1], T[1, 2], T[2, 0], T[2, 1], T[2, 2])


@wp.func
def translation_of(T: wp.mat44) -> wp.vec3:
    return wp.vec3(T[0, 3], T[1, 3], T[2, 3])


@wp.func
def inverted(T: wp.mat44) -> wp.mat44:
    """Inverse of a rigid transform."""
    R = wp.transpose(rotation_of(T))
    return rigid(R, -(R * translation_of(T)))


@wp.func
def rectified(T: wp.mat44) -> wp.mat44:
    """The rigid transform next to one whose rotation is nearly one, by two steps of Newton's iteration.

    Without it errors would grow with every product.
    """
    R = rotation_of(T)
    identity = wp.identity(n=3, dtype=float)
    R = 0.5 * R * (3.0 * identity - wp.transpose(R) * R)
    R = 0.5 * R * (3.0 * identity - wp.transpose(R) * R)
    return rigid(R, translation_of(T))


@wp.func
def logarithm(T: wp.mat44) -> Vec6:
    """Twist (v, w) of a motion of less than half a turn."""
    R = rotation_of(T)
    t = translation_of(T)
    vee = 0.5 * wp.vec3(R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1])
    s = wp.length(vee)
    angle = wp.atan2(s, 0.5 * (R[0, 0] + R[1, 1] + R[2, 2] - 1.0))
    w = vee
    c = float(1.0 / 12.0)
    if s > 1.0e-3:
        w = (angle / s) * vee
        c = (1.0 - 0.5 * angle * s / (1.0 - wp.cos(angle))) / (angle * angle)
    cross = wp.cross(w, t)
    v = t - 0.5 * cross + c * wp.cross(w, cross)
    return Vec6(v[0], v[1], v[2], w[0], w[1], w[2])
