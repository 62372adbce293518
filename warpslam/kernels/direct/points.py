"""Points of a frame that other frames are registered to: one a block, where the grey value changes most.

A point lies in the axes of the colour camera at its middle row. Depth was taken a while ``delay`` later, and row r of h
is read ((r / h) - 1/2) ``readout`` later than the middle row; with the camera's twist u = (v, w),

    X <- V (X + s (u_v + u_w x X)),   s = ((r / h) - 1/2) readout,   V = exp(delay u)
"""

import warp as wp

from warpslam.kernels.direct.images import MODULE, Images, Level

MIN_DEPTH = wp.constant(0.1)


@wp.struct
class Points:
    """Points of keyframes, a row each."""

    position: wp.array2d[wp.vec3]
    """[m]; z = 0 where a block has no point."""
    normal: wp.array2d[wp.vec3]
    """Towards the camera; 0 where there is none."""
    grey: wp.array2d[float]


@wp.struct
class Motion:
    """How the camera moved while it took an image."""

    to_depth: wp.mat44
    """From the colour camera's axes to those of the camera when it took the depth image, V^-1."""
    velocity: wp.vec3
    """Shift from the first row to the last [m]."""
    spin: wp.vec3
    """Turn from the first row to the last [rad]."""
    moves: int
    """Whether it did."""


@wp.func
def at_row(p: wp.vec3, share: float, motion: Motion) -> wp.vec3:
    """A point in the axes that the camera has at a row, ``share`` of the readout after the middle one."""
    return p - share * (motion.velocity + wp.cross(motion.spin, p))


@wp.func
def rolled(p: wp.vec3, level: Level, motion: Motion) -> wp.vec3:
    """A point in the axes that the camera has when it reads the row that the point falls into."""
    if motion.moves == 0:
        return p
    row = level.fy * p[1] / p[2] + level.cy
    return at_row(p, row / float(level.height) - 0.5, motion)


@wp.func
def bilinear(images: Images, row: int, level: Level, u: float, v: float) -> wp.vec3:
    """Grey value and derivatives between four pixels."""
    iu = int(u)
    iv = int(v)
    a = u - float(iu)
    b = v - float(iv)
    i = level.first + iv * level.width + iu
    upper = (1.0 - a) * images.shades[row, i] + a * images.shades[row, i + 1]
    i += level.width
    return (1.0 - b) * upper + b * ((1.0 - a) * images.shades[row, i] + a * images.shades[row, i + 1])


@wp.func
def inside(u: float, v: float, level: Level) -> bool:
    """Whether four pixels lie around a place, none of them at the border's outer side."""
    return u >= 1.0 and v >= 1.0 and u < float(level.width) - 2.001 and v < float(level.height) - 2.001


@wp.func
def ray_point(u: int, v: int, z: float, level: Level) -> wp.vec3:
    return wp.vec3((float(u) - level.cx) / level.fx * z, (float(v) - level.cy) / level.fy * z, z)


@wp.func
def surface_normal(images: Images, row: int, level: Level, u: int, v: int) -> wp.vec3:
    """Unit normal by differences of depth, towards the camera; 0 at outlines and where depth is missing."""
    r = level.radius
    if u < r or v < r or u >= level.width - r or v >= level.height - r:
        return wp.vec3()
    i = level.first + v * level.width + u
    z = images.depth[row, i]
    left = images.depth[row, i - r]
    right = images.depth[row, i + r]
    upper = images.depth[row, i - r * level.width]
    lower = images.depth[row, i + r * level.width]
    if wp.min(wp.min(left, right), wp.min(upper, lower)) <= 0.0:
        return wp.vec3()
    limit = 0.02 * z * float(r) + 0.01
    steps = wp.max(wp.max(wp.abs(left - z), wp.abs(right - z)), wp.max(wp.abs(upper - z), wp.abs(lower - z)))
    if steps >= limit or wp.abs(left + right - 2.0 * z) >= 0.5 * limit:
        return wp.vec3()
    if wp.abs(upper + lower - 2.0 * z) >= 0.5 * limit:
        return wp.vec3()
    across = ray_point(u + r, v, right, level) - ray_point(u - r, v, left, level)
    down = ray_point(u, v + r, lower, level) - ray_point(u, v - r, upper, level)
    n = wp.normalize(wp.cross(across, down))
    if wp.dot(n, ray_point(u, v, z, level)) > 0.0:
        n = -n
    return n


@wp.kernel(module=MODULE, enable_backward=False)
def select_points(
    levels: wp.array[Level],
    first_level: int,
    images: Images,
    row: int,
    motions: wp.array[Motion],
    max_depth: float,
    points: Points,
    keyframe: int,
):
    """One thread a block, over the blocks of level ``first_level`` and of all smaller images."""
    tid = levels[first_level].first_point + wp.tid()
    n = int(first_level)
    while n + 1 < levels.shape[0] and tid >= levels[n + 1].first_point:
        n += 1
    level = levels[n]
    square = tid - level.first_point
    by = square // level.columns
    bx = square - by * level.columns
    best = float(-1.0)
    u = int(-1)
    v = int(-1)
    for b in range(level.block):
        for a in range(level.block):
            x = bx * level.block + a
            y = by * level.block + b
            if x >= 1 and y >= 1 and x < level.width - 1 and y < level.height - 1:
                i = level.first + y * level.width + x
                z = images.depth[row, i]
                if z > MIN_DEPTH and z <= max_depth:
                    s = images.shades[row, i]
                    steepness = s[1] * s[1] + s[2] * s[2]
                    if steepness > best:
                        best = steepness
                        u = x
                        v = y
    points.position[keyframe, tid] = wp.vec3()
    if u < 0:
        return
    i = level.first + v * level.width + u
    p = ray_point(u, v, images.depth[row, i], level)
    normal = surface_normal(images, row, level, u, v)
    grey = images.grey[row, i]
    motion = motions[row]
    if motion.moves != 0:
        from_depth = wp.inverse(motion.to_depth)
        p = at_row(p, -(float(v) / float(level.height) - 0.5), motion)
        p = wp.transform_point(from_depth, p)
        normal = wp.transform_vector(from_depth, normal)
        if p[2] < MIN_DEPTH:
            return
        q = rolled(p, level, motion)
        if q[2] < MIN_DEPTH:
            return
        uq = level.fx * q[0] / q[2] + level.cx
        vq = level.fy * q[1] / q[2] + level.cy
        if not inside(uq, vq, level):
            return
        grey = bilinear(images, row, level, uq, vq)[0]
    points.position[keyframe, tid] = p
    points.normal[keyframe, tid] = normal
    points.grey[keyframe, tid] = grey
