"""From the gradients of the samples' features to those of a grid's rows, one thread a channel (CUDA).

    grad[row] += sum over the samples of w_corner * dc

A thread works on a run of listed samples. Those of one ray lie side by side in a list, often in the same cell, whose
sums it keeps in registers; and the 32 threads of a row add to 128 bytes in a row.
"""

import warp as wp

from warpslam.kernels.compositing import Listed, listed_count
from warpslam.kernels.decoder.blocks import Build
from warpslam.kernels.decoder.layout import RUN, RowGradient
from warpslam.kernels.grid import corner_weight
from warpslam.kernels.samples import Rays, sample_point

Vec8 = wp.types.vector(length=8, dtype=wp.float32)


def scatter_kernels(build: Build) -> dict[str, wp.Kernel]:
    """Kernels by name."""
    Lattice, find_cell, row_of = build.grid.Lattice, build.grid.find_cell, build.grid.row_of

    @build.func
    def flush(grid: RowGradient, lattice: Lattice, corner: wp.vec3i, channel: int, total: Vec8):
        for di in range(2):
            for dj in range(2):
                for dk in range(2):
                    if total[4 * di + 2 * dj + dk] != 0.0:
                        n = grid.place[row_of(lattice, corner[0] + di, corner[1] + dj, corner[2] + dk)]
                        if n >= 0:
                            wp.atomic_add(grid.entries, 0, n, channel, total[4 * di + 2 * dj + dk])

    @build.kernel
    def scatter_features(listed: Listed, rays: Rays, lattice: Lattice, grid: RowGradient):
        run, channel = wp.tid()
        count = listed_count(listed)
        if RUN * run >= count:
            return
        corner = wp.vec3i(0, 0, 0)
        total = Vec8()
        last = wp.min(RUN * run + RUN, count)
        for place in range(RUN * run, last):
            sample = listed.samples[listed.start + place]
            d = grid.entries_by_sample[sample, channel]
            if d != 0.0:
                cell = find_cell(lattice, sample_point(sample, rays))
                if cell.corner[0] != corner[0] or cell.corner[1] != corner[1] or cell.corner[2] != corner[2]:
                    flush(grid, lattice, corner, channel, total)
                    corner = cell.corner
                    total = Vec8()
                for di in range(2):
                    for dj in range(2):
                        for dk in range(2):
                            total[4 * di + 2 * dj + dk] += corner_weight(cell.offset, di, dj, dk) * d
        flush(grid, lattice, corner, channel, total)

    return {scatter_features.key: scatter_features}
