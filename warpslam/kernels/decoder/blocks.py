"""Blocks of samples: matrix products, ReLUs, lookups.

All functions are built for one target and kept in a `Build`, whose Warp module they and the kernels end in.
"""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpslam.kernels import dense, grid
from warpslam.kernels.compositing import Listed
from warpslam.kernels.decoder.embedding import angles, sine_cosine
from warpslam.kernels.decoder.layout import BLOCK_SIZE, E0_T, E3_T, B, RowGradient, Weights
from warpslam.kernels.decoder.native import add_scaled, dot_row, native_matvec, put_row
from warpslam.kernels.grid import Cell, Vec32, corner_weight, dot32, sum32
from warpslam.kernels.samples import Rays, Span, sample_index, sample_point


class Build(SimpleNamespace):
    """What the kernels for one target are made of.

    size: Samples of a block.
    layout: How the rows of grids are laid out, "dense" or "blocks".
    grid: Python module with the lattice, its levels and their lookup.
    on_cpu: Whether this is the CPU, whose compiler wants constant trip counts; CUDA's wants rolled loops.
    module: Name of the Warp module.
    Block, Positions, Scalars, Indices: Types of ``size`` rows of 32 and of 3 numbers, and of one number a sample.

    The functions that `block_functions` and `sample_functions` add are attributes, too.
    """

    def __init__(self, target: str, layout: str) -> None:
        size = BLOCK_SIZE[target]
        super().__init__(
            size=size,
            on_cpu=target == "cpu",
            grid=dense if layout == "dense" else grid,
            module=f"warpslam.decoder_{target}" + ("" if layout == "dense" else f"_{layout}"),
            Block=wp.types.matrix(shape=(size, 32), dtype=wp.float32),
            Positions=wp.types.matrix(shape=(size, 3), dtype=wp.float32),
            Scalars=wp.types.vector(length=size, dtype=wp.float32),
            Indices=wp.types.vector(length=size, dtype=wp.int32),
        )
        # Without contraction, clang does not fuse a product and a sum of vectors into one instruction.
        flags = f"{wp.config.cpu_compiler_flags or ''} -ffp-contract=fast"
        options = {"enable_backward": False, "max_unroll": 4, "cpu_compiler_flags": flags, "block_dim": 32}
        wp.get_module(self.module).options.update(options)
        block_functions(self)
        quad_functions(self)
        sample_functions(self)

    def kernel(self, function: Callable) -> wp.Kernel:
        """Decorator of a kernel."""
        return wp.kernel(function, module=self.module, name=function.__name__, enable_backward=False)

    def func(self, function: Callable, name: str = "") -> Any:
        """Decorator of a function, which becomes an attribute."""
        result = wp.func(function, module=self.module, name=name or function.__name__)
        setattr(self, name or function.__name__, result)
        return result


def block_functions(build: Build) -> None:
    """Arithmetic on blocks."""
    size, on_cpu, func = build.size, build.on_cpu, build.func
    Block, Scalars, Indices, Positions = build.Block, build.Scalars, build.Indices, build.Positions

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

    matvec = build.matvec = native_matvec(Block, on_cpu=on_cpu)

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
    def add_sum(grad: wp.array2d[Vec32], slot: int, row: int, d: Block):
        """grad[row] += sum over the block of d."""
        total = Vec32()
        for p in range(size):
            total += d[p]
        grad[slot, row] = grad[slot, row] + total

    @func
    def store_rows(rows: wp.array2d[Vec32], samples: Indices, column: int, a: Block, wanted: int):
        if wanted != 0:
            for p in range(size):
                if wp.static(on_cpu):
                    rows[samples[p], column] = a[p]
                else:
                    put_row(rows, samples[p], column, a[p])

    @func
    def load_rows(rows: wp.array2d[Vec32], samples: Indices, column: int) -> Block:
        a = Block()
        for p in range(size):
            a[p] += rows[samples[p], column]
        return a

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
    def angle_adjoint(positions: Positions, decoder: Weights, chunk: int, a0: Block, a3: Block) -> Block:
        """Gradient of the angles p B of a chunk from those of the layers that the embedding enters, 0 and 3."""
        d = matvec(Block(), a0, decoder.T, E0_T + 32 * chunk)
        d = matvec(d, a3, decoder.T, E3_T + 32 * chunk)
        r = Block()
        for p in range(size):
            a = angles(wp.vec3(positions[p, 0], positions[p, 1], positions[p, 2]), decoder.W, chunk)
            for i in range(32):
                r[p, i] = d[p, i] * sine_cosine(a[i])[1]
        return r


def quad_functions(build: Build) -> None:
    """Lookups for CUDA."""
    func, Level, row_of = build.func, build.grid.Level, build.grid.row_of

    @func
    def interpolate_quads(level: Level, cell: Cell) -> Vec32:
        """`interpolate` for CUDA."""
        c = Vec32()
        for di in range(2):
            for dj in range(2):
                for dk in range(2):
                    row = row_of(level.lattice, cell.corner[0] + di, cell.corner[1] + dj, cell.corner[2] + dk)
                    c = add_scaled(c, corner_weight(cell.offset, di, dj, dk), level.features, row)
        return c

    @func
    def interpolate_adjoint_point_quads(level: Level, cell: Cell, dc: Vec32) -> wp.vec3:
        """`interpolate_adjoint_point` for CUDA: a product a corner takes fewer registers than a vector an axis."""
        f = cell.offset
        du = wp.vec3()
        for di in range(2):
            for dj in range(2):
                for dk in range(2):
                    row = row_of(level.lattice, cell.corner[0] + di, cell.corner[1] + dj, cell.corner[2] + dk)
                    s = dot_row(dc, level.features, row)
                    wx = wp.where(di == 1, f[0], 1.0 - f[0])
                    wy = wp.where(dj == 1, f[1], 1.0 - f[1])
                    wz = wp.where(dk == 1, f[2], 1.0 - f[2])
                    du += s * wp.vec3(
                        wp.where(di == 1, wy * wz, -wy * wz),
                        wp.where(dj == 1, wx * wz, -wx * wz),
                        wp.where(dk == 1, wx * wy, -wx * wy),
                    )
        return wp.cw_mul(wp.cw_mul(du, cell.free), level.lattice.inverse_spacing)


def sample_functions(build: Build) -> None:
    """Which samples a thread works on, where they lie, and what their positions get and give."""
    size, func = build.size, build.func
    Block, Scalars, Indices, Positions = build.Block, build.Scalars, build.Indices, build.Positions
    on_cpu, angle_adjoint = build.on_cpu, build.angle_adjoint
    Level, find_cell, interpolate = build.grid.Level, build.grid.find_cell, build.grid.interpolate
    interpolate_adjoint_point = build.grid.interpolate_adjoint_point
    interpolate_adjoint_features = build.grid.interpolate_adjoint_features
    # The same in the other's words, see `quad_functions`.
    if not on_cpu:
        interpolate, interpolate_adjoint_point = build.interpolate_quads, build.interpolate_adjoint_point_quads

    @func
    def block_samples(thread: int, span: Span, sample_count: int) -> Indices:
        """Samples of a thread; at the end of a launch the last one stands in for those that are missing."""
        samples = Indices()
        for p in range(size):
            samples[p] = sample_index(wp.min(size * thread + p, span.point_count - 1), span, sample_count)
        return samples

    @func
    def wanted_of(thread: int, count: int) -> Indices:
        """Which samples of a thread are on a list of ``count``: all but those behind its end."""
        wanted = Indices()
        for p in range(size):
            wanted[p] = wp.where(size * thread + p < count, 1, 0)
        return wanted

    @func
    def listed_samples(thread: int, count: int, listed: Listed) -> Indices:
        """Samples of a thread on a list; the last one stands in for those behind its end."""
        samples = Indices()
        for p in range(size):
            samples[p] = listed.samples[listed.start + wp.min(size * thread + p, count - 1)]
        return samples

    @func
    def wanted_gradient(samples: Indices, wanted: Indices, logit_grad: wp.array[float]) -> Scalars:
        d = Scalars()
        for p in range(size):
            d[p] = wp.where(wanted[p] != 0, logit_grad[samples[p]], 0.0)
        return d

    @func
    def any_wanted(wanted: Indices) -> bool:
        result = bool(False)
        for p in range(size):
            if wanted[p] != 0:
                result = True
        return result

    @func
    def any_lit(samples: Indices, sample_count: int, transmittance: wp.array[float], min_transmittance: float) -> bool:
        lit = bool(False)
        for p in range(size):
            if transmittance[samples[p] // sample_count] >= min_transmittance:
                lit = True
        return lit

    @func
    def positions_of(samples: Indices, rays: Rays) -> Positions:
        positions = Positions()
        for p in range(size):
            positions[p] = sample_point(samples[p], rays)
        return positions

    @func
    def look_up(positions: Positions, level: Level) -> Block:
        c = Block()
        for p in range(size):
            x = wp.vec3(positions[p, 0], positions[p, 1], positions[p, 2])
            c[p] += interpolate(level, find_cell(level.lattice, x))
        return c

    @func
    def add_to_grid(
        gradient: RowGradient,
        slot: int,
        level: Level,
        samples: Indices,
        positions: Positions,
        wanted: Indices,
        dc: Block,
    ):
        """On CUDA `scatter_features` does it: here a warp would add to 32 rows at a time."""
        for p in range(size):
            if wanted[p] != 0:
                if wp.static(on_cpu):
                    x = wp.vec3(positions[p, 0], positions[p, 1], positions[p, 2])
                    cell = find_cell(level.lattice, x)
                    interpolate_adjoint_features(gradient.rows, slot, gradient.place, level.lattice, cell, dc[p])
                else:
                    put_row(gradient.by_sample, samples[p], 0, dc[p])

    @func
    def add_lookups(
        point_grad: wp.array[wp.vec3],
        samples: Indices,
        positions: Positions,
        wanted: Indices,
        level: Level,
        dc: Block,
    ):
        """`add_to_points` of a decoder without embedding: through the lookup."""
        for p in range(size):
            if wanted[p] != 0:
                x = wp.vec3(positions[p, 0], positions[p, 1], positions[p, 2])
                d = interpolate_adjoint_point(level, find_cell(level.lattice, x), dc[p])
                point_grad[samples[p]] = point_grad[samples[p]] + d

    @func
    def add_to_points(
        point_grad: wp.array[wp.vec3],
        samples: Indices,
        positions: Positions,
        wanted: Indices,
        level: Level,
        decoder: Weights,
        dc: Block,
        a0: Block,
        a3: Block,
    ):
        """Through the lookup and through the embedding."""
        d = Positions()
        for p in range(size):
            x = wp.vec3(positions[p, 0], positions[p, 1], positions[p, 2])
            d[p] = interpolate_adjoint_point(level, find_cell(level.lattice, x), dc[p])
        # Sums over the channels are slow on the CPU: there the chunks are added first. On CUDA registers are scarce.
        along_x = Block()
        along_y = Block()
        along_z = Block()
        for chunk in range(3):
            da = angle_adjoint(positions, decoder, chunk, a0, a3)
            row = B + 3 * chunk
            for p in range(size):
                if wp.static(on_cpu):
                    along_x[p] += wp.cw_mul(da[p], decoder.W[row])
                    along_y[p] += wp.cw_mul(da[p], decoder.W[row + 1])
                    along_z[p] += wp.cw_mul(da[p], decoder.W[row + 2])
                else:
                    d[p] += wp.vec3(
                        dot32(da[p], decoder.W[row]),
                        dot32(da[p], decoder.W[row + 1]),
                        dot32(da[p], decoder.W[row + 2]),
                    )
        for p in range(size):
            if wp.static(on_cpu):
                d[p] += wp.vec3(sum32(along_x[p]), sum32(along_y[p]), sum32(along_z[p]))
            if wanted[p] != 0:
                point_grad[samples[p]] = point_grad[samples[p]] + wp.vec3(d[p, 0], d[p, 1], d[p, 2])
