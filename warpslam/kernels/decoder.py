"""The decoders (Sec. 3.1; SPEC of the released code): grid lookup, Fourier embedding and MLP, forward and adjoint.

Middle, fine and colour, with e = sin(p B) in R^93 and the looked-up feature c (32; fine: [fine, middle], 64):

    h = e;  for k = 0..4:  h = relu(W_k h + b_k) + V_k c + d_k;  after k = 2: h = [e, h]
    out = W_o h + b_o

Coarse has no embedding and no V_k:  h = c;  h = relu(W_k h + b_k);  after k = 2: h = [c, h].

A thread works on a block of samples, a `Block` of 4 x 32 on the CPU and of 1 x 32 on CUDA. A weight matrix is stored as
rows of `Vec32`, row k holding what input k adds to the 32 outputs, so that a layer is ``r += x[k] * W[k]``: it
vectorises over the outputs, and each row that is read serves all samples of the block. The weights of a decoder are
twice as large as a CPU's first cache; one sample at a time, the kernels wait for them and take 1.7 times as long. The
adjoint uses the same rows of the transposed matrices.

A forward launch for occupancy covers some samples of each ray, and leaves out blocks of rays whose transmittance is
spent. Colour and the adjoints work on lists of samples (``listed``, see `warpslam.kernels.compositing`), so that blocks
are full although few samples of a ray count. Forward keeps one bit per ReLU (5 words a sample and decoder); the adjoint
kernels are written by hand, because the generated adjoint replays the forward and costs 4 to 16 times as much. They
return

    d_logit -> rows of the grid that are selected (``grid_grad``), the sample position (``point_grad``), and for the
    colour decoder the weights including B (``weight_grad``).

As in the released code the middle feature that enters the fine decoder carries no gradient.

The CPU backend wants constant trip counts, CUDA rolled loops: `decoder_kernels` builds either from this one source.
"""

from types import SimpleNamespace

import warp as wp

from warpslam.kernels.compositing import count_index
from warpslam.kernels.grid import (
    Lattice,
    Vec32,
    dot32,
    find_cell,
    interpolate,
    interpolate_adjoint_features,
    interpolate_adjoint_point,
    sum32,
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
def angles(p: wp.vec3, weights: wp.array[Vec32], chunk: int) -> Vec32:
    return p[0] * weights[B + 3 * chunk] + p[1] * weights[B + 3 * chunk + 1] + p[2] * weights[B + 3 * chunk + 2]


@wp.func
def sample_index(point: int, first_ray: int, first_sample: int, width: int, sample_count: int) -> int:
    """Sample of a point, where a launch covers samples ``first_sample`` to ``first_sample + width`` of some rays."""
    return (first_ray + point // width) * sample_count + first_sample + point % width


@wp.func
def sample_point(
    sample: int,
    sample_count: int,
    ray_origin: wp.array[wp.vec3],
    ray_direction: wp.array[wp.vec3],
    z: wp.array[float],
) -> wp.vec3:
    ray = sample // sample_count
    return ray_origin[ray] + z[sample] * ray_direction[ray]


BLOCK_SIZE = {"cpu": 4, "cuda": 1}
"""Samples of a block."""

WEIGHT_GROUP = 16
"""Samples that a CPU thread of `color_backward` sums weight gradients over before it adds them to memory."""

WEIGHT_GROUP_COLUMNS = 18
"""Vectors that each of them stores for that."""


def decoder_kernels(target: str) -> SimpleNamespace:
    """Kernels of all decoders for ``target`` "cpu" or "cuda", in the Warp module ``warpslam.decoder_<target>``.

    A launch over N samples has `thread_count(N)` threads and takes N as ``point_count``; one over a list of up to N
    samples has as many.
    """
    size = BLOCK_SIZE[target]
    on_cpu = target == "cpu"
    module = f"warpslam.decoder_{target}"
    # Without contraction, clang does not fuse a product and a sum of vectors into one instruction.
    flags = f"{wp.config.cpu_compiler_flags or ''} -ffp-contract=fast"
    wp.get_module(module).options.update({"enable_backward": False, "max_unroll": 4, "cpu_compiler_flags": flags})
    Block = wp.types.matrix(shape=(size, 32), dtype=wp.float32)
    Positions = wp.types.matrix(shape=(size, 3), dtype=wp.float32)
    Scalars = wp.types.vector(length=size, dtype=wp.float32)
    Indices = wp.types.vector(length=size, dtype=wp.int32)

    def kernel(f):
        return wp.kernel(f, module=module, name=f.__name__, enable_backward=False)

    def func(f):
        return wp.func(f, module=module, name=f.__name__)

    # -- blocks ----------------------------------------------------------------------------------------------------

    @func
    def fill(row: Vec32) -> Block:
        """The same row for each sample."""
        r = Block()
        for p in range(size):
            r[p] += row
        return r

    @func
    def outer(d: Scalars, row: Vec32) -> Block:
        r = Block()
        for p in range(size):
            r[p] += d[p] * row
        return r

    @func
    def matvec(r: Block, x: Block, W: wp.array[Vec32], row: int, trips: int) -> Block:
        """r + sum_k x[:, k] W[row + k]."""
        s = Block(r)
        if wp.static(on_cpu):
            for k in range(32):
                w = W[row + k]
                for p in range(size):
                    s[p] += x[p, k] * w
        else:
            for k in range(trips):
                w = W[row + k]
                for p in range(size):
                    s[p] += x[p, k] * w
        return s

    @func
    def relu(a: Block) -> Block:
        r = Block()
        for p in range(size):
            for i in range(32):
                r[p, i] = wp.max(a[p, i], 0.0)
        return r

    @func
    def store_bits(bits: wp.array2d[wp.uint32], samples: Indices, layer: int, a: Block):
        """Which units of a layer are active."""
        for p in range(size):
            word = wp.uint32(0)
            for i in range(32):
                if a[p, i] > 0.0:
                    word |= wp.uint32(1) << wp.uint32(i)
            bits[samples[p], layer] = word

    @func
    def keep_active(a: Block, bits: wp.array2d[wp.uint32], samples: Indices, layer: int) -> Block:
        """Adjoint of the ReLU of a layer."""
        r = Block()
        for p in range(size):
            word = bits[samples[p], layer]
            for i in range(32):
                r[p, i] = wp.where((word >> wp.uint32(i)) & wp.uint32(1) == wp.uint32(1), a[p, i], 0.0)
        return r

    @func
    def embed(positions: Positions, W: wp.array[Vec32], chunk: int) -> Block:
        """32 of the 96 sines of the embedding."""
        e = Block()
        for p in range(size):
            a = angles(wp.vec3(positions[p, 0], positions[p, 1], positions[p, 2]), W, chunk)
            for i in range(32):
                e[p, i] = sine_cosine(a[i])[0]
        return e

    @func
    def angle_adjoint(
        positions: Positions,
        W: wp.array[Vec32],
        T: wp.array[Vec32],
        chunk: int,
        a0: Block,
        a3: Block,
        trips: int,
    ) -> Block:
        """Gradient of the angles p B of a chunk from those of the layers that the embedding enters, 0 and 3."""
        d = matvec(Block(), a0, T, E0_T + 32 * chunk, trips)
        d = matvec(d, a3, T, E3_T + 32 * chunk, trips)
        r = Block()
        for p in range(size):
            a = angles(wp.vec3(positions[p, 0], positions[p, 1], positions[p, 2]), W, chunk)
            for i in range(32):
                r[p, i] = d[p, i] * sine_cosine(a[i])[1]
        return r

    @func
    def output_of(h: Block, row: Vec32) -> Scalars:
        s = Scalars()
        for p in range(size):
            s[p] = dot32(h[p], row)
        return s

    @func
    def scaled(d: Scalars, a: Block) -> Block:
        r = Block()
        for p in range(size):
            r[p] += d[p] * a[p]
        return r

    @func
    def any_wanted(wanted: Indices) -> bool:
        result = bool(False)
        for p in range(size):
            if wanted[p] != 0:
                result = True
        return result

    @func
    def add_outer(
        grad: wp.array2d[Vec32],
        slot: int,
        row: int,
        inputs: wp.array3d[float],
        x: int,
        layer_grad: wp.array2d[Vec32],
        d: int,
    ):
        """grad[row + k] += sum over a slice's group of x[k] d, both columns of what its samples stored."""
        first = WEIGHT_GROUP * slot
        # Four rows at a time share what is read of d.
        for k in range(8):
            r0 = Vec32()
            r1 = Vec32()
            r2 = Vec32()
            r3 = Vec32()
            for q in range(WEIGHT_GROUP):
                g = layer_grad[first + q, d]
                r0 += inputs[first + q, x, 4 * k] * g
                r1 += inputs[first + q, x, 4 * k + 1] * g
                r2 += inputs[first + q, x, 4 * k + 2] * g
                r3 += inputs[first + q, x, 4 * k + 3] * g
            grad[slot, row + 4 * k] = grad[slot, row + 4 * k] + r0
            grad[slot, row + 4 * k + 1] = grad[slot, row + 4 * k + 1] + r1
            grad[slot, row + 4 * k + 2] = grad[slot, row + 4 * k + 2] + r2
            grad[slot, row + 4 * k + 3] = grad[slot, row + 4 * k + 3] + r3

    @func
    def add_sum(grad: wp.array2d[Vec32], slot: int, row: int, d: Block):
        """grad[row] += sum over the block of d."""
        total = Vec32()
        for p in range(size):
            total += d[p]
        grad[slot, row] = grad[slot, row] + total

    # -- samples ---------------------------------------------------------------------------------------------------

    @func
    def block_samples(
        thread: int, point_count: int, first_ray: int, first_sample: int, width: int, sample_count: int
    ) -> Indices:
        """Samples of a thread; at the end of a launch the last one stands in for those that are missing."""
        samples = Indices()
        for p in range(size):
            point = wp.min(size * thread + p, point_count - 1)
            samples[p] = sample_index(point, first_ray, first_sample, width, sample_count)
        return samples

    @func
    def wanted_of(thread: int, count: int) -> Indices:
        """Which samples of a thread are on a list of ``count``: all but those behind its end."""
        wanted = Indices()
        for p in range(size):
            wanted[p] = wp.where(size * thread + p < count, 1, 0)
        return wanted

    @func
    def listed_samples(thread: int, count: int, start: int, listed: wp.array[int]) -> Indices:
        """Samples of a thread on a list; the last one stands in for those behind its end."""
        samples = Indices()
        for p in range(size):
            samples[p] = listed[start + wp.min(size * thread + p, count - 1)]
        return samples

    @func
    def wanted_gradient(samples: Indices, wanted: Indices, logit_grad: wp.array[float]) -> Scalars:
        d = Scalars()
        for p in range(size):
            d[p] = wp.where(wanted[p] != 0, logit_grad[samples[p]], 0.0)
        return d

    @func
    def any_lit(samples: Indices, sample_count: int, transmittance: wp.array[float], min_transmittance: float) -> bool:
        lit = bool(False)
        for p in range(size):
            if transmittance[samples[p] // sample_count] >= min_transmittance:
                lit = True
        return lit

    @func
    def positions_of(
        samples: Indices,
        sample_count: int,
        ray_origin: wp.array[wp.vec3],
        ray_direction: wp.array[wp.vec3],
        z: wp.array[float],
    ) -> Positions:
        positions = Positions()
        for p in range(size):
            positions[p] = sample_point(samples[p], sample_count, ray_origin, ray_direction, z)
        return positions

    @func
    def look_up(positions: Positions, lattice: Lattice, features: wp.array[Vec32]) -> Block:
        c = Block()
        for p in range(size):
            x = wp.vec3(positions[p, 0], positions[p, 1], positions[p, 2])
            c[p] += interpolate(features, lattice, find_cell(lattice, x))
        return c

    @func
    def add_to_grid(
        grid_grad: wp.array2d[Vec32],
        slot: int,
        selected: wp.array[wp.uint8],
        lattice: Lattice,
        positions: Positions,
        wanted: Indices,
        dc: Block,
    ):
        for p in range(size):
            if wanted[p] != 0:
                x = wp.vec3(positions[p, 0], positions[p, 1], positions[p, 2])
                interpolate_adjoint_features(grid_grad, slot, selected, lattice, find_cell(lattice, x), dc[p])

    @func
    def add_to_points(
        point_grad: wp.array[wp.vec3],
        samples: Indices,
        positions: Positions,
        wanted: Indices,
        lattice: Lattice,
        features: wp.array[Vec32],
        W: wp.array[Vec32],
        T: wp.array[Vec32],
        dc: Block,
        a0: Block,
        a3: Block,
        trips: int,
    ):
        """Through the lookup and through the embedding."""
        d = Positions()
        for p in range(size):
            x = wp.vec3(positions[p, 0], positions[p, 1], positions[p, 2])
            d[p] = interpolate_adjoint_point(features, lattice, find_cell(lattice, x), dc[p])
        # Sums over the channels are slow on the CPU: there the chunks are added first. On CUDA registers are scarce.
        along_x = Block()
        along_y = Block()
        along_z = Block()
        for chunk in range(3):
            da = angle_adjoint(positions, W, T, chunk, a0, a3, trips)
            row = B + 3 * chunk
            for p in range(size):
                if wp.static(on_cpu):
                    along_x[p] += wp.cw_mul(da[p], W[row])
                    along_y[p] += wp.cw_mul(da[p], W[row + 1])
                    along_z[p] += wp.cw_mul(da[p], W[row + 2])
                else:
                    d[p] += wp.vec3(dot32(da[p], W[row]), dot32(da[p], W[row + 1]), dot32(da[p], W[row + 2]))
        for p in range(size):
            if wp.static(on_cpu):
                d[p] += wp.vec3(sum32(along_x[p]), sum32(along_y[p]), sum32(along_z[p]))
            if wanted[p] != 0:
                point_grad[samples[p]] = point_grad[samples[p]] + wp.vec3(d[p, 0], d[p, 1], d[p, 2])

    # -- middle and fine -------------------------------------------------------------------------------------------

    @kernel
    def middle_forward(
        point_count: int,
        first_ray: int,
        first_sample: int,
        width: int,
        trips: int,
        sample_count: int,
        ray_origin: wp.array[wp.vec3],
        ray_direction: wp.array[wp.vec3],
        z: wp.array[float],
        transmittance: wp.array[float],
        min_transmittance: float,
        lattice: Lattice,
        features: wp.array[Vec32],
        W: wp.array[Vec32],
        bits: wp.array2d[wp.uint32],
        logit: wp.array[float],
    ):
        samples = block_samples(wp.tid(), point_count, first_ray, first_sample, width, sample_count)
        if not any_lit(samples, sample_count, transmittance, min_transmittance):
            return
        positions = positions_of(samples, sample_count, ray_origin, ray_direction, z)
        c = look_up(positions, lattice, features)
        a0 = fill(W[BIAS])
        a3 = fill(W[BIAS + 3])
        for chunk in range(3):
            e = embed(positions, W, chunk)
            a0 = matvec(a0, e, W, E0 + 32 * chunk, trips)
            a3 = matvec(a3, e, W, E3 + 32 * chunk, trips)
        store_bits(bits, samples, 0, a0)
        h = matvec(relu(a0) + fill(W[FC_BIAS]), c, W, V, trips)
        a = matvec(fill(W[BIAS + 1]), h, W, W1, trips)
        store_bits(bits, samples, 1, a)
        h = matvec(relu(a) + fill(W[FC_BIAS + 1]), c, W, V + 32, trips)
        a = matvec(fill(W[BIAS + 2]), h, W, W2, trips)
        store_bits(bits, samples, 2, a)
        h = matvec(relu(a) + fill(W[FC_BIAS + 2]), c, W, V + 64, trips)
        a = matvec(a3, h, W, W3, trips)
        store_bits(bits, samples, 3, a)
        h = matvec(relu(a) + fill(W[FC_BIAS + 3]), c, W, V + 96, trips)
        a = matvec(fill(W[BIAS + 4]), h, W, W4, trips)
        store_bits(bits, samples, 4, a)
        h = matvec(relu(a) + fill(W[FC_BIAS + 4]), c, W, V + 128, trips)
        out = output_of(h, W[OUT_32])
        for p in range(size):
            logit[samples[p]] = out[p] + W[OUT_32 + 1][0]

    @func
    def add_conditions(h: Block, c: Block, m: Block, W: wp.array[Vec32], layer: int, trips: int) -> Block:
        """h + V_k [c, m] + d_k of the fine decoder."""
        r = matvec(h + fill(W[FC_BIAS + layer]), c, W, V + 64 * layer, trips)
        return matvec(r, m, W, V + 64 * layer + 32, trips)

    @kernel
    def fine_forward(
        point_count: int,
        first_ray: int,
        first_sample: int,
        width: int,
        trips: int,
        sample_count: int,
        ray_origin: wp.array[wp.vec3],
        ray_direction: wp.array[wp.vec3],
        z: wp.array[float],
        transmittance: wp.array[float],
        min_transmittance: float,
        lattice: Lattice,
        features: wp.array[Vec32],
        middle_lattice: Lattice,
        middle_features: wp.array[Vec32],
        W: wp.array[Vec32],
        bits: wp.array2d[wp.uint32],
        logit: wp.array[float],
    ):
        samples = block_samples(wp.tid(), point_count, first_ray, first_sample, width, sample_count)
        if not any_lit(samples, sample_count, transmittance, min_transmittance):
            return
        positions = positions_of(samples, sample_count, ray_origin, ray_direction, z)
        c = look_up(positions, lattice, features)
        m = look_up(positions, middle_lattice, middle_features)
        a0 = fill(W[BIAS])
        a3 = fill(W[BIAS + 3])
        for chunk in range(3):
            e = embed(positions, W, chunk)
            a0 = matvec(a0, e, W, E0 + 32 * chunk, trips)
            a3 = matvec(a3, e, W, E3 + 32 * chunk, trips)
        store_bits(bits, samples, 0, a0)
        h = add_conditions(relu(a0), c, m, W, 0, trips)
        a = matvec(fill(W[BIAS + 1]), h, W, W1, trips)
        store_bits(bits, samples, 1, a)
        h = add_conditions(relu(a), c, m, W, 1, trips)
        a = matvec(fill(W[BIAS + 2]), h, W, W2, trips)
        store_bits(bits, samples, 2, a)
        h = add_conditions(relu(a), c, m, W, 2, trips)
        a = matvec(a3, h, W, W3, trips)
        store_bits(bits, samples, 3, a)
        h = add_conditions(relu(a), c, m, W, 3, trips)
        a = matvec(fill(W[BIAS + 4]), h, W, W4, trips)
        store_bits(bits, samples, 4, a)
        h = add_conditions(relu(a), c, m, W, 4, trips)
        out = output_of(h, W[OUT_64])
        # Eq. 3: the fine level adds a residual to the logit of the middle level. A sample that stands in for a missing
        # one is the block's last, so that its logit is read before it is written.
        total = Scalars()
        for p in range(size):
            total[p] = logit[samples[p]] + out[p] + W[OUT_64 + 1][0]
        for p in range(size):
            logit[samples[p]] = total[p]

    @kernel
    def geometry_backward(
        start: int,
        slot: int,
        listed: wp.array[int],
        listed_count: wp.array[int],
        trips: int,
        sample_count: int,
        ray_origin: wp.array[wp.vec3],
        ray_direction: wp.array[wp.vec3],
        z: wp.array[float],
        lattice: Lattice,
        features: wp.array[Vec32],
        W: wp.array[Vec32],
        T: wp.array[Vec32],
        output_row: int,
        bits: wp.array2d[wp.uint32],
        logit_grad: wp.array[float],
        want_grid: int,
        selected: wp.array[wp.uint8],
        grid_grad: wp.array2d[Vec32],
        want_point: int,
        point_grad: wp.array[wp.vec3],
    ):
        """Adjoint of `middle_forward` and of `fine_forward` (they differ in ``output_row``)."""
        thread = wp.tid()
        count = listed_count[count_index(slot)]
        if size * thread >= count:
            return
        samples = listed_samples(thread, count, start, listed)
        wanted = wanted_of(thread, count)
        d = wanted_gradient(samples, wanted, logit_grad)
        g = outer(d, W[output_row])
        dc = matvec(Block(), g, T, V_T + 128, trips)
        a = keep_active(g, bits, samples, 4)
        g = matvec(Block(), a, T, W4_T, trips)
        dc = matvec(dc, g, T, V_T + 96, trips)
        a3 = keep_active(g, bits, samples, 3)
        g = matvec(Block(), a3, T, W3_T, trips)
        dc = matvec(dc, g, T, V_T + 64, trips)
        a = keep_active(g, bits, samples, 2)
        g = matvec(Block(), a, T, W2_T, trips)
        dc = matvec(dc, g, T, V_T + 32, trips)
        a = keep_active(g, bits, samples, 1)
        g = matvec(Block(), a, T, W1_T, trips)
        dc = matvec(dc, g, T, V_T, trips)
        positions = positions_of(samples, sample_count, ray_origin, ray_direction, z)
        if want_grid != 0:
            add_to_grid(grid_grad, slot, selected, lattice, positions, wanted, dc)
        if want_point != 0:
            a0 = keep_active(g, bits, samples, 0)
            add_to_points(point_grad, samples, positions, wanted, lattice, features, W, T, dc, a0, a3, trips)

    # -- colour ----------------------------------------------------------------------------------------------------

    @func
    def store_rows(rows: wp.array2d[Vec32], samples: Indices, column: int, a: Block, wanted: int):
        if wanted != 0:
            for p in range(size):
                rows[samples[p], column] = a[p]

    @func
    def load_rows(rows: wp.array2d[Vec32], samples: Indices, column: int) -> Block:
        a = Block()
        for p in range(size):
            a[p] += rows[samples[p], column]
        return a

    @kernel
    def color_forward(
        start: int,
        slot: int,
        listed: wp.array[int],
        listed_count: wp.array[int],
        trips: int,
        sample_count: int,
        ray_origin: wp.array[wp.vec3],
        ray_direction: wp.array[wp.vec3],
        z: wp.array[float],
        lattice: Lattice,
        features: wp.array[Vec32],
        W: wp.array[Vec32],
        bits: wp.array2d[wp.uint32],
        want_activations: int,
        activations: wp.array2d[Vec32],
        color: wp.array[wp.vec3],
    ):
        thread = wp.tid()
        count = listed_count[count_index(slot)]
        if size * thread >= count:
            return
        samples = listed_samples(thread, count, start, listed)
        positions = positions_of(samples, sample_count, ray_origin, ray_direction, z)
        c = look_up(positions, lattice, features)
        a0 = fill(W[BIAS])
        a3 = fill(W[BIAS + 3])
        for chunk in range(3):
            e = embed(positions, W, chunk)
            a0 = matvec(a0, e, W, E0 + 32 * chunk, trips)
            a3 = matvec(a3, e, W, E3 + 32 * chunk, trips)
        store_bits(bits, samples, 0, a0)
        h0 = matvec(relu(a0) + fill(W[FC_BIAS]), c, W, V, trips)
        a = matvec(fill(W[BIAS + 1]), h0, W, W1, trips)
        store_bits(bits, samples, 1, a)
        h1 = matvec(relu(a) + fill(W[FC_BIAS + 1]), c, W, V + 32, trips)
        a = matvec(fill(W[BIAS + 2]), h1, W, W2, trips)
        store_bits(bits, samples, 2, a)
        h2 = matvec(relu(a) + fill(W[FC_BIAS + 2]), c, W, V + 64, trips)
        a = matvec(a3, h2, W, W3, trips)
        store_bits(bits, samples, 3, a)
        h3 = matvec(relu(a) + fill(W[FC_BIAS + 3]), c, W, V + 96, trips)
        a = matvec(fill(W[BIAS + 4]), h3, W, W4, trips)
        store_bits(bits, samples, 4, a)
        h4 = matvec(relu(a) + fill(W[FC_BIAS + 4]), c, W, V + 128, trips)
        store_rows(activations, samples, 0, h0, want_activations)
        store_rows(activations, samples, 1, h1, want_activations)
        store_rows(activations, samples, 2, h2, want_activations)
        store_rows(activations, samples, 3, h3, want_activations)
        store_rows(activations, samples, 4, h4, want_activations)
        # Channels 0..2, linear; the released code discards the fourth.
        red = output_of(h4, W[OUT_32])
        green = output_of(h4, W[OUT_32 + 1])
        blue = output_of(h4, W[OUT_32 + 2])
        bias = W[OUT_32 + 3]
        for p in range(size):
            color[samples[p]] = wp.vec3(red[p] + bias[0], green[p] + bias[1], blue[p] + bias[2])

    @func
    def color_block_backward(
        block: int,
        count: int,
        start: int,
        slot: int,
        listed: wp.array[int],
        trips: int,
        sample_count: int,
        ray_origin: wp.array[wp.vec3],
        ray_direction: wp.array[wp.vec3],
        z: wp.array[float],
        lattice: Lattice,
        features: wp.array[Vec32],
        W: wp.array[Vec32],
        T: wp.array[Vec32],
        bits: wp.array2d[wp.uint32],
        color_grad: wp.array[wp.vec3],
        want_grid: int,
        selected: wp.array[wp.uint8],
        grid_grad: wp.array2d[Vec32],
        want_point: int,
        point_grad: wp.array[wp.vec3],
        want_weights: int,
        activations: wp.array2d[Vec32],
        weight_grad: wp.array2d[Vec32],
        layer_grad: wp.array2d[Vec32],
        group_row: int,
    ):
        """Adjoint of a block of `color_forward`; see `color_backward`. Within the kernel's loop, and not in a function,
        it is 7 % slower.

        group_row: On the CPU, the row of ``layer_grad`` that the first of its samples stores to.
        """
        samples = listed_samples(block, count, start, listed)
        wanted = Indices()
        red = Scalars()
        green = Scalars()
        blue = Scalars()
        for p in range(size):
            d = color_grad[samples[p]]
            # Rays without a residual have weighty samples, too.
            if size * block + p < count and (d[0] != 0.0 or d[1] != 0.0 or d[2] != 0.0):
                wanted[p] = 1
                red[p] = d[0]
                green[p] = d[1]
                blue[p] = d[2]
        if not any_wanted(wanted):
            if wp.static(on_cpu):
                if want_weights != 0:
                    # What an earlier group left there must not count again.
                    for p in range(size):
                        for column in range(WEIGHT_GROUP_COLUMNS):
                            layer_grad[group_row + p, column] = Vec32()
            return
        rows = Indices(samples)
        if wp.static(on_cpu):
            for p in range(size):
                rows[p] = group_row + p
        g4 = outer(red, W[OUT_32]) + outer(green, W[OUT_32 + 1]) + outer(blue, W[OUT_32 + 2])
        store_rows(layer_grad, rows, 9, g4, want_weights)
        dc = matvec(Block(), g4, T, V_T + 128, trips)
        a4 = keep_active(g4, bits, samples, 4)
        store_rows(layer_grad, rows, 4, a4, want_weights)
        g3 = matvec(Block(), a4, T, W4_T, trips)
        store_rows(layer_grad, rows, 8, g3, want_weights)
        dc = matvec(dc, g3, T, V_T + 96, trips)
        a3 = keep_active(g3, bits, samples, 3)
        store_rows(layer_grad, rows, 3, a3, want_weights)
        g2 = matvec(Block(), a3, T, W3_T, trips)
        store_rows(layer_grad, rows, 7, g2, want_weights)
        dc = matvec(dc, g2, T, V_T + 64, trips)
        a2 = keep_active(g2, bits, samples, 2)
        store_rows(layer_grad, rows, 2, a2, want_weights)
        g1 = matvec(Block(), a2, T, W2_T, trips)
        store_rows(layer_grad, rows, 6, g1, want_weights)
        dc = matvec(dc, g1, T, V_T + 32, trips)
        a1 = keep_active(g1, bits, samples, 1)
        store_rows(layer_grad, rows, 1, a1, want_weights)
        g0 = matvec(Block(), a1, T, W1_T, trips)
        store_rows(layer_grad, rows, 5, g0, want_weights)
        dc = matvec(dc, g0, T, V_T, trips)
        a0 = keep_active(g0, bits, samples, 0)
        store_rows(layer_grad, rows, 0, a0, want_weights)
        positions = positions_of(samples, sample_count, ray_origin, ray_direction, z)
        if want_grid != 0:
            add_to_grid(grid_grad, slot, selected, lattice, positions, wanted, dc)
        if want_point != 0:
            add_to_points(point_grad, samples, positions, wanted, lattice, features, W, T, dc, a0, a3, trips)
        if want_weights != 0:
            store_rows(layer_grad, rows, 13, look_up(positions, lattice, features), want_weights)
            if wp.static(on_cpu):
                # What the group's matrix products need besides, and the single rows at once. Samples that are not
                # wanted add zero, whatever activations they have.
                for layer in range(4):
                    store_rows(layer_grad, rows, 14 + layer, load_rows(activations, samples, layer), want_weights)
                h4 = load_rows(activations, samples, 4)
                add_sum(weight_grad, slot, OUT_32, scaled(red, h4))
                add_sum(weight_grad, slot, OUT_32 + 1, scaled(green, h4))
                add_sum(weight_grad, slot, OUT_32 + 2, scaled(blue, h4))
                bias = Vec32()
                for p in range(size):
                    bias[0] += red[p]
                    bias[1] += green[p]
                    bias[2] += blue[p]
                weight_grad[slot, OUT_32 + 3] = weight_grad[slot, OUT_32 + 3] + bias
                add_sum(weight_grad, slot, BIAS, a0)
                add_sum(weight_grad, slot, BIAS + 1, a1)
                add_sum(weight_grad, slot, BIAS + 2, a2)
                add_sum(weight_grad, slot, BIAS + 3, a3)
                add_sum(weight_grad, slot, BIAS + 4, a4)
                add_sum(weight_grad, slot, FC_BIAS, g0)
                add_sum(weight_grad, slot, FC_BIAS + 1, g1)
                add_sum(weight_grad, slot, FC_BIAS + 2, g2)
                add_sum(weight_grad, slot, FC_BIAS + 3, g3)
                add_sum(weight_grad, slot, FC_BIAS + 4, g4)
            for chunk in range(3):
                da = angle_adjoint(positions, W, T, chunk, a0, a3, trips)
                if wp.static(on_cpu):
                    store_rows(layer_grad, rows, 10 + chunk, embed(positions, W, chunk), want_weights)
                    for axis in range(3):
                        coordinate = Scalars()
                        for p in range(size):
                            coordinate[p] = positions[p, axis]
                        add_sum(weight_grad, slot, B + 3 * chunk + axis, scaled(coordinate, da))
                else:
                    store_rows(layer_grad, rows, 10 + chunk, da, want_weights)

    @kernel
    def color_backward(
        start: int,
        slot: int,
        listed: wp.array[int],
        listed_count: wp.array[int],
        blocks: int,
        trips: int,
        sample_count: int,
        ray_origin: wp.array[wp.vec3],
        ray_direction: wp.array[wp.vec3],
        z: wp.array[float],
        lattice: Lattice,
        features: wp.array[Vec32],
        W: wp.array[Vec32],
        T: wp.array[Vec32],
        bits: wp.array2d[wp.uint32],
        color_grad: wp.array[wp.vec3],
        want_grid: int,
        selected: wp.array[wp.uint8],
        grid_grad: wp.array2d[Vec32],
        want_point: int,
        point_grad: wp.array[wp.vec3],
        want_weights: int,
        activations: wp.array2d[Vec32],
        weight_grad: wp.array2d[Vec32],
        layer_grad: wp.array2d[Vec32],
        layer_inputs: wp.array3d[float],
    ):
        """Adjoint of `color_forward`; a thread works on ``blocks`` blocks, on the CPU on `WEIGHT_GROUP` samples.

        layer_grad: On the CPU a slice has the rows of one group, with a_0..a_4, g_0..g_4, the embedding (3 columns),
            the feature and h_0..h_3 of its samples: the gradient of the weights is twice as large as a CPU's first
            cache, so that a row of it is fetched once a group and not once a block. On CUDA thousands of threads would
            queue for the same rows: all samples store, and `color_weights` sums.
        layer_inputs: The same memory, one number an element (CPU).
        """
        thread = wp.tid()
        count = listed_count[count_index(slot)]
        if size * blocks * thread >= count:
            return
        for n in range(blocks):
            color_block_backward(
                blocks * thread + n, count, start, slot, listed, trips, sample_count, ray_origin, ray_direction, z,
                lattice, features, W, T, bits, color_grad, want_grid, selected, grid_grad, want_point, point_grad,
                want_weights, activations, weight_grad, layer_grad, WEIGHT_GROUP * slot + size * n,
            )  # fmt: skip
        if wp.static(on_cpu):
            if want_weights != 0:
                for layer in range(4):
                    add_outer(weight_grad, slot, W1 + 32 * layer, layer_inputs, 14 + layer, layer_grad, 1 + layer)
                for layer in range(5):
                    add_outer(weight_grad, slot, V + 32 * layer, layer_inputs, 13, layer_grad, 5 + layer)
                for chunk in range(3):
                    add_outer(weight_grad, slot, E0 + 32 * chunk, layer_inputs, 10 + chunk, layer_grad, 0)
                    add_outer(weight_grad, slot, E3 + 32 * chunk, layer_inputs, 10 + chunk, layer_grad, 3)

    # -- coarse ----------------------------------------------------------------------------------------------------

    @kernel
    def coarse_forward(
        point_count: int,
        first_ray: int,
        first_sample: int,
        width: int,
        trips: int,
        sample_count: int,
        ray_origin: wp.array[wp.vec3],
        ray_direction: wp.array[wp.vec3],
        z: wp.array[float],
        transmittance: wp.array[float],
        min_transmittance: float,
        lattice: Lattice,
        features: wp.array[Vec32],
        W: wp.array[Vec32],
        bits: wp.array2d[wp.uint32],
        logit: wp.array[float],
    ):
        samples = block_samples(wp.tid(), point_count, first_ray, first_sample, width, sample_count)
        if not any_lit(samples, sample_count, transmittance, min_transmittance):
            return
        positions = positions_of(samples, sample_count, ray_origin, ray_direction, z)
        c = look_up(positions, lattice, features)
        h = matvec(fill(W[C_BIAS]), c, W, C_W0, trips)
        store_bits(bits, samples, 0, h)
        h = matvec(fill(W[C_BIAS + 1]), relu(h), W, C_W1, trips)
        store_bits(bits, samples, 1, h)
        h = matvec(fill(W[C_BIAS + 2]), relu(h), W, C_W2, trips)
        store_bits(bits, samples, 2, h)
        h = matvec(matvec(fill(W[C_BIAS + 3]), c, W, C_C3, trips), relu(h), W, C_W3, trips)
        store_bits(bits, samples, 3, h)
        h = matvec(fill(W[C_BIAS + 4]), relu(h), W, C_W4, trips)
        store_bits(bits, samples, 4, h)
        out = output_of(relu(h), W[C_OUT])
        for p in range(size):
            logit[samples[p]] = out[p] + W[C_OUT + 1][0]

    @kernel
    def coarse_backward(
        start: int,
        slot: int,
        listed: wp.array[int],
        listed_count: wp.array[int],
        trips: int,
        sample_count: int,
        ray_origin: wp.array[wp.vec3],
        ray_direction: wp.array[wp.vec3],
        z: wp.array[float],
        lattice: Lattice,
        W: wp.array[Vec32],
        T: wp.array[Vec32],
        bits: wp.array2d[wp.uint32],
        logit_grad: wp.array[float],
        selected: wp.array[wp.uint8],
        grid_grad: wp.array2d[Vec32],
    ):
        """Adjoint of `coarse_forward`; the coarse level serves mapping only: the position gets no gradient."""
        thread = wp.tid()
        count = listed_count[count_index(slot)]
        if size * thread >= count:
            return
        samples = listed_samples(thread, count, start, listed)
        wanted = wanted_of(thread, count)
        d = wanted_gradient(samples, wanted, logit_grad)
        a = keep_active(outer(d, W[C_OUT]), bits, samples, 4)
        a = keep_active(matvec(Block(), a, T, C_W4, trips), bits, samples, 3)
        dc = matvec(Block(), a, T, C_C3, trips)
        a = keep_active(matvec(Block(), a, T, C_W3, trips), bits, samples, 2)
        a = keep_active(matvec(Block(), a, T, C_W2, trips), bits, samples, 1)
        a = keep_active(matvec(Block(), a, T, C_W1, trips), bits, samples, 0)
        dc = matvec(dc, a, T, C_W0, trips)
        positions = positions_of(samples, sample_count, ray_origin, ray_direction, z)
        add_to_grid(grid_grad, slot, selected, lattice, positions, wanted, dc)

    @kernel
    def color_weights(
        point_count: int,
        chunk_size: int,
        sample_count: int,
        ray_origin: wp.array[wp.vec3],
        ray_direction: wp.array[wp.vec3],
        z: wp.array[float],
        W: wp.array[Vec32],
        activations: wp.array2d[Vec32],
        color_grad: wp.array[wp.vec3],
        layer_grad: wp.array2d[Vec32],
        weight_grad: wp.array2d[Vec32],
    ):
        """Sum the weight gradient over a chunk of points: x^T d for each layer, one thread a row of the weights (CUDA).

        layer_grad: of a point, as `color_backward` left it: a_0..a_4, g_0..g_4, those of the angles, and the feature.
        """
        block, row = wp.tid()
        first = block * chunk_size
        last = wp.min(first + chunk_size, point_count)
        total = Vec32()
        for n in range(first, last):
            d = color_grad[n]
            if d[0] != 0.0 or d[1] != 0.0 or d[2] != 0.0:
                x = float(1.0)
                column = int(0)
                if row < E0:
                    chunk = row // 3
                    x = sample_point(n, sample_count, ray_origin, ray_direction, z)[row - 3 * chunk]
                    column = 10 + chunk
                elif row < W1:
                    j = row - E0
                    if j >= 96:
                        j -= 96
                        column = 3
                    p = sample_point(n, sample_count, ray_origin, ray_direction, z)
                    x = sine_cosine(angles(p, W, j // 32)[j % 32])[0]
                elif row < BIAS:
                    layer = (row - W1) // 32
                    x = activations[n, layer][row - W1 - 32 * layer]
                    column = layer + 1
                elif row < V:
                    column = row - BIAS
                elif row < OUT_32:
                    layer = (row - V) // 32
                    x = layer_grad[n, 13][row - V - 32 * layer]
                    column = 5 + layer
                if row < OUT_32:
                    total += x * layer_grad[n, column]
                elif row < OUT_32 + 3:
                    total += d[row - OUT_32] * activations[n, 4]
                else:
                    for k in range(3):
                        total[k] += d[k]
        wp.atomic_add(weight_grad, 0, row, total)

    @kernel
    def transpose_color_weights(W: wp.array[Vec32], T: wp.array[Vec32]):
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
        # Blocks of a thread of `color_backward`.
        color_blocks=WEIGHT_GROUP // size if on_cpu else 1,
        # Threads of a launch over so many samples, one block each.
        thread_count=lambda point_count: -(-point_count // size),
        # Whether `color_backward` leaves the sum of the weight gradient to `color_weights`.
        sums_weights_apart=not on_cpu,
    )


CPU = decoder_kernels("cpu")
CUDA = decoder_kernels("cuda")


def decoders_for(device: wp.Device) -> SimpleNamespace:
    """The decoder kernels built for this kind of device."""
    return CUDA if device.is_cuda else CPU
