"""Colour (Eq. 5), its adjoint, and the gradient of its weights."""

import warp as wp

from warpslam.kernels.compositing import Listed, listed_count
from warpslam.kernels.decoder.blocks import Build
from warpslam.kernels.decoder.embedding import angles, sine_cosine
from warpslam.kernels.decoder.layers import backward_layers, forward_layers
from warpslam.kernels.decoder.layout import (
    BIAS,
    E0,
    E3,
    OUT_32,
    W1,
    WEIGHT_GROUP,
    WEIGHT_GROUP_COLUMNS,
    B,
    RowGradient,
    V,
    WeightGradient,
    Weights,
)
from warpslam.kernels.grid import Level, Vec32
from warpslam.kernels.samples import Rays, sample_point


def color_kernels(build: Build) -> dict[str, wp.Kernel]:
    """Kernels by name."""
    size, on_cpu = build.size, build.on_cpu
    Block, Scalars, Indices = build.Block, build.Scalars, build.Indices
    positions_of, look_up, listed_samples = build.positions_of, build.look_up, build.listed_samples
    output_of, outer, scaled, any_wanted = build.output_of, build.outer, build.scaled, build.any_wanted
    store_rows, load_rows, add_sum = build.store_rows, build.load_rows, build.add_sum
    embed, angle_adjoint = build.embed, build.angle_adjoint
    add_to_grid, add_to_points = build.add_to_grid, build.add_to_points
    color_layers = forward_layers(build, "color", keeps_activations=True)
    layers_backward = backward_layers(build, "color", keeps_gradients=True)

    @build.kernel
    def color_forward(
        listed: Listed,
        rays: Rays,
        level: Level,
        decoder: Weights,
        weight_gradient: WeightGradient,
        color: wp.array[wp.vec3],
    ):
        thread = wp.tid()
        count = listed_count(listed)
        if size * thread >= count:
            return
        samples = listed_samples(thread, count, listed)
        positions = positions_of(samples, rays)
        h4 = color_layers(positions, look_up(positions, level), Block(), decoder, samples, weight_gradient)
        # Channels 0..2, linear; the released code discards the fourth.
        red = output_of(h4, decoder.W[OUT_32])
        green = output_of(h4, decoder.W[OUT_32 + 1])
        blue = output_of(h4, decoder.W[OUT_32 + 2])
        bias = decoder.W[OUT_32 + 3]
        for p in range(size):
            color[samples[p]] = wp.vec3(red[p] + bias[0], green[p] + bias[1], blue[p] + bias[2])

    @build.func
    def add_outer(weights: WeightGradient, slot: int, row: int, x: int, d: int):
        """rows[row + k] += sum over a slice's group of x[k] d, both columns of what its samples stored (CPU)."""
        first = WEIGHT_GROUP * slot
        # Four rows at a time share what is read of d.
        for k in range(8):
            r0 = Vec32()
            r1 = Vec32()
            r2 = Vec32()
            r3 = Vec32()
            for q in range(WEIGHT_GROUP):
                g = weights.layer_grad[first + q, d]
                r0 += weights.layer_inputs[first + q, x, 4 * k] * g
                r1 += weights.layer_inputs[first + q, x, 4 * k + 1] * g
                r2 += weights.layer_inputs[first + q, x, 4 * k + 2] * g
                r3 += weights.layer_inputs[first + q, x, 4 * k + 3] * g
            weights.rows[slot, row + 4 * k] = weights.rows[slot, row + 4 * k] + r0
            weights.rows[slot, row + 4 * k + 1] = weights.rows[slot, row + 4 * k + 1] + r1
            weights.rows[slot, row + 4 * k + 2] = weights.rows[slot, row + 4 * k + 2] + r2
            weights.rows[slot, row + 4 * k + 3] = weights.rows[slot, row + 4 * k + 3] + r3

    @build.func
    def color_block_backward(
        block: int,
        count: int,
        group_row: int,
        listed: Listed,
        rays: Rays,
        level: Level,
        decoder: Weights,
        color_grad: wp.array[wp.vec3],
        grid: RowGradient,
        want_point: int,
        point_grad: wp.array[wp.vec3],
        weights: WeightGradient,
    ):
        """Adjoint of a block of `color_forward`; see `color_backward`. Within the kernel's loop, and not in a function,
        it is 7 % slower.

        group_row: On the CPU, the row of ``layer_grad`` that the first of its samples stores to.
        """
        samples = listed_samples(block, count, listed)
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
                if weights.wanted != 0:
                    # What an earlier group left there must not count again.
                    for p in range(size):
                        for column in range(WEIGHT_GROUP_COLUMNS):
                            weights.layer_grad[group_row + p, column] = Vec32()
            return
        rows = Indices(samples)
        if wp.static(on_cpu):
            for p in range(size):
                rows[p] = group_row + p
        slot = listed.slot
        g4 = outer(red, decoder.W[OUT_32]) + outer(green, decoder.W[OUT_32 + 1]) + outer(blue, decoder.W[OUT_32 + 2])
        dc, a0, a3 = layers_backward(g4, decoder, samples, slot, rows, weights)
        positions = positions_of(samples, rays)
        if grid.wanted != 0:
            add_to_grid(grid, slot, level, positions, wanted, dc)
        if want_point != 0:
            add_to_points(point_grad, samples, positions, wanted, level, decoder, dc, a0, a3)
        if weights.wanted != 0:
            store_rows(weights.layer_grad, rows, 13, look_up(positions, level), weights.wanted)
            if wp.static(on_cpu):
                # What the group's matrix products need besides, and the single rows at once. Samples that are not
                # wanted add zero, whatever activations they have.
                for layer in range(4):
                    h = load_rows(weights.activations, samples, layer)
                    store_rows(weights.layer_grad, rows, 14 + layer, h, weights.wanted)
                h4 = load_rows(weights.activations, samples, 4)
                add_sum(weights.rows, slot, OUT_32, scaled(red, h4))
                add_sum(weights.rows, slot, OUT_32 + 1, scaled(green, h4))
                add_sum(weights.rows, slot, OUT_32 + 2, scaled(blue, h4))
                bias = Vec32()
                for p in range(size):
                    bias[0] += red[p]
                    bias[1] += green[p]
                    bias[2] += blue[p]
                weights.rows[slot, OUT_32 + 3] = weights.rows[slot, OUT_32 + 3] + bias
            for chunk in range(3):
                da = angle_adjoint(positions, decoder, chunk, a0, a3)
                if wp.static(on_cpu):
                    store_rows(weights.layer_grad, rows, 10 + chunk, embed(positions, decoder.W, chunk), weights.wanted)
                    for axis in range(3):
                        coordinate = Scalars()
                        for p in range(size):
                            coordinate[p] = positions[p, axis]
                        add_sum(weights.rows, slot, B + 3 * chunk + axis, scaled(coordinate, da))
                else:
                    store_rows(weights.layer_grad, rows, 10 + chunk, da, weights.wanted)

    @build.kernel
    def color_backward(
        listed: Listed,
        blocks: int,
        rays: Rays,
        level: Level,
        decoder: Weights,
        color_grad: wp.array[wp.vec3],
        grid: RowGradient,
        want_point: int,
        point_grad: wp.array[wp.vec3],
        weights: WeightGradient,
    ):
        """Adjoint of `color_forward`; a thread works on ``blocks`` blocks, on the CPU on `WEIGHT_GROUP` samples."""
        thread = wp.tid()
        count = listed_count(listed)
        if size * blocks * thread >= count:
            return
        for n in range(blocks):
            color_block_backward(
                blocks * thread + n, count, WEIGHT_GROUP * listed.slot + size * n, listed, rays, level, decoder,
                color_grad, grid, want_point, point_grad, weights,
            )  # fmt: skip
        if wp.static(on_cpu):
            if weights.wanted != 0:
                for layer in range(4):
                    add_outer(weights, listed.slot, W1 + 32 * layer, 14 + layer, 1 + layer)
                for layer in range(5):
                    add_outer(weights, listed.slot, V + 32 * layer, 13, 5 + layer)
                for chunk in range(3):
                    add_outer(weights, listed.slot, E0 + 32 * chunk, 10 + chunk, 0)
                    add_outer(weights, listed.slot, E3 + 32 * chunk, 10 + chunk, 3)

    @build.kernel
    def color_weights(
        point_count: int,
        chunk_size: int,
        rays: Rays,
        decoder: Weights,
        color_grad: wp.array[wp.vec3],
        weights: WeightGradient,
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
                x = float(1.0)
                column = int(0)
                if row < E0:
                    chunk = row // 3
                    x = sample_point(n, rays)[row - 3 * chunk]
                    column = 10 + chunk
                elif row < W1:
                    j = row - E0
                    if j >= 96:
                        j -= 96
                        column = 3
                    x = sine_cosine(angles(sample_point(n, rays), decoder.W, j // 32)[j % 32])[0]
                elif row < BIAS:
                    layer = (row - W1) // 32
                    x = weights.activations[n, layer][row - W1 - 32 * layer]
                    column = layer + 1
                elif row < V:
                    column = row - BIAS
                elif row < OUT_32:
                    layer = (row - V) // 32
                    x = weights.layer_grad[n, 13][row - V - 32 * layer]
                    column = 5 + layer
                if row < OUT_32:
                    total += x * weights.layer_grad[n, column]
                elif row < OUT_32 + 3:
                    total += d[row - OUT_32] * weights.activations[n, 4]
                else:
                    for k in range(3):
                        total[k] += d[k]
        wp.atomic_add(weights.rows, 0, row, total)

    @build.kernel
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

    kernels = (color_forward, color_backward, color_weights, transpose_color_weights)
    return {kernel.key: kernel for kernel in kernels}
