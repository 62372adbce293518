"""Feature grids: lattice, the one function from a vertex to its row, trilinear lookup and its adjoint.

A level stores one row of 32 features per lattice vertex, array ``features`` of shape (row_count,), dtype `Vec32`.

    u    = (p - origin) / spacing, clamped to [0, shape - 1] on every axis
    c(p) = sum over the 8 corners of the cell: w_corner(u) * features[row_of(corner)]

Adjoint for an incoming gradient dc: ``grad[place[row]] += w_corner * dc`` for rows that have a place, and
``dp = sum_corner (dw_corner / du) (dc . features[row]) / spacing``, zero along an axis that was clamped.

Rows are laid out in one of two ways. Dense: one for each vertex of the box, in the order of i, j, k. In blocks: the box
is cut into blocks of 4 x 4 x 4 vertices at whole multiples of 4 of the world lattice, and only blocks that were made
have rows, in the order in which they were made; their features begin as those of a dense grid. All others share the
first 64, which begin alike and are never written.
"""

import warp as wp

FEATURE_DIM = 32
Vec32 = wp.types.vector(length=FEATURE_DIM, dtype=wp.float32)
Vec16 = wp.types.vector(length=FEATURE_DIM // 2, dtype=wp.float32)

BLOCK = 4
"""Vertices of a block along each axis. At a spacing of 8 cm a block of 8 would be wider than what stands in a room."""

BLOCK_ROWS = BLOCK**3


@wp.struct
class Lattice:
    """Vertex (i, j, k) lies at ``origin + (i, j, k) / inverse_spacing`` [m].

    Of a lattice in blocks (all zero of a dense one):

    shared: Rows that the vertices without rows of their own share; the rows from there on are written to.
    first: World lattice index of vertex (0, 0, 0).
    offset: Where vertex (0, 0, 0) lies in its block.
    blocks: Blocks of the box along each axis.
    table: First row of each block of the box, 0 of those that were not made.
    corners: World lattice index of the first vertex of each block that was made, in their order.
    """

    origin: wp.vec3
    inverse_spacing: wp.vec3
    shape: wp.vec3i
    shared: int
    first: wp.vec3i
    offset: wp.vec3i
    blocks: wp.vec3i
    table: wp.array[int]
    corners: wp.array[wp.vec3i]


@wp.struct
class Level:
    """A grid as the decoders read it: where its vertices lie, and their features, one row a vertex."""

    lattice: Lattice
    features: wp.array[Vec32]


@wp.struct
class Start:
    """Features that vertices of a level begin with: ``mean`` plus normal ones of deviation ``std``."""

    seed: int
    level: int
    std: float
    mean: Vec32


@wp.struct
class Cell:
    """Where a point lies in the lattice: lower corner, offset inside the cell in [0, 1], 1 on axes that are not
    clamped.
    """

    corner: wp.vec3i
    offset: wp.vec3
    free: wp.vec3


@wp.func
def row_of(lattice: Lattice, i: int, j: int, k: int) -> int:
    """Row of a lattice vertex. Everything that touches features goes through here."""
    if lattice.shared == 0:
        return (i * lattice.shape[1] + j) * lattice.shape[2] + k
    a = i + lattice.offset[0]
    b = j + lattice.offset[1]
    c = k + lattice.offset[2]
    first = lattice.table[((a >> 2) * lattice.blocks[1] + (b >> 2)) * lattice.blocks[2] + (c >> 2)]
    return first + (((a & 3) << 4) | ((b & 3) << 2) | (c & 3))


@wp.func
def vertex_of(lattice: Lattice, row: int) -> wp.vec3i:
    """The vertex of a row that is not shared. Blocks reach beyond the box."""
    if lattice.shared == 0:
        ij = row // lattice.shape[2]
        return wp.vec3i(ij // lattice.shape[1], ij % lattice.shape[1], row % lattice.shape[2])
    n = row & 63
    return lattice.corners[(row >> 6) - 1] + wp.vec3i(n >> 4, (n >> 2) & 3, n & 3) - lattice.first


@wp.func
def vertex_position(lattice: Lattice, i: int, j: int, k: int) -> wp.vec3:
    """Where a lattice vertex lies [m]."""
    spacing = wp.cw_div(wp.vec3(1.0, 1.0, 1.0), lattice.inverse_spacing)
    return lattice.origin + wp.cw_mul(wp.vec3(float(i), float(j), float(k)), spacing)


@wp.func
def row_position(lattice: Lattice, row: int) -> wp.vec3:
    """Where the vertex of a row lies that is not shared [m]."""
    v = vertex_of(lattice, row)
    return vertex_position(lattice, v[0], v[1], v[2])


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
def corner_weight(offset: wp.vec3, di: int, dj: int, dk: int) -> float:
    wx = wp.where(di == 1, offset[0], 1.0 - offset[0])
    wy = wp.where(dj == 1, offset[1], 1.0 - offset[1])
    wz = wp.where(dk == 1, offset[2], 1.0 - offset[2])
    return wx * wy * wz


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
def sum32(a: Vec32) -> float:
    # Halves are added to one another: `wp.dot` is one serial chain of 32 additions on the CPU backend.
    s = Vec16()
    for i in range(16):
        s[i] = a[i] + a[i + 16]
    t = wp.vec4()
    for i in range(4):
        t[i] = (s[i] + s[i + 4]) + (s[i + 8] + s[i + 12])
    return (t[0] + t[2]) + (t[1] + t[3])


@wp.func
def dot32(a: Vec32, b: Vec32) -> float:
    return sum32(wp.cw_mul(a, b))


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


@wp.func
def init_normal(start: Start, i: int, j: int, k: int) -> Vec32:
    """First features of a vertex from its world lattice index: the same whenever and in whatever order it is made."""
    state = wp.rand_init(start.seed + 7919 * start.level, ((i * 73856093) ^ (j * 19349663)) ^ (k * 83492791))
    c = Vec32()
    for n in range(32):
        c[n] = start.std * wp.randn(state)
    return c + start.mean


@wp.kernel(enable_backward=False)
def fill_grid(
    layer: int,
    lattice: Lattice,
    first: wp.vec3i,
    start: Start,
    old: Level,
    old_seen: wp.array[wp.uint8],
    shift: wp.vec3i,
    features: wp.array[Vec32],
    seen: wp.array[wp.uint8],
):
    """Fill a dense grid of any extent from a layer along x on: rows of the old grid are kept, the others begin anew
    (``first``: world index of vertex 0).
    """
    i, j, k = wp.tid()
    i += layer
    row = row_of(lattice, i, j, k)
    a = i - shift[0]
    b = j - shift[1]
    c = k - shift[2]
    s = old.lattice.shape
    if a >= 0 and b >= 0 and c >= 0 and a < s[0] and b < s[1] and c < s[2]:
        old_row = row_of(old.lattice, a, b, c)
        features[row] = old.features[old_row]
        seen[row] = old_seen[old_row]
    else:
        features[row] = init_normal(start, first[0] + i, first[1] + j, first[2] + k)
        seen[row] = wp.uint8(0)


@wp.kernel(enable_backward=False)
def fill_shared(start: Start, features: wp.array[Vec32]):
    """The rows that the vertices of all blocks share that were not made."""
    row = wp.tid()
    features[row] = init_normal(start, row >> 4, (row >> 2) & 3, row & 3)


@wp.kernel(enable_backward=False)
def fill_rows(
    rows: wp.array[int],
    lattice: Lattice,
    start: Start,
    features: wp.array[Vec32],
    seen: wp.array[wp.uint8],
):
    """Rows of blocks that are listed begin anew, as those of a dense grid."""
    row = rows[wp.tid()]
    v = vertex_of(lattice, row) + lattice.first
    features[row] = init_normal(start, v[0], v[1], v[2])
    seen[row] = wp.uint8(0)


@wp.kernel(enable_backward=False)
def copy_rows(rows: wp.array[int], source: wp.array[Vec32], target: wp.array[Vec32]):
    """Copy the rows that are listed from one grid to another of the same shape."""
    row = rows[wp.tid()]
    target[row] = source[row]
