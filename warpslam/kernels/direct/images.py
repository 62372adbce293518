"""Pyramids of grey values, their gradients, and depth.

The levels of a frame lie one after the other in a row of each array, each from its first row on; level 0 is the
largest. Depth is halved by the mean of what lies within 3 % of the nearest of the four, so that nothing mixes across
outlines and holes of one pixel close.
"""

import warp as wp

MODULE = "warpslam.direct"
wp.get_module(MODULE).options.update({"enable_backward": False, "max_unroll": 1, "block_dim": 32})

NEAR = wp.constant(1.03)
"""Depths up to this multiple of the nearest belong to the same surface."""


@wp.struct
class Level:
    """A level of the pyramid, and the grid of its points."""

    first: int
    """Of its pixels in a row of the arrays."""
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    first_point: int
    """Of its points in a row of the arrays."""
    block: int
    """Edge of the square in which one point is chosen [px]."""
    columns: int
    """Squares in a row."""
    points: int
    """Squares in all."""
    radius: int
    """Distance over which depth is differenced for a normal [px]."""
    gate: float
    """Depths that differ by more are no pair [m]."""


@wp.struct
class Images:
    """Pyramids, a row each."""

    grey: wp.array2d[float]
    """0 to 255."""
    shades: wp.array2d[wp.vec3]
    """Grey value and its derivatives along a row and a column [1/px]."""
    depth: wp.array2d[float]
    """[m], 0 where nothing was measured."""


@wp.kernel(module=MODULE, enable_backward=False)
def largest_level(
    rgb: wp.array3d[wp.uint8],
    units: wp.array2d[wp.uint16],
    scale: wp.array[float],
    edge: int,
    levels: wp.array[Level],
    row: int,
    start: int,
    images: Images,
):
    """Level 0 from the images as they came: the mean grey value of ``edge`` x ``edge`` pixels, and their depth."""
    i = start + wp.tid()
    level = levels[0]
    v = i // level.width
    u = i - v * level.width
    sum = float(0.0)
    nearest = int(65536)
    for b in range(v * edge, v * edge + edge):
        for a in range(u * edge, u * edge + edge):
            sum += 0.299 * float(rgb[b, a, 0]) + 0.587 * float(rgb[b, a, 1]) + 0.114 * float(rgb[b, a, 2])
            d = int(units[b, a])
            if d > 0:
                nearest = wp.min(nearest, d)
    images.grey[row, level.first + i] = sum / float(edge * edge)
    depth = float(0.0)
    if nearest < 65536:
        limit = NEAR * float(nearest)
        count = float(0.0)
        for b in range(v * edge, v * edge + edge):
            for a in range(u * edge, u * edge + edge):
                z = float(units[b, a])
                if z > 0.0 and z < limit:
                    depth += z
                    count += 1.0
        depth = depth / count * scale[0]
    images.depth[row, level.first + i] = depth


@wp.kernel(module=MODULE, enable_backward=False)
def halve(n: int, levels: wp.array[Level], row: int, images: Images):
    """Level ``n`` from the one below it."""
    i = wp.tid()
    level = levels[n]
    below = levels[n - 1]
    v = i // level.width
    u = i - v * level.width
    j = below.first + 2 * v * below.width + 2 * u
    sum = float(0.0)
    nearest = float(1.0e9)
    for b in range(2):
        for a in range(2):
            at = j + b * below.width + a
            sum += images.grey[row, at]
            d = images.depth[row, at]
            if d > 0.0:
                nearest = wp.min(nearest, d)
    images.grey[row, level.first + i] = 0.25 * sum
    depth = float(0.0)
    if nearest < 1.0e9:
        count = float(0.0)
        for b in range(2):
            for a in range(2):
                d = images.depth[row, j + b * below.width + a]
                if d > 0.0 and d < NEAR * nearest:
                    depth += d
                    count += 1.0
        depth = depth / count
    images.depth[row, level.first + i] = depth


@wp.kernel(module=MODULE, enable_backward=False)
def differentiate(levels: wp.array[Level], row: int, start: int, images: Images):
    """Shades of every pixel of every level; those at the border have no derivative."""
    i = start + wp.tid()
    n = int(0)
    while n + 1 < levels.shape[0] and i >= levels[n + 1].first:
        n += 1
    level = levels[n]
    v = (i - level.first) // level.width
    u = i - level.first - v * level.width
    gx = float(0.0)
    gy = float(0.0)
    if u > 0 and v > 0 and u < level.width - 1 and v < level.height - 1:
        gx = 0.5 * (images.grey[row, i + 1] - images.grey[row, i - 1])
        gy = 0.5 * (images.grey[row, i + level.width] - images.grey[row, i - level.width])
    images.shades[row, i] = wp.vec3(images.grey[row, i], gx, gy)
