"""The network of iMAP* (Sucar et al. 2021, as NICE-SLAM's authors re-implemented it), forward and adjoint.

    e = sin(p B) in R^93;  h_0 = e;  h_k = relu(W_k h_{k-1} + b_k), k = 1..4, 256 wide;  raw = W_o h_4 + b_o in R^4

raw is colour (red, green, blue) and density. Points are numbered ray * sample_count + sample. Activations are arrays
(blocks, points) of `Vec32`: the embedding has 3 blocks (96 channels, 93 used), a layer 8. Weights are rows of `Vec32`:
row k of an output block holds what input k adds to the block's 32 outputs.

A forward kernel works out one block of one layer for four points a thread, so that each row it reads serves four
points. The adjoint of a layer is the same product with the transposed rows, masked by the activations it flows into;
weight gradients are x^T d over chunks of points, eight rows a thread. Gradients reach the weights, B included, and the
points.
"""

from types import SimpleNamespace

import warp as wp

from warpslam.kernels.decoder.embedding import angles, sine_cosine
from warpslam.kernels.grid import Vec32, dot32, sum32
from warpslam.kernels.samples import Rays, Span, sample_index, sample_point

BLOCKS = 8
EMBEDDING_BLOCKS = 3
LAYERS = 4

# Rows of the weights: B as in the decoders, then the layers, block by block.
LAYER = (9, 9 + 8 * 96, 9 + 8 * 96 + 8 * 256, 9 + 8 * 96 + 16 * 256)
BIAS = 9 + 8 * 96 + 24 * 256  # 8 rows a layer
OUT = BIAS + 32  # 8 rows an output (red, green, blue, density), then one row of output biases
WEIGHT_ROWS = OUT + 33

# Rows of the transposed weights: for each input block of a layer, one row an output.
LAYER_T = (0, 3 * 256, 3 * 256 + 8 * 256, 3 * 256 + 16 * 256)
TRANSPOSED_ROWS = 3 * 256 + 24 * 256

FORWARD = wp.constant(0)
ADJOINT = wp.constant(1)
UNMASKED = wp.constant(2)


@wp.struct
class Layer:
    """A layer, or its transpose: the rows from ``row`` on, ``in_blocks`` an output block, and the rows of the biases.

    trips: 32, which CUDA's compiler must not know.
    """

    trips: int
    in_blocks: int
    W: wp.array[Vec32]
    row: int
    bias: wp.array[Vec32]
    bias_row: int


@wp.struct
class Chunks:
    """Points ``start`` to ``stop``, in chunks of ``size``, whose sums go to a gradient buffer ``slot``."""

    start: int
    stop: int
    size: int
    slot: int


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


def imap_kernels(target: str) -> SimpleNamespace:
    """The kernels for ``target`` "cpu" or "cuda", in the Warp module ``warpslam.imap_<target>``."""
    unrolled = target == "cpu"
    module = f"warpslam.imap_{target}"
    wp.get_module(module).options.update({"enable_backward": False, "max_unroll": 4})

    def kernel(f):
        return wp.kernel(f, module=module, name=f.__name__, enable_backward=False)

    def func(f):
        return wp.func(f, module=module, name=f.__name__)

    @func
    def masked_relu(a: Vec32, gate: Vec32) -> Vec32:
        """``a`` where ``gate`` is above 0."""
        r = Vec32()
        for i in range(32):
            r[i] = wp.where(gate[i] > 0.0, a[i], 0.0)
        return r

    @kernel
    def embed(span: Span, rays: Rays, W: wp.array[Vec32], embedding: wp.array2d[Vec32]):
        point = sample_index(wp.tid(), span, rays.sample_count)
        p = sample_point(point, rays)
        for chunk in range(3):
            embedding[chunk, point] = sine32(angles(p, W, chunk))

    @kernel
    def product(
        span: Span,
        sample_count: int,
        layer: Layer,
        x: wp.array2d[Vec32],
        mode: int,
        gate: wp.array2d[Vec32],
        y: wp.array2d[Vec32],
    ):
        """A layer forward (FORWARD: bias and ReLU), or its adjoint (ADJOINT: masked by ``gate``; UNMASKED)."""
        block, group = wp.tid()
        # The last group may be short of points: it computes its last one again.
        last = span.point_count - 1
        p0 = sample_index(wp.min(4 * group, last), span, sample_count)
        p1 = sample_index(wp.min(4 * group + 1, last), span, sample_count)
        p2 = sample_index(wp.min(4 * group + 2, last), span, sample_count)
        p3 = sample_index(wp.min(4 * group + 3, last), span, sample_count)
        r0 = Vec32()
        if mode == FORWARD:
            r0 = Vec32(layer.bias[layer.bias_row + block])
        r1 = Vec32(r0)
        r2 = Vec32(r0)
        r3 = Vec32(r0)
        for source in range(layer.in_blocks):
            x0 = x[source, p0]
            x1 = x[source, p1]
            x2 = x[source, p2]
            x3 = x[source, p3]
            first = layer.row + 32 * (block * layer.in_blocks + source)
            if wp.static(unrolled):
                for k in range(32):
                    w = layer.W[first + k]
                    r0 += x0[k] * w
                    r1 += x1[k] * w
                    r2 += x2[k] * w
                    r3 += x3[k] * w
            else:
                for k in range(layer.trips):
                    w = layer.W[first + k]
                    r0 += x0[k] * w
                    r1 += x1[k] * w
                    r2 += x2[k] * w
                    r3 += x3[k] * w
        if mode == FORWARD:
            y[block, p0] = masked_relu(r0, r0)
            y[block, p1] = masked_relu(r1, r1)
            y[block, p2] = masked_relu(r2, r2)
            y[block, p3] = masked_relu(r3, r3)
        elif mode == ADJOINT:
            y[block, p0] = masked_relu(r0, gate[block, p0])
            y[block, p1] = masked_relu(r1, gate[block, p1])
            y[block, p2] = masked_relu(r2, gate[block, p2])
            y[block, p3] = masked_relu(r3, gate[block, p3])
        else:
            y[block, p0] = r0
            y[block, p1] = r1
            y[block, p2] = r2
            y[block, p3] = r3

    @kernel
    def output(
        span: Span,
        sample_count: int,
        W: wp.array[Vec32],
        h: wp.array2d[Vec32],
        color: wp.array[wp.vec3],
        density: wp.array[float],
    ):
        point = sample_index(wp.tid(), span, sample_count)
        raw = wp.vec4()
        for channel in range(4):
            total = Vec32()
            for block in range(8):
                total += wp.cw_mul(h[block, point], W[OUT + 8 * channel + block])
            raw[channel] = sum32(total) + W[OUT + 32][channel]
        color[point] = wp.vec3(raw[0], raw[1], raw[2])
        density[point] = raw[3]

    @kernel
    def output_backward(
        start: int,
        W: wp.array[Vec32],
        h: wp.array2d[Vec32],
        color_grad: wp.array[wp.vec3],
        density_grad: wp.array[float],
        d: wp.array2d[Vec32],
    ):
        point = start + wp.tid()
        c = color_grad[point]
        s = density_grad[point]
        for block in range(8):
            g = c[0] * W[OUT + block] + c[1] * W[OUT + 8 + block] + c[2] * W[OUT + 16 + block]
            d[block, point] = masked_relu(g + s * W[OUT + 24 + block], h[block, point])

    @kernel
    def embed_backward(
        start: int,
        rays: Rays,
        W: wp.array[Vec32],
        d: wp.array2d[Vec32],
        want_point: int,
        point_grad: wp.array[wp.vec3],
    ):
        """From the gradient of the embedding to that of its angles p B (in place), and of the point."""
        point = start + wp.tid()
        p = sample_point(point, rays)
        dp = wp.vec3()
        for chunk in range(3):
            da = wp.cw_mul(d[chunk, point], cosine32(angles(p, W, chunk)))
            d[chunk, point] = da
            dp += wp.vec3(
                dot32(da, W[3 * chunk]),
                dot32(da, W[3 * chunk + 1]),
                dot32(da, W[3 * chunk + 2]),
            )
        if want_point != 0:
            point_grad[point] = point_grad[point] + dp

    @kernel
    def layer_weights(
        chunks: Chunks,
        in_blocks: int,
        row: int,
        x: wp.array3d[float],
        d: wp.array2d[Vec32],
        grad: wp.array2d[Vec32],
    ):
        """x^T d over a chunk of points: rows 8 r to 8 r + 7 of the input, one block of the output, a thread.

        ``x`` are activations with their channels as a third axis: reading one channel must not load the other 31.
        """
        chunk, block, r = wp.tid()
        first = chunks.start + chunk * chunks.size
        last = wp.min(first + chunks.size, chunks.stop)
        source = r // 4
        k = 8 * (r % 4)
        g0 = Vec32()
        g1 = Vec32()
        g2 = Vec32()
        g3 = Vec32()
        g4 = Vec32()
        g5 = Vec32()
        g6 = Vec32()
        g7 = Vec32()
        for n in range(first, last):
            dn = d[block, n]
            g0 += x[source, n, k] * dn
            g1 += x[source, n, k + 1] * dn
            g2 += x[source, n, k + 2] * dn
            g3 += x[source, n, k + 3] * dn
            g4 += x[source, n, k + 4] * dn
            g5 += x[source, n, k + 5] * dn
            g6 += x[source, n, k + 6] * dn
            g7 += x[source, n, k + 7] * dn
        target_row = row + 32 * (block * in_blocks + source) + k
        wp.atomic_add(grad, chunks.slot, target_row, g0)
        wp.atomic_add(grad, chunks.slot, target_row + 1, g1)
        wp.atomic_add(grad, chunks.slot, target_row + 2, g2)
        wp.atomic_add(grad, chunks.slot, target_row + 3, g3)
        wp.atomic_add(grad, chunks.slot, target_row + 4, g4)
        wp.atomic_add(grad, chunks.slot, target_row + 5, g5)
        wp.atomic_add(grad, chunks.slot, target_row + 6, g6)
        wp.atomic_add(grad, chunks.slot, target_row + 7, g7)

    @kernel
    def bias_weights(
        chunks: Chunks,
        row: int,
        d: wp.array2d[Vec32],
        grad: wp.array2d[Vec32],
    ):
        chunk, block = wp.tid()
        first = chunks.start + chunk * chunks.size
        last = wp.min(first + chunks.size, chunks.stop)
        g = Vec32()
        for n in range(first, last):
            g += d[block, n]
        wp.atomic_add(grad, chunks.slot, row + block, g)

    @kernel
    def output_weights(
        chunks: Chunks,
        h: wp.array2d[Vec32],
        color_grad: wp.array[wp.vec3],
        density_grad: wp.array[float],
        grad: wp.array2d[Vec32],
    ):
        chunk, block = wp.tid()
        first = chunks.start + chunk * chunks.size
        last = wp.min(first + chunks.size, chunks.stop)
        red = Vec32()
        green = Vec32()
        blue = Vec32()
        dense = Vec32()
        bias = Vec32()
        for n in range(first, last):
            c = color_grad[n]
            s = density_grad[n]
            x = h[block, n]
            red += c[0] * x
            green += c[1] * x
            blue += c[2] * x
            dense += s * x
            bias[0] = bias[0] + c[0]
            bias[1] = bias[1] + c[1]
            bias[2] = bias[2] + c[2]
            bias[3] = bias[3] + s
        wp.atomic_add(grad, chunks.slot, OUT + block, red)
        wp.atomic_add(grad, chunks.slot, OUT + 8 + block, green)
        wp.atomic_add(grad, chunks.slot, OUT + 16 + block, blue)
        wp.atomic_add(grad, chunks.slot, OUT + 24 + block, dense)
        if block == 0:
            wp.atomic_add(grad, chunks.slot, OUT + 32, bias)

    @kernel
    def embedding_weights(
        chunks: Chunks,
        rays: Rays,
        d: wp.array2d[Vec32],
        grad: wp.array2d[Vec32],
    ):
        """Gradient of B, after `embed_backward`."""
        chunk, third = wp.tid()
        first = chunks.start + chunk * chunks.size
        last = wp.min(first + chunks.size, chunks.stop)
        gx = Vec32()
        gy = Vec32()
        gz = Vec32()
        for n in range(first, last):
            p = sample_point(n, rays)
            gx += p[0] * d[third, n]
            gy += p[1] * d[third, n]
            gz += p[2] * d[third, n]
        wp.atomic_add(grad, chunks.slot, 3 * third, gx)
        wp.atomic_add(grad, chunks.slot, 3 * third + 1, gy)
        wp.atomic_add(grad, chunks.slot, 3 * third + 2, gz)

    @kernel
    def transpose(in_blocks: int, row: int, row_T: int, W: wp.array[Vec32], T: wp.array[Vec32]):
        """Bring a layer's transposed rows in line with its weights: one thread a row of ``T``."""
        tid = wp.tid()
        source = tid // 256
        output_block = (tid % 256) // 32
        lane = tid % 32
        first = row + 32 * (output_block * in_blocks + source)
        r = Vec32()
        for k in range(32):
            r[k] = W[first + k][lane]
        T[row_T + tid] = r

    return SimpleNamespace(
        embed=embed,
        product=product,
        output=output,
        output_backward=output_backward,
        embed_backward=embed_backward,
        layer_weights=layer_weights,
        bias_weights=bias_weights,
        output_weights=output_weights,
        embedding_weights=embedding_weights,
        transpose=transpose,
    )


CPU = imap_kernels("cpu")
CUDA = imap_kernels("cuda")
