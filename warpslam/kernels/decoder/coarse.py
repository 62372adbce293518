"""Occupancy of the coarse level (Eq. 4): no embedding, no position."""

import warp as wp

from warpslam.kernels.compositing import Listed, listed_count
from warpslam.kernels.decoder.blocks import Build
from warpslam.kernels.decoder.layout import (
    C_BIAS,
    C_C3,
    C_OUT,
    C_W0,
    C_W1,
    C_W2,
    C_W3,
    C_W4,
    RowGradient,
    Weights,
)
from warpslam.kernels.samples import Rays, Span


def coarse_kernels(build: Build) -> dict[str, wp.Kernel]:
    """Kernels by name."""
    size, Block, Level = build.size, build.Block, build.grid.Level
    block_samples, positions_of, look_up = build.block_samples, build.positions_of, build.look_up
    any_lit, output_of, outer, fill = build.any_lit, build.output_of, build.outer, build.fill
    listed_samples, wanted_of, wanted_gradient = build.listed_samples, build.wanted_of, build.wanted_gradient
    matvec, relu, store_bits, keep_active = build.matvec, build.relu, build.store_bits, build.keep_active
    add_to_grid, add_lookups = build.add_to_grid, build.add_lookups

    @build.kernel
    def coarse_forward(
        span: Span,
        min_transmittance: float,
        transmittance: wp.array[float],
        rays: Rays,
        level: Level,
        decoder: Weights,
        logit: wp.array[float],
    ):
        samples = block_samples(wp.tid(), span, rays.sample_count)
        if not any_lit(samples, rays.sample_count, transmittance, min_transmittance):
            return
        c = look_up(positions_of(samples, rays), level)
        h = matvec(fill(decoder.W[C_BIAS]), c, decoder.W, C_W0)
        store_bits(decoder.bits, samples, 0, h)
        h = matvec(fill(decoder.W[C_BIAS + 1]), relu(h), decoder.W, C_W1)
        store_bits(decoder.bits, samples, 1, h)
        h = matvec(fill(decoder.W[C_BIAS + 2]), relu(h), decoder.W, C_W2)
        store_bits(decoder.bits, samples, 2, h)
        h = matvec(matvec(fill(decoder.W[C_BIAS + 3]), c, decoder.W, C_C3), relu(h), decoder.W, C_W3)
        store_bits(decoder.bits, samples, 3, h)
        h = matvec(fill(decoder.W[C_BIAS + 4]), relu(h), decoder.W, C_W4)
        store_bits(decoder.bits, samples, 4, h)
        out = output_of(relu(h), decoder.W[C_OUT])
        for p in range(size):
            logit[samples[p]] = out[p] + decoder.W[C_OUT + 1][0]

    @build.kernel
    def coarse_backward(
        listed: Listed,
        rays: Rays,
        level: Level,
        decoder: Weights,
        logit_grad: wp.array[float],
        grid: RowGradient,
        want_point: int,
        point_grad: wp.array[wp.vec3],
    ):
        """Adjoint of `coarse_forward`; positions enter through the lookup alone."""
        thread = wp.tid()
        count = listed_count(listed)
        if size * thread >= count:
            return
        samples = listed_samples(thread, count, listed)
        wanted = wanted_of(thread, count)
        d = wanted_gradient(samples, wanted, logit_grad)
        a = keep_active(outer(d, decoder.W[C_OUT]), decoder.bits, samples, 4)
        a = keep_active(matvec(Block(), a, decoder.T, C_W4), decoder.bits, samples, 3)
        dc = matvec(Block(), a, decoder.T, C_C3)
        a = keep_active(matvec(Block(), a, decoder.T, C_W3), decoder.bits, samples, 2)
        a = keep_active(matvec(Block(), a, decoder.T, C_W2), decoder.bits, samples, 1)
        a = keep_active(matvec(Block(), a, decoder.T, C_W1), decoder.bits, samples, 0)
        dc = matvec(dc, a, decoder.T, C_W0)
        positions = positions_of(samples, rays)
        if grid.wanted != 0:
            add_to_grid(grid, listed.slot, level, samples, positions, wanted, dc)
        if want_point != 0:
            add_lookups(point_grad, samples, positions, wanted, level, dc)

    return {kernel.key: kernel for kernel in (coarse_forward, coarse_backward)}
