"""The decoders (Sec. 3.1; SPEC of the released code): grid lookup, Fourier embedding and MLP, forward and adjoint.

Middle, fine and colour, with e = sin(p B) in R^93 and the looked-up feature c (32; fine: [fine, middle], 64):

    h = e;  for k = 0..4:  h = relu(W_k h + b_k) + V_k c + d_k;  after k = 2: h = [e, h]
    out = W_o h + b_o

Coarse has no embedding and no V_k:  h = c;  h = relu(W_k h + b_k);  after k = 2: h = [c, h].

One thread a point; a forward launch covers some samples of each ray, and skips rays whose transmittance is spent. A
weight matrix is stored as rows of `Vec32`, row k holding what input k adds to the 32 outputs, so that a layer is
``r += x[k] * W[k]`` and vectorises over the outputs; the adjoint uses the same rows of the transposed matrices. The
forward keeps one bit per ReLU (5 words a point and decoder); the adjoint kernels are written by hand, because the
generated adjoint replays the forward and costs 4 to 16 times as much. They return

    d_logit -> rows of the grid that are selected (``grid_grad``), the sample position (``point_grad``), and for the
    colour decoder
    the weights including B (``weight_grad``).

As in the released code the middle feature that enters the fine decoder carries no gradient.

The CPU backend wants constant trip counts and four accumulation chains, CUDA rolled loops and one chain:
`decoder_kernels`
builds either from this one source.
"""

from types import SimpleNamespace

import warp as wp

from warpslam.kernels.grid import (
    Lattice,
    Vec32,
    find_cell,
    interpolate,
    interpolate_adjoint_features,
    interpolate_adjoint_point,
)

# Rows of the packed weights of a decoder with coordinates (warpslam.field packs them).
B = 0  # 3 chunks x 3 axes
E0 = 9  # embedding -> layer 0, 96 rows (93 used)
E3 = 105  # embedding -> layer 3
W1 = 201
W2 = 233
W3 = 265
W4 = 297
BIAS = 329  # b_0..b_4
FC_BIAS = 334  # d_0..d_4
V = 339  # V_0..V_4, 32 rows each (fine: 64)
OUT_32 = V + 160  # output weights, then one row of output biases
OUT_64 = V + 320

# Rows of the transposed weights.
E0_T = 0
E3_T = 96
W1_T = 192
W2_T = 224
W3_T = 256
W4_T = 288
V_T = 320  # V_k^T, only the part of the level's own feature

# Rows of the packed and of the transposed weights of the coarse decoder.
C_W0 = 0
C_W1 = 32
C_W2 = 64
C_C3 = 96
C_W3 = 128
C_W4 = 160
C_BIAS = 192
C_OUT = 197

COLOR_WEIGHT_ROWS = OUT_32 + 4
MASK_WORDS = 5


@wp.func
def sine_cosine(x: float) -> wp.vec2:
    """(sin x, cos x) by range reduction to [-pi/2, pi/2] and polynomials; absolute error < 3e-7 for |x| < 1e4."""
    # Adding 1.5 * 2^23 rounds to the nearest integer without a library call, which keeps the loop over channels
    # vectorised.
    n = (x * 0.31830988618 + 12582912.0) - 12582912.0
    r = x - n * 3.140625
    r = r - n * 0.0009675025939941406
    r = r - n * 1.5099579909783765e-07
    half = (n * 0.5 + 12582912.0) - 12582912.0
    odd = n - 2.0 * half
    sign = 1.0 - 2.0 * odd * odd
    q = r * r
    s = r + r * q * (-0.16666667 + q * (0.0083333310 + q * (-0.00019840874 + q * (2.7525562e-06 - q * 2.3889859e-08))))
    c = 1.0 + q * (-0.5 + q * (0.041666642 + q * (-0.0013888397 + q * (2.4760495e-05 - q * 2.6051615e-07))))
    return wp.vec2(sign * s, sign * c)


@wp.func
def angles(p: wp.vec3, weights: wp.array(dtype=Vec32), chunk: int) -> Vec32:
    return p[0] * weights[B + 3 * chunk] + p[1] * weights[B + 3 * chunk + 1] + p[2] * weights[B + 3 * chunk + 2]


@wp.func
def sine32(a: Vec32) -> Vec32:
    e = Vec32()
    for i in range(32):
        e[i] = sine_cosine(a[i])[0]
    return e


@wp.func
def cosine32(a: Vec32) -> Vec32:
    e = Vec32()
    for i in range(32):
        e[i] = sine_cosine(a[i])[1]
    return e


@wp.func
def sum32(a: Vec32) -> float:
    s0 = float(0.0)
    s1 = float(0.0)
    s2 = float(0.0)
    s3 = float(0.0)
    for k in range(8):
        s0 += a[k]
        s1 += a[k + 8]
        s2 += a[k + 16]
        s3 += a[k + 24]
    return (s0 + s1) + (s2 + s3)


@wp.func
def relu_bits(a: Vec32) -> wp.uint32:
    bits = wp.uint32(0)
    for i in range(32):
        if a[i] > 0.0:
            bits |= wp.uint32(1) << wp.uint32(i)
    return bits


@wp.func
def relu32(a: Vec32) -> Vec32:
    r = Vec32()
    for i in range(32):
        r[i] = wp.max(a[i], 0.0)
    return r


@wp.func
def keep_bits(a: Vec32, bits: wp.uint32) -> Vec32:
    r = Vec32()
    for i in range(32):
        r[i] = wp.where((bits >> wp.uint32(i)) & wp.uint32(1) == wp.uint32(1), a[i], 0.0)
    return r


@wp.func
def sample_index(thread: int, first_ray: int, first_sample: int, width: int, sample_count: int) -> int:
    """Sample of a thread, where a launch covers samples ``first_sample`` to ``first_sample + width`` of some rays."""
    return (first_ray + thread // width) * sample_count + first_sample + thread % width


@wp.func
def sample_point(
    tid: int,
    sample_count: int,
    ray_origin: wp.array(dtype=wp.vec3),
    ray_direction: wp.array(dtype=wp.vec3),
    z: wp.array(dtype=float),
) -> wp.vec3:
    ray = tid // sample_count
    return ray_origin[ray] + z[tid] * ray_direction[ray]


def decoder_kernels(target: str) -> SimpleNamespace:
    """Kernels of all decoders for ``target`` "cpu" or "cuda", in the Warp module ``warpslam.decoder_<target>``."""
    unrolled = target == "cpu"
    module = f"warpslam.decoder_{target}"
    wp.get_module(module).options.update({"enable_backward": False, "max_unroll": 4})

    def kernel(f):
        return wp.kernel(f, module=module, name=f.__name__, enable_backward=False)

    def func(f):
        return wp.func(f, module=module, name=f.__name__)

    @func
    def matvec(r: Vec32, x: Vec32, W: wp.array(dtype=Vec32), row: int, trips: int) -> Vec32:
        """r + sum_k x[k] W[row + k]."""
        if wp.static(unrolled):
            r0 = Vec32(r)
            r1 = Vec32()
            r2 = Vec32()
            r3 = Vec32()
            for k in range(0, 32, 4):
                r0 += x[k] * W[row + k]
                r1 += x[k + 1] * W[row + k + 1]
                r2 += x[k + 2] * W[row + k + 2]
                r3 += x[k + 3] * W[row + k + 3]
            return (r0 + r1) + (r2 + r3)
        else:
            s = Vec32(r)
            for k in range(trips):
                s += x[k] * W[row + k]
            return s

    @func
    def add_outer(grad: wp.array2d(dtype=Vec32), slot: int, row: int, x: Vec32, d: Vec32):
        """grad[row + k] += x[k] d."""
        for k in range(32):
            wp.atomic_add(grad, slot, row + k, x[k] * d)

    @func
    def output_of(h: Vec32, W: wp.array(dtype=Vec32), row: int) -> float:
        return sum32(wp.cw_mul(h, W[row]))

    @kernel
    def middle_forward(
        first_ray: int,
        first_sample: int,
        width: int,
        trips: int,
        sample_count: int,
        ray_origin: wp.array(dtype=wp.vec3),
        ray_direction: wp.array(dtype=wp.vec3),
        z: wp.array(dtype=float),
        transmittance: wp.array(dtype=float),
        min_transmittance: float,
        lattice: Lattice,
        features: wp.array(dtype=Vec32),
        W: wp.array(dtype=Vec32),
        bits: wp.array2d(dtype=wp.uint32),
        logit: wp.array(dtype=float),
    ):
        tid = sample_index(wp.tid(), first_ray, first_sample, width, sample_count)
        if transmittance[tid // sample_count] < min_transmittance:
            return
        p = sample_point(tid, sample_count, ray_origin, ray_direction, z)
        c = interpolate(features, lattice, find_cell(lattice, p))
        a0 = Vec32(W[BIAS])
        a3 = Vec32(W[BIAS + 3])
        for chunk in range(3):
            e = sine32(angles(p, W, chunk))
            a0 = matvec(a0, e, W, E0 + 32 * chunk, trips)
            a3 = matvec(a3, e, W, E3 + 32 * chunk, trips)
        bits[tid, 0] = relu_bits(a0)
        h = relu32(a0) + matvec(W[FC_BIAS], c, W, V, trips)
        a = matvec(W[BIAS + 1], h, W, W1, trips)
        bits[tid, 1] = relu_bits(a)
        h = relu32(a) + matvec(W[FC_BIAS + 1], c, W, V + 32, trips)
        a = matvec(W[BIAS + 2], h, W, W2, trips)
        bits[tid, 2] = relu_bits(a)
        h = relu32(a) + matvec(W[FC_BIAS + 2], c, W, V + 64, trips)
        a = matvec(a3, h, W, W3, trips)
        bits[tid, 3] = relu_bits(a)
        h = relu32(a) + matvec(W[FC_BIAS + 3], c, W, V + 96, trips)
        a = matvec(W[BIAS + 4], h, W, W4, trips)
        bits[tid, 4] = relu_bits(a)
        h = relu32(a) + matvec(W[FC_BIAS + 4], c, W, V + 128, trips)
        logit[tid] = output_of(h, W, OUT_32) + W[OUT_32 + 1][0]

    @kernel
    def fine_forward(
        first_ray: int,
        first_sample: int,
        width: int,
        trips: int,
        sample_count: int,
        ray_origin: wp.array(dtype=wp.vec3),
        ray_direction: wp.array(dtype=wp.vec3),
        z: wp.array(dtype=float),
        transmittance: wp.array(dtype=float),
        min_transmittance: float,
        lattice: Lattice,
        features: wp.array(dtype=Vec32),
        middle_lattice: Lattice,
        middle_features: wp.array(dtype=Vec32),
        W: wp.array(dtype=Vec32),
        bits: wp.array2d(dtype=wp.uint32),
        logit: wp.array(dtype=float),
    ):
        tid = sample_index(wp.tid(), first_ray, first_sample, width, sample_count)
        if transmittance[tid // sample_count] < min_transmittance:
            return
        p = sample_point(tid, sample_count, ray_origin, ray_direction, z)
        c = interpolate(features, lattice, find_cell(lattice, p))
        m = interpolate(middle_features, middle_lattice, find_cell(middle_lattice, p))
        a0 = Vec32(W[BIAS])
        a3 = Vec32(W[BIAS + 3])
        for chunk in range(3):
            e = sine32(angles(p, W, chunk))
            a0 = matvec(a0, e, W, E0 + 32 * chunk, trips)
            a3 = matvec(a3, e, W, E3 + 32 * chunk, trips)
        bits[tid, 0] = relu_bits(a0)
        h = relu32(a0) + matvec(matvec(W[FC_BIAS], c, W, V, trips), m, W, V + 32, trips)
        a = matvec(W[BIAS + 1], h, W, W1, trips)
        bits[tid, 1] = relu_bits(a)
        h = relu32(a) + matvec(matvec(W[FC_BIAS + 1], c, W, V + 64, trips), m, W, V + 96, trips)
        a = matvec(W[BIAS + 2], h, W, W2, trips)
        bits[tid, 2] = relu_bits(a)
        h = relu32(a) + matvec(matvec(W[FC_BIAS + 2], c, W, V + 128, trips), m, W, V + 160, trips)
        a = matvec(a3, h, W, W3, trips)
        bits[tid, 3] = relu_bits(a)
        h = relu32(a) + matvec(matvec(W[FC_BIAS + 3], c, W, V + 192, trips), m, W, V + 224, trips)
        a = matvec(W[BIAS + 4], h, W, W4, trips)
        bits[tid, 4] = relu_bits(a)
        h = relu32(a) + matvec(matvec(W[FC_BIAS + 4], c, W, V + 256, trips), m, W, V + 288, trips)
        # Eq. 3: the fine level adds a residual to the logit of the middle level.
        logit[tid] = logit[tid] + output_of(h, W, OUT_64) + W[OUT_64 + 1][0]

    @kernel
    def geometry_backward(
        start: int,
        slot: int,
        trips: int,
        sample_count: int,
        ray_origin: wp.array(dtype=wp.vec3),
        ray_direction: wp.array(dtype=wp.vec3),
        z: wp.array(dtype=float),
        lattice: Lattice,
        features: wp.array(dtype=Vec32),
        W: wp.array(dtype=Vec32),
        T: wp.array(dtype=Vec32),
        output_row: int,
        bits: wp.array2d(dtype=wp.uint32),
        logit_grad: wp.array(dtype=float),
        min_gradient: float,
        want_grid: int,
        selected: wp.array(dtype=wp.uint8),
        grid_grad: wp.array2d(dtype=Vec32),
        want_point: int,
        point_grad: wp.array(dtype=wp.vec3),
    ):
        """Adjoint of `middle_forward` and of `fine_forward` (they differ in ``output_row``)."""
        tid = start + wp.tid()
        d = logit_grad[tid]
        if wp.abs(d) <= min_gradient:
            return
        p = sample_point(tid, sample_count, ray_origin, ray_direction, z)
        g = d * W[output_row]
        dc = matvec(Vec32(), g, T, V_T + 128, trips)
        a = keep_bits(g, bits[tid, 4])
        g = matvec(Vec32(), a, T, W4_T, trips)
        dc = matvec(dc, g, T, V_T + 96, trips)
        a3 = keep_bits(g, bits[tid, 3])
        g = matvec(Vec32(), a3, T, W3_T, trips)
        dc = matvec(dc, g, T, V_T + 64, trips)
        a = keep_bits(g, bits[tid, 2])
        g = matvec(Vec32(), a, T, W2_T, trips)
        dc = matvec(dc, g, T, V_T + 32, trips)
        a = keep_bits(g, bits[tid, 1])
        g = matvec(Vec32(), a, T, W1_T, trips)
        dc = matvec(dc, g, T, V_T, trips)
        cell = find_cell(lattice, p)
        if want_grid != 0:
            interpolate_adjoint_features(grid_grad, slot, selected, lattice, cell, dc)
        if want_point != 0:
            a0 = keep_bits(g, bits[tid, 0])
            dp = interpolate_adjoint_point(features, lattice, cell, dc)
            for chunk in range(3):
                da = matvec(matvec(Vec32(), a0, T, E0_T + 32 * chunk, trips), a3, T, E3_T + 32 * chunk, trips)
                da = wp.cw_mul(da, cosine32(angles(p, W, chunk)))
                dp += wp.vec3(
                    sum32(wp.cw_mul(da, W[B + 3 * chunk])),
                    sum32(wp.cw_mul(da, W[B + 3 * chunk + 1])),
                    sum32(wp.cw_mul(da, W[B + 3 * chunk + 2])),
                )
            point_grad[tid] = point_grad[tid] + dp

    @kernel
    def color_forward(
        first_ray: int,
        first_sample: int,
        width: int,
        trips: int,
        sample_count: int,
        ray_origin: wp.array(dtype=wp.vec3),
        ray_direction: wp.array(dtype=wp.vec3),
        z: wp.array(dtype=float),
        transmittance: wp.array(dtype=float),
        min_transmittance: float,
        lattice: Lattice,
        features: wp.array(dtype=Vec32),
        W: wp.array(dtype=Vec32),
        bits: wp.array2d(dtype=wp.uint32),
        want_activations: int,
        activations: wp.array2d(dtype=Vec32),
        weight: wp.array(dtype=float),
        min_weight: float,
        color: wp.array(dtype=wp.vec3),
    ):
        tid = sample_index(wp.tid(), first_ray, first_sample, width, sample_count)
        if transmittance[tid // sample_count] < min_transmittance:
            return
        if weight[tid] < min_weight:
            color[tid] = wp.vec3()
            return
        p = sample_point(tid, sample_count, ray_origin, ray_direction, z)
        c = interpolate(features, lattice, find_cell(lattice, p))
        a0 = Vec32(W[BIAS])
        a3 = Vec32(W[BIAS + 3])
        for chunk in range(3):
            e = sine32(angles(p, W, chunk))
            a0 = matvec(a0, e, W, E0 + 32 * chunk, trips)
            a3 = matvec(a3, e, W, E3 + 32 * chunk, trips)
        bits[tid, 0] = relu_bits(a0)
        h0 = relu32(a0) + matvec(W[FC_BIAS], c, W, V, trips)
        a = matvec(W[BIAS + 1], h0, W, W1, trips)
        bits[tid, 1] = relu_bits(a)
        h1 = relu32(a) + matvec(W[FC_BIAS + 1], c, W, V + 32, trips)
        a = matvec(W[BIAS + 2], h1, W, W2, trips)
        bits[tid, 2] = relu_bits(a)
        h2 = relu32(a) + matvec(W[FC_BIAS + 2], c, W, V + 64, trips)
        a = matvec(a3, h2, W, W3, trips)
        bits[tid, 3] = relu_bits(a)
        h3 = relu32(a) + matvec(W[FC_BIAS + 3], c, W, V + 96, trips)
        a = matvec(W[BIAS + 4], h3, W, W4, trips)
        bits[tid, 4] = relu_bits(a)
        h4 = relu32(a) + matvec(W[FC_BIAS + 4], c, W, V + 128, trips)
        if want_activations != 0:
            activations[tid, 0] = h0
            activations[tid, 1] = h1
            activations[tid, 2] = h2
            activations[tid, 3] = h3
            activations[tid, 4] = h4
        bias = W[OUT_32 + 3]
        # Channels 0..2, linear; the released code discards the fourth.
        color[tid] = wp.vec3(
            output_of(h4, W, OUT_32) + bias[0],
            output_of(h4, W, OUT_32 + 1) + bias[1],
            output_of(h4, W, OUT_32 + 2) + bias[2],
        )

    @kernel
    def color_backward(
        start: int,
        slot: int,
        trips: int,
        sample_count: int,
        ray_origin: wp.array(dtype=wp.vec3),
        ray_direction: wp.array(dtype=wp.vec3),
        z: wp.array(dtype=float),
        lattice: Lattice,
        features: wp.array(dtype=Vec32),
        W: wp.array(dtype=Vec32),
        T: wp.array(dtype=Vec32),
        bits: wp.array2d(dtype=wp.uint32),
        color_grad: wp.array(dtype=wp.vec3),
        want_grid: int,
        selected: wp.array(dtype=wp.uint8),
        grid_grad: wp.array2d(dtype=Vec32),
        want_point: int,
        point_grad: wp.array(dtype=wp.vec3),
        want_weights: int,
        activations: wp.array2d(dtype=Vec32),
        weight_grad: wp.array2d(dtype=Vec32),
        layer_grad: wp.array2d(dtype=Vec32),
    ):
        tid = start + wp.tid()
        d = color_grad[tid]
        if d[0] == 0.0 and d[1] == 0.0 and d[2] == 0.0:
            return
        p = sample_point(tid, sample_count, ray_origin, ray_direction, z)
        g4 = d[0] * W[OUT_32] + d[1] * W[OUT_32 + 1] + d[2] * W[OUT_32 + 2]
        dc = matvec(Vec32(), g4, T, V_T + 128, trips)
        a4 = keep_bits(g4, bits[tid, 4])
        g3 = matvec(Vec32(), a4, T, W4_T, trips)
        dc = matvec(dc, g3, T, V_T + 96, trips)
        a3 = keep_bits(g3, bits[tid, 3])
        g2 = matvec(Vec32(), a3, T, W3_T, trips)
        dc = matvec(dc, g2, T, V_T + 64, trips)
        a2 = keep_bits(g2, bits[tid, 2])
        g1 = matvec(Vec32(), a2, T, W2_T, trips)
        dc = matvec(dc, g1, T, V_T + 32, trips)
        a1 = keep_bits(g1, bits[tid, 1])
        g0 = matvec(Vec32(), a1, T, W1_T, trips)
        dc = matvec(dc, g0, T, V_T, trips)
        a0 = keep_bits(g0, bits[tid, 0])
        cell = find_cell(lattice, p)
        if want_grid != 0:
            interpolate_adjoint_features(grid_grad, slot, selected, lattice, cell, dc)
        if want_point != 0:
            dp = interpolate_adjoint_point(features, lattice, cell, dc)
            for chunk in range(3):
                da = matvec(matvec(Vec32(), a0, T, E0_T + 32 * chunk, trips), a3, T, E3_T + 32 * chunk, trips)
                da = wp.cw_mul(da, cosine32(angles(p, W, chunk)))
                dp += wp.vec3(
                    sum32(wp.cw_mul(da, W[B + 3 * chunk])),
                    sum32(wp.cw_mul(da, W[B + 3 * chunk + 1])),
                    sum32(wp.cw_mul(da, W[B + 3 * chunk + 2])),
                )
            point_grad[tid] = point_grad[tid] + dp
        if want_weights != 0:
            if wp.static(unrolled):
                # Each CPU thread owns a buffer that fits its cache: rank-one updates beat storing and multiplying
                # later.
                c = interpolate(features, lattice, cell)
                h4 = activations[tid, 4]
                wp.atomic_add(weight_grad, slot, OUT_32, d[0] * h4)
                wp.atomic_add(weight_grad, slot, OUT_32 + 1, d[1] * h4)
                wp.atomic_add(weight_grad, slot, OUT_32 + 2, d[2] * h4)
                bias = Vec32()
                bias[0] = d[0]
                bias[1] = d[1]
                bias[2] = d[2]
                wp.atomic_add(weight_grad, slot, OUT_32 + 3, bias)
                add_outer(weight_grad, slot, W4, activations[tid, 3], a4)
                add_outer(weight_grad, slot, W3, activations[tid, 2], a3)
                add_outer(weight_grad, slot, W2, activations[tid, 1], a2)
                add_outer(weight_grad, slot, W1, activations[tid, 0], a1)
                wp.atomic_add(weight_grad, slot, BIAS, a0)
                wp.atomic_add(weight_grad, slot, BIAS + 1, a1)
                wp.atomic_add(weight_grad, slot, BIAS + 2, a2)
                wp.atomic_add(weight_grad, slot, BIAS + 3, a3)
                wp.atomic_add(weight_grad, slot, BIAS + 4, a4)
                wp.atomic_add(weight_grad, slot, FC_BIAS, g0)
                wp.atomic_add(weight_grad, slot, FC_BIAS + 1, g1)
                wp.atomic_add(weight_grad, slot, FC_BIAS + 2, g2)
                wp.atomic_add(weight_grad, slot, FC_BIAS + 3, g3)
                wp.atomic_add(weight_grad, slot, FC_BIAS + 4, g4)
                add_outer(weight_grad, slot, V, c, g0)
                add_outer(weight_grad, slot, V + 32, c, g1)
                add_outer(weight_grad, slot, V + 64, c, g2)
                add_outer(weight_grad, slot, V + 96, c, g3)
                add_outer(weight_grad, slot, V + 128, c, g4)
                for chunk in range(3):
                    angle = angles(p, W, chunk)
                    e = sine32(angle)
                    add_outer(weight_grad, slot, E0 + 32 * chunk, e, a0)
                    add_outer(weight_grad, slot, E3 + 32 * chunk, e, a3)
                    da = matvec(matvec(Vec32(), a0, T, E0_T + 32 * chunk, trips), a3, T, E3_T + 32 * chunk, trips)
                    da = wp.cw_mul(da, cosine32(angle))
                    wp.atomic_add(weight_grad, slot, B + 3 * chunk, p[0] * da)
                    wp.atomic_add(weight_grad, slot, B + 3 * chunk + 1, p[1] * da)
                    wp.atomic_add(weight_grad, slot, B + 3 * chunk + 2, p[2] * da)
            else:
                # Thousands of threads would queue for the same rows: store, and let `color_weights` sum.
                layer_grad[tid, 0] = a0
                layer_grad[tid, 1] = a1
                layer_grad[tid, 2] = a2
                layer_grad[tid, 3] = a3
                layer_grad[tid, 4] = a4
                layer_grad[tid, 5] = g0
                layer_grad[tid, 6] = g1
                layer_grad[tid, 7] = g2
                layer_grad[tid, 8] = g3
                layer_grad[tid, 9] = g4

    @kernel
    def coarse_forward(
        first_ray: int,
        first_sample: int,
        width: int,
        trips: int,
        sample_count: int,
        ray_origin: wp.array(dtype=wp.vec3),
        ray_direction: wp.array(dtype=wp.vec3),
        z: wp.array(dtype=float),
        transmittance: wp.array(dtype=float),
        min_transmittance: float,
        lattice: Lattice,
        features: wp.array(dtype=Vec32),
        W: wp.array(dtype=Vec32),
        bits: wp.array2d(dtype=wp.uint32),
        logit: wp.array(dtype=float),
    ):
        tid = sample_index(wp.tid(), first_ray, first_sample, width, sample_count)
        if transmittance[tid // sample_count] < min_transmittance:
            return
        p = sample_point(tid, sample_count, ray_origin, ray_direction, z)
        c = interpolate(features, lattice, find_cell(lattice, p))
        h = matvec(W[C_BIAS], c, W, C_W0, trips)
        bits[tid, 0] = relu_bits(h)
        h = matvec(W[C_BIAS + 1], relu32(h), W, C_W1, trips)
        bits[tid, 1] = relu_bits(h)
        h = matvec(W[C_BIAS + 2], relu32(h), W, C_W2, trips)
        bits[tid, 2] = relu_bits(h)
        h = matvec(matvec(W[C_BIAS + 3], c, W, C_C3, trips), relu32(h), W, C_W3, trips)
        bits[tid, 3] = relu_bits(h)
        h = matvec(W[C_BIAS + 4], relu32(h), W, C_W4, trips)
        bits[tid, 4] = relu_bits(h)
        logit[tid] = output_of(relu32(h), W, C_OUT) + W[C_OUT + 1][0]

    @kernel
    def coarse_backward(
        start: int,
        slot: int,
        trips: int,
        sample_count: int,
        ray_origin: wp.array(dtype=wp.vec3),
        ray_direction: wp.array(dtype=wp.vec3),
        z: wp.array(dtype=float),
        lattice: Lattice,
        W: wp.array(dtype=Vec32),
        T: wp.array(dtype=Vec32),
        bits: wp.array2d(dtype=wp.uint32),
        logit_grad: wp.array(dtype=float),
        selected: wp.array(dtype=wp.uint8),
        grid_grad: wp.array2d(dtype=Vec32),
    ):
        """Adjoint of `coarse_forward`; the coarse level serves mapping only, so the sample position gets no gradient.
        """
        tid = start + wp.tid()
        d = logit_grad[tid]
        if d == 0.0:
            return
        p = sample_point(tid, sample_count, ray_origin, ray_direction, z)
        a = keep_bits(d * W[C_OUT], bits[tid, 4])
        a = keep_bits(matvec(Vec32(), a, T, C_W4, trips), bits[tid, 3])
        dc = matvec(Vec32(), a, T, C_C3, trips)
        a = keep_bits(matvec(Vec32(), a, T, C_W3, trips), bits[tid, 2])
        a = keep_bits(matvec(Vec32(), a, T, C_W2, trips), bits[tid, 1])
        a = keep_bits(matvec(Vec32(), a, T, C_W1, trips), bits[tid, 0])
        dc = matvec(dc, a, T, C_W0, trips)
        interpolate_adjoint_features(grid_grad, slot, selected, lattice, find_cell(lattice, p), dc)

    @kernel
    def color_weights(
        point_count: int,
        chunk_size: int,
        trips: int,
        sample_count: int,
        ray_origin: wp.array(dtype=wp.vec3),
        ray_direction: wp.array(dtype=wp.vec3),
        z: wp.array(dtype=float),
        lattice: Lattice,
        features: wp.array(dtype=Vec32),
        W: wp.array(dtype=Vec32),
        T: wp.array(dtype=Vec32),
        activations: wp.array2d(dtype=Vec32),
        color_grad: wp.array(dtype=wp.vec3),
        layer_grad: wp.array2d(dtype=Vec32),
        weight_grad: wp.array2d(dtype=Vec32),
    ):
        """Sum the weight gradient over a chunk of points: x^T d for each layer, one thread a row of the weights
        (CUDA).
        """
        block, row = wp.tid()
        first = block * chunk_size
        last = wp.min(first + chunk_size, point_count)
        total = Vec32()
        for n in range(first, last):
            d = color_grad[n]
            if d[0] != 0.0 or d[1] != 0.0 or d[2] != 0.0:
                if row < E0:
                    chunk = row // 3
                    p = sample_point(n, sample_count, ray_origin, ray_direction, z)
                    da = matvec(
                        matvec(Vec32(), layer_grad[n, 0], T, E0_T + 32 * chunk, trips),
                        layer_grad[n, 3],
                        T,
                        E3_T + 32 * chunk,
                        trips,
                    )
                    total += p[row - 3 * chunk] * wp.cw_mul(da, cosine32(angles(p, W, chunk)))
                elif row < W1:
                    j = row - E0
                    layer = int(0)
                    if j >= 96:
                        j -= 96
                        layer = int(3)
                    p = sample_point(n, sample_count, ray_origin, ray_direction, z)
                    chunk = j // 32
                    lane = j - 32 * chunk
                    angle = (
                        p[0] * W[B + 3 * chunk][lane]
                        + p[1] * W[B + 3 * chunk + 1][lane]
                        + p[2] * W[B + 3 * chunk + 2][lane]
                    )
                    total += sine_cosine(angle)[0] * layer_grad[n, layer]
                elif row < BIAS:
                    layer = (row - W1) // 32
                    total += activations[n, layer][row - W1 - 32 * layer] * layer_grad[n, layer + 1]
                elif row < V:
                    total += layer_grad[n, row - BIAS]
                elif row < OUT_32:
                    layer = (row - V) // 32
                    p = sample_point(n, sample_count, ray_origin, ray_direction, z)
                    c = interpolate(features, lattice, find_cell(lattice, p))
                    total += c[row - V - 32 * layer] * layer_grad[n, 5 + layer]
                elif row < OUT_32 + 3:
                    total += d[row - OUT_32] * activations[n, 4]
                else:
                    bias = Vec32()
                    bias[0] = d[0]
                    bias[1] = d[1]
                    bias[2] = d[2]
                    total += bias
        wp.atomic_add(weight_grad, 0, row, total)

    @kernel
    def transpose_color_weights(W: wp.array(dtype=Vec32), T: wp.array(dtype=Vec32)):
        """Bring the transposed rows in line with the weights: one thread a row of ``T`` (480)."""
        row = wp.tid()
        block = row // 32
        j = row - 32 * block
        source = int(0)
        if block < 3:
            source = E0 + 32 * block
        elif block < 6:
            source = E3 + 32 * (block - 3)
        elif block < 10:
            source = W1 + 32 * (block - 6)
        else:
            source = V + 32 * (block - 10)
        r = Vec32()
        for k in range(32):
            r[k] = W[source + k][j]
        T[row] = r

    return SimpleNamespace(
        middle_forward=middle_forward,
        fine_forward=fine_forward,
        geometry_backward=geometry_backward,
        color_forward=color_forward,
        color_backward=color_backward,
        coarse_forward=coarse_forward,
        coarse_backward=coarse_backward,
        color_weights=color_weights,
        transpose_color_weights=transpose_color_weights,
        # Whether `color_backward` leaves the sum of the weight gradient to `color_weights`.
        sums_weights_apart=not unrolled,
    )


CPU = decoder_kernels("cpu")
CUDA = decoder_kernels("cuda")
