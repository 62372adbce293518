"""Which blocks of a grid a depth image needs: those with a vertex of a cell that some of its rays pass.

The image is looked at in tiles. The rays of one reach as far as its largest depth, and a little behind; the part of
their pyramid between two depths lies in the box about its eight corners, and so do its cells. Boxes are short, half a
block along z, so that they do not hold much else.
"""

import warp as wp

from warpslam.kernels.frustum import MODULE
from warpslam.kernels.grid import BLOCK, Lattice
from warpslam.kernels.pixels import Camera, Images, measured

TILE = 16
"""Width and height of a tile [px]."""

MAX_PIECES = wp.constant(1 << 12)
"""Of a tile's pyramid, along z, at most."""

SLACK = wp.constant(1.0e-3)
"""Of a vertex spacing: positions of samples are rounded otherwise than those of corners."""


@wp.struct
class Reach:
    """How far rays are followed: ``behind`` the largest depth of their tile, or ``missing`` where it has none; 0: those
    are left out [m].
    """

    behind: float
    missing: float


@wp.func
def largest_depth(images: Images, slot: int, first_u: int, first_v: int) -> float:
    """Of a tile; 0 where it has none."""
    largest = float(0.0)
    for v in range(first_v, wp.min(first_v + wp.static(TILE), images.depth.shape[1])):
        for u in range(first_u, wp.min(first_u + wp.static(TILE), images.depth.shape[2])):
            largest = wp.max(largest, measured(images, slot, u, v))
    return largest


@wp.func
def ray_bounds(T_world_camera: wp.mat44, camera: Camera, first_u: int, first_v: int, axis: int) -> wp.vec2:
    """Least and largest coordinate of the directions of a tile's corners, in world axes."""
    least = float(1.0e30)
    largest = float(-1.0e30)
    for du in range(2):
        for dv in range(2):
            x = (float(first_u + wp.static(TILE) * du) - 0.5 - camera.center[0]) / camera.focal[0]
            y = (float(first_v + wp.static(TILE) * dv) - 0.5 - camera.center[1]) / camera.focal[1]
            d = T_world_camera[axis, 0] * x + T_world_camera[axis, 1] * y + T_world_camera[axis, 2]
            least = wp.min(least, d)
            largest = wp.max(largest, d)
    return wp.vec2(least, largest)


@wp.func
def block_range(lattice: Lattice, low: float, high: float, axis: int) -> wp.vec2i:
    """First and last block with vertices of the cells between two coordinates."""
    last = lattice.shape[axis] - 1
    a = (low - lattice.origin[axis]) * lattice.inverse_spacing[axis] - SLACK
    b = (high - lattice.origin[axis]) * lattice.inverse_spacing[axis] + SLACK
    i = int(wp.clamp(wp.floor(a), 0.0, float(last)))
    j = int(wp.clamp(wp.floor(b) + 1.0, 0.0, float(last)))
    return wp.vec2i((i + lattice.offset[axis]) >> 2, (j + lattice.offset[axis]) >> 2)


@wp.kernel(module=MODULE, enable_backward=False)
def want_blocks(
    start: int,
    lattice: Lattice,
    T_world_camera: wp.mat44,
    camera: Camera,
    images: Images,
    slot: int,
    reach: Reach,
    wanted: wp.array[int],
    count: wp.array[int],
):
    """Mark in ``wanted``, by their place in the table, the blocks that an image needs and that were not made; ``count``
    is not 0 if there are any. A thread a tile, in the order of rows.
    """
    tile = start + wp.tid()
    across = (images.depth.shape[2] + wp.static(TILE - 1)) // wp.static(TILE)
    u = wp.static(TILE) * (tile % across)
    v = wp.static(TILE) * (tile // across)
    depth = largest_depth(images, slot, u, v)
    if not (depth > 0.0):
        depth = reach.missing
    if not (depth > 0.0):
        return
    x = ray_bounds(T_world_camera, camera, u, v, 0)
    y = ray_bounds(T_world_camera, camera, u, v, 1)
    z = ray_bounds(T_world_camera, camera, u, v, 2)
    o = wp.vec3(T_world_camera[0, 3], T_world_camera[1, 3], T_world_camera[2, 3])
    far = depth + reach.behind
    pieces = wp.clamp(int(far * lattice.inverse_spacing[0] * wp.static(2.0 / BLOCK)) + 1, 1, MAX_PIECES)
    for n in range(pieces):
        a = far * float(n) / float(pieces)
        b = far * float(n + 1) / float(pieces)
        i = block_range(lattice, o[0] + wp.min(a * x[0], b * x[0]), o[0] + wp.max(a * x[1], b * x[1]), 0)
        j = block_range(lattice, o[1] + wp.min(a * y[0], b * y[0]), o[1] + wp.max(a * y[1], b * y[1]), 1)
        k = block_range(lattice, o[2] + wp.min(a * z[0], b * z[0]), o[2] + wp.max(a * z[1], b * z[1]), 2)
        for bi in range(i[0], i[1] + 1):
            for bj in range(j[0], j[1] + 1):
                for bk in range(k[0], k[1] + 1):
                    place = (bi * lattice.blocks[1] + bj) * lattice.blocks[2] + bk
                    if lattice.table[place] == 0 and wanted[place] == 0:
                        # Threads that come at once write the same.
                        wanted[place] = 1
                        count[0] = 1
