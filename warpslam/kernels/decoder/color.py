"""Colour (Eq. 5), its adjoint, and the gradient of its weights."""

import warp as wp

from warpslam.kernels.compositing import Listed, listed_count
from warpslam.kernels.decoder.blocks import Build
from warpslam.kernels.decoder.layers import backward_layers, forward_layers
from warpslam.kernels.decoder.layout import (
    BIAS,
    COLOR_WEIGHT_ROWS,
    E0,
    E3,
    OUT_32,
    STORED_COLUMNS,
    W1,
    WEIGHT_GROUP,
    WEIGHT_GROUP_COLUMNS,
    B,
    RowGradient,
    V,
    WeightGradient,
    Weights,
)
from warpslam.kernels.decoder.native import add_outer, add_scaled_column, entry, put_row
from warpslam.kernels.grid import Vec32
from warpslam.kernels.samples import Rays, sample_point


def color_kernels(build: Build) -> dict[str, wp.Kernel]:
    """Kernels by name."""
    Level = build.grid.Level
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
    def add_product(weights: WeightGradient, slot: int, row: int, x: int, d: int):
        """rows[row + k] += sum over a slice's group of x[k] d, both columns of what its samples stored (CPU)."""
        add_outer(weights.rows, slot, row, weights.layer_grad, WEIGHT_GROUP * slot, WEIGHT_GROUP, x, d)

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
            else:
                # What an earlier iteration left there must not count again.
                if grid.wanted != 0:
                    put_row(grid.by_sample, samples[0], 0, Vec32())
                if weights.wanted != 0:
                    for column in range(STORED_COLUMNS):
                        put_row(weights.layer_grad, samples[0], column, Vec32())
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
            add_to_grid(grid, slot, level, samples, positions, wanted, dc)
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
                e = embed(positions, decoder.W, chunk)
                if wp.static(on_cpu):
                    store_rows(weights.layer_grad, rows, 10 + chunk, e, weights.wanted)
                    for axis in range(3):
                        coordinate = Scalars()
                        for p in range(size):
                            coordinate[p] = positions[p, axis]
                        add_sum(weights.rows, slot, B + 3 * chunk + axis, scaled(coordinate, da))
                else:
                    store_rows(weights.layer_grad, rows, 10 + chunk, da, weights.wanted)
                    store_rows(weights.layer_grad, rows, 14 + chunk, e, weights.wanted)

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
                    add_product(weights, listed.slot, W1 + 32 * layer, 14 + layer, 1 + layer)
                for layer in range(5):
                    add_product(weights, listed.slot, V + 32 * layer, 13, 5 + layer)
                for chunk in range(3):
                    add_product(weights, listed.slot, E0 + 32 * chunk, 10 + chunk, 0)
                    add_product(weights, listed.slot, E3 + 32 * chunk, 10 + chunk, 3)

    @build.kernel
    def color_weights(listed: Listed, rays: Rays, color_grad: wp.array[wp.vec3], weights: WeightGradient):
        """Sum the weight gradient x^T d of a part of the listed samples into a buffer (CUDA).

        A thread a row, 32 rows of one matrix side by side, so that they share what is read of d; single rows come last.
        """
        slot, section, lane = wp.tid()
        count = listed_count(listed)
        share = (count + weights.rows.shape[0] - 1) // weights.rows.shape[0]
        # Columns of what the samples stored: of d, and of x, which for W_1..W_4 is h_0..h_3.
        d = int(0)
        x = int(0)
        target = lane
        from_activations = section >= 6 and section < 10
        if section < 3:
            x = 14 + section
            target += E0 + 32 * section
        elif section < 6:
            d = 3
            x = 14 + section - 3
            target += E3 + 32 * (section - 3)
        elif section < 10:
            d = section - 5
            x = section - 6
            target += W1 + 32 * (section - 6)
        elif section < 15:
            d = section - 5
            x = 13
            target += V + 32 * (section - 10)
        elif lane < E0:
            d = 10 + lane // 3
        elif lane < E0 + 10:
            d = lane - E0
            target += BIAS - E0
        else:
            target += OUT_32 - E0 - 10
        if target >= COLOR_WEIGHT_ROWS:
            return
        total = Vec32()
        for place in range(slot * share, wp.min(slot * share + share, count)):
            sample = listed.samples[listed.start + place]
            if target < OUT_32:
                factor = float(1.0)
                if from_activations:
                    factor = entry(weights.activations, sample, x, lane)
                elif section < 15:
                    factor = entry(weights.layer_grad, sample, x, lane)
                elif lane < E0:
                    factor = sample_point(sample, rays)[lane - 3 * (lane // 3)]
                total = add_scaled_column(total, factor, weights.layer_grad, sample, d)
            elif target < OUT_32 + 3:
                by_color = color_grad[sample]
                total = add_scaled_column(total, by_color[target - OUT_32], weights.activations, sample, 4)
            else:
                by_color = color_grad[sample]
                for k in range(3):
                    total[k] += by_color[k]
        weights.rows[slot, target] = weights.rows[slot, target] + total

    @build.func
    def transposed_source(row: int) -> int:
        """First row of the matrix whose transpose a row belongs to."""
        block = row // 32
        source = V + 32 * (block - 10)
        if block < 3:
            source = E0 + 32 * block
        elif block < 6:
            source = E3 + 32 * (block - 3)
        elif block < 10:
            source = W1 + 32 * (block - 6)
        return source

    @build.kernel
    def transpose_color_weights(W: wp.array[Vec32], T: wp.array[Vec32]):
        """Bring the transposed rows in line with the weights: one thread a row of ``T`` (480)."""
        row = wp.tid()
        source = transposed_source(row)
        r = Vec32()
        for k in range(32):
            r[k] = W[source + k][row % 32]
        T[row] = r

    @build.kernel
    def transpose_color_entries(W: wp.array2d[float], T: wp.array2d[float]):
        """The same, one thread a number (CUDA)."""
        row, k = wp.tid()
        T[row, k] = W[transposed_source(row) + k, row % 32]

    kernels = [color_forward, color_backward, transpose_color_weights]
    if not on_cpu:
        kernels += [color_weights, transpose_color_entries]
    return {kernel.key: kernel for kernel in kernels}
