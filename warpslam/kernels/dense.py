"""What the decoders read of a grid whose rows are dense: `warpslam.kernels.grid` without blocks.

A table beside the formula, and be it behind a branch that is never taken, has the compiler fuse other products and
sums, and results differ in their last bits. So decoders are built twice, and those of dense grids have kept theirs.
"""

import warp as wp

from warpslam.kernels.grid import Cell, Vec32, corner_weight, dot32


@wp.struct
class Lattice:
    """Vertex (i, j, k) lies at ``origin + (i, j, k) / inverse_spacing`` [m]."""

    origin: wp.vec3
    inverse_spacing: wp.vec3
    shape: wp.vec3i


@wp.struct
class Level:
    """A grid as the decoders read it: where its vertices lie, and their features, one row a vertex."""

    lattice: Lattice
    features: wp.array[Vec32]


@wp.func
def row_of(lattice: Lattice, i: int, j: int, k: int) -> int:
    """Row of a lattice vertex. Everything that touches features goes through here."""
    return (i * lattice.shape[1] + j) * lattice.shape[2] + k


@wp.func
def find_cell(lattice: Lattice, p: wp.vec3) -> Cell:
    cell = Cell()
    u = wp.cw_mul(p - lattice.origin, lattice.inverse_spacing)
    for axis in range(3):
        last = lattice.shape[axis] - 1
        x = u[axis]
        free = float(1.0)
        # Border padding; the gradient along a clamped axis is zero (grid_sample's rule). NaN is clamped, too.
        if not (x > 0.0):
            x = float(0.0)
            free = float(0.0)
        if x >= float(last):
            x = float(last)
            free = float(0.0)
        low = wp.clamp(int(x), 0, last - 1)  # whatever comes in, no index leaves the grid
        cell.corner[axis] = low
        cell.offset[axis] = x - float(low)
        cell.free[axis] = free
    return cell


@wp.func
def interpolate(level: Level, cell: Cell) -> Vec32:
    """Trilinear features at a point."""
    i = cell.corner[0]
    j = cell.corner[1]
    k = cell.corner[2]
    c = Vec32()
    for di in range(2):
        for dj in range(2):
            for dk in range(2):
                row = row_of(level.lattice, i + di, j + dj, k + dk)
                c += corner_weight(cell.offset, di, dj, dk) * level.features[row]
    return c


@wp.func
def interpolate_adjoint_point(level: Level, cell: Cell, dc: Vec32) -> wp.vec3:
    """Gradient with respect to the point."""
    i = cell.corner[0]
    j = cell.corner[1]
    k = cell.corner[2]
    f = cell.offset
    # Derivatives of the features along the axes, then three products with dc instead of one a corner.
    along_x = Vec32()
    along_y = Vec32()
    along_z = Vec32()
    for di in range(2):
        for dj in range(2):
            for dk in range(2):
                row = level.features[row_of(level.lattice, i + di, j + dj, k + dk)]
                wx = wp.where(di == 1, f[0], 1.0 - f[0])
                wy = wp.where(dj == 1, f[1], 1.0 - f[1])
                wz = wp.where(dk == 1, f[2], 1.0 - f[2])
                along_x += wp.where(di == 1, wy * wz, -wy * wz) * row
                along_y += wp.where(dj == 1, wx * wz, -wx * wz) * row
                along_z += wp.where(dk == 1, wx * wy, -wx * wy) * row
    du = wp.vec3(dot32(dc, along_x), dot32(dc, along_y), dot32(dc, along_z))
    return wp.cw_mul(wp.cw_mul(du, cell.free), level.lattice.inverse_spacing)


@wp.func
def interpolate_adjoint_features(
    grad: wp.array2d[Vec32],
    slot: int,
    place: wp.array[int],
    lattice: Lattice,
    cell: Cell,
    dc: Vec32,
):
    """Add the gradient to those of the 8 rows that have a place, in gradient buffer ``slot`` (one a CPU thread)."""
    i = cell.corner[0]
    j = cell.corner[1]
    k = cell.corner[2]
    for di in range(2):
        for dj in range(2):
            for dk in range(2):
                n = place[row_of(lattice, i + di, j + dj, k + dk)]
                if n >= 0:
                    wp.atomic_add(grad, slot, n, corner_weight(cell.offset, di, dj, dk) * dc)
