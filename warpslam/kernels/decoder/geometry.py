"""Occupancy of the middle and the fine level (Eq. 1-3), and the adjoint that both share."""

import warp as wp

from warpslam.kernels.compositing import Listed, listed_count
from warpslam.kernels.decoder.blocks import Build
from warpslam.kernels.decoder.layers import backward_layers, forward_layers
from warpslam.kernels.decoder.layout import OUT_32, OUT_64, RowGradient, WeightGradient, Weights
from warpslam.kernels.samples import Rays, Span


def geometry_kernels(build: Build) -> dict[str, wp.Kernel]:
    """Kernels by name."""
    size, Level = build.size, build.grid.Level
    Block, Scalars, Indices = build.Block, build.Scalars, build.Indices
    block_samples, positions_of, look_up = build.block_samples, build.positions_of, build.look_up
    any_lit, output_of, outer = build.any_lit, build.output_of, build.outer
    listed_samples, wanted_of, wanted_gradient = build.listed_samples, build.wanted_of, build.wanted_gradient
    add_to_grid, add_to_points = build.add_to_grid, build.add_to_points
    middle_layers = forward_layers(build, "middle")
    fine_layers = forward_layers(build, "fine", two_features=True)
    layers_backward = backward_layers(build, "geometry")

    @build.kernel
    def middle_forward(
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
        positions = positions_of(samples, rays)
        h = middle_layers(positions, look_up(positions, level), Block(), decoder, samples, WeightGradient())
        out = output_of(h, decoder.W[OUT_32])
        for p in range(size):
            logit[samples[p]] = out[p] + decoder.W[OUT_32 + 1][0]

    @build.kernel
    def fine_forward(
        span: Span,
        min_transmittance: float,
        transmittance: wp.array[float],
        rays: Rays,
        level: Level,
        middle: Level,
        decoder: Weights,
        logit: wp.array[float],
    ):
        samples = block_samples(wp.tid(), span, rays.sample_count)
        if not any_lit(samples, rays.sample_count, transmittance, min_transmittance):
            return
        positions = positions_of(samples, rays)
        c = look_up(positions, level)
        m = look_up(positions, middle)
        h = fine_layers(positions, c, m, decoder, samples, WeightGradient())
        out = output_of(h, decoder.W[OUT_64])
        # Eq. 3: the fine level adds a residual to the logit of the middle level. A sample that stands in for a missing
        # one is the block's last, so that its logit is read before it is written.
        total = Scalars()
        for p in range(size):
            total[p] = logit[samples[p]] + out[p] + decoder.W[OUT_64 + 1][0]
        for p in range(size):
            logit[samples[p]] = total[p]

    @build.kernel
    def geometry_backward(
        listed: Listed,
        rays: Rays,
        level: Level,
        decoder: Weights,
        output_row: int,
        logit_grad: wp.array[float],
        grid: RowGradient,
        want_point: int,
        point_grad: wp.array[wp.vec3],
    ):
        """Adjoint of `middle_forward` and of `fine_forward` (they differ in ``output_row``)."""
        thread = wp.tid()
        count = listed_count(listed)
        if size * thread >= count:
            return
        samples = listed_samples(thread, count, listed)
        wanted = wanted_of(thread, count)
        d = wanted_gradient(samples, wanted, logit_grad)
        g4 = outer(d, decoder.W[output_row])
        dc, a0, a3 = layers_backward(g4, decoder, samples, listed.slot, Indices(), WeightGradient())
        positions = positions_of(samples, rays)
        if grid.wanted != 0:
            add_to_grid(grid, listed.slot, level, samples, positions, wanted, dc)
        if want_point != 0:
            add_to_points(point_grad, samples, positions, wanted, level, decoder, dc, a0, a3)

    return {kernel.key: kernel for kernel in (middle_forward, fine_forward, geometry_backward)}
