"""Images as a camera would have taken them that takes all pixels at once, at the middle row of the colour image.

Depth was taken tau after colour, and row r of h of either is read s = ((r / h) - 1/2) t_r after its middle row. With
the camera's twist u = (u_v, u_w), a point X in the axes of the colour camera at its middle row is seen

    in colour at   X - s (u_v + u_w x X)
    in depth  at   Y = X_d - s (u_v + u_w x X_d),   X_d = V^-1 X,   V = exp(tau u)

with s of the row that X, or X_d, falls into. What depth holds at Y gives X back, X = V (Y + s (u_v + u_w x Y)), with s
of Y's row. So each pixel of the new image looks for the depth z that comes back as z, starting from what lies there if
only rotation counts. A pixel whose z does not settle is hidden, or at an outline, and has no depth.

Shapes: colour (H, W, 3), depth (H, W) in units of ``scale`` (1,) metres.
"""

import warp as wp

from warpslam.kernels.frustum import MODULE
from warpslam.kernels.pixels import Camera

ITERATIONS = wp.constant(3)
HEADROOM = wp.constant(1.25)
"""The new image's unit of depth in units of the old: what was farthest may be farther now."""
MIN_DEPTH = wp.constant(0.05)


@wp.struct
class Sweep:
    """How the camera moved while it took the images."""

    to_depth: wp.mat44
    """From the axes of the colour camera to those of the depth camera, each at its middle row, V^-1."""
    from_depth: wp.mat44
    """V."""
    velocity: wp.vec3
    """t_r u_v [m]."""
    spin: wp.vec3
    """t_r u_w [rad]."""


@wp.func
def shift(p: wp.vec3, sweep: Sweep) -> wp.vec3:
    """Apparent motion of a point from the first row to the last, t_r (u_v + u_w x p)."""
    return sweep.velocity + wp.cross(sweep.spin, p)


@wp.func
def project(p: wp.vec3, camera: Camera) -> wp.vec2:
    return wp.vec2(camera.focal[0] * p[0] / p[2] + camera.center[0], camera.focal[1] * p[1] / p[2] + camera.center[1])


@wp.func
def ray_of(q: wp.vec2, camera: Camera) -> wp.vec3:
    return wp.vec3((q[0] - camera.center[0]) / camera.focal[0], (q[1] - camera.center[1]) / camera.focal[1], 1.0)


@wp.func
def lateness(row: float, height: int) -> float:
    """s / t_r of a row."""
    return row / float(height) - 0.5


@wp.func
def depth_at(depth: wp.array2d[wp.uint16], scale: float, q: wp.vec2) -> float:
    """Depth [m] between four pixels of one surface, 1 / z being linear on a plane; else that of the nearest pixel; 0
    where nothing was measured.
    """
    height = depth.shape[0]
    width = depth.shape[1]
    if not (q[0] > -0.5 and q[1] > -0.5 and q[0] < float(width) - 0.5 and q[1] < float(height) - 0.5):
        return 0.0
    u = wp.clamp(int(wp.floor(q[0])), 0, width - 2)
    v = wp.clamp(int(wp.floor(q[1])), 0, height - 2)
    a = float(depth[v, u]) * scale
    b = float(depth[v, u + 1]) * scale
    c = float(depth[v + 1, u]) * scale
    d = float(depth[v + 1, u + 1]) * scale
    near = wp.min(wp.min(a, b), wp.min(c, d))
    far = wp.max(wp.max(a, b), wp.max(c, d))
    if near > 0.0 and far - near < 0.02 * near + 0.005:
        x = wp.clamp(q[0] - float(u), 0.0, 1.0)
        y = wp.clamp(q[1] - float(v), 0.0, 1.0)
        return 1.0 / ((1.0 - y) * ((1.0 - x) / a + x / b) + y * ((1.0 - x) / c + x / d))
    u = wp.clamp(int(wp.rint(q[0])), 0, width - 1)
    v = wp.clamp(int(wp.rint(q[1])), 0, height - 1)
    return float(depth[v, u]) * scale


@wp.func
def find_depth(
    ray: wp.vec3, pixel: wp.vec2, depth: wp.array2d[wp.uint16], scale: float, camera: Camera, sweep: Sweep
) -> float:
    """Depth [m] that a pixel of the new image has, 0 if none."""
    height = depth.shape[0]
    far = wp.transform_vector(sweep.to_depth, ray)
    if far[2] < MIN_DEPTH:
        return 0.0
    far = far - lateness(project(far, camera)[1], height) * wp.cross(sweep.spin, far)
    if far[2] < MIN_DEPTH:
        return 0.0
    z = depth_at(depth, scale, project(far, camera))
    if z <= 0.0:
        z = depth_at(depth, scale, pixel)
    step = float(0.0)
    for _ in range(ITERATIONS):
        if z < MIN_DEPTH:
            return 0.0
        p = wp.transform_point(sweep.to_depth, z * ray)
        if p[2] < MIN_DEPTH:
            return 0.0
        p = p - lateness(project(p, camera)[1], height) * shift(p, sweep)
        if p[2] < MIN_DEPTH:
            return 0.0
        q = project(p, camera)
        measured = depth_at(depth, scale, q)
        if measured <= 0.0:
            return 0.0
        seen = ray_of(q, camera) * measured
        back = wp.transform_point(sweep.from_depth, seen + lateness(q[1], height) * shift(seen, sweep))
        step = float(wp.abs(back[2] - z))
        z = back[2]
    return wp.where(step < wp.max(0.01 * z, 0.005), z, 0.0)


@wp.func
def color_at(rgb: wp.array3d[wp.uint8], q: wp.vec2, channel: int) -> float:
    """Bilinear; the outermost pixels go on beyond the image."""
    height = rgb.shape[0]
    width = rgb.shape[1]
    x = wp.clamp(q[0], 0.0, float(width - 1))
    y = wp.clamp(q[1], 0.0, float(height - 1))
    u = wp.clamp(int(x), 0, width - 2)
    v = wp.clamp(int(y), 0, height - 2)
    x -= float(u)
    y -= float(v)
    upper = (1.0 - x) * float(rgb[v, u, channel]) + x * float(rgb[v, u + 1, channel])
    lower = (1.0 - x) * float(rgb[v + 1, u, channel]) + x * float(rgb[v + 1, u + 1, channel])
    return (1.0 - y) * upper + y * lower


@wp.kernel(module=MODULE, enable_backward=False)
def rectify(
    rgb: wp.array3d[wp.uint8],
    depth: wp.array2d[wp.uint16],
    scale: wp.array[float],
    camera: Camera,
    sweep: Sweep,
    new_rgb: wp.array3d[wp.uint8],
    new_depth: wp.array2d[wp.uint16],
    new_scale: wp.array[float],
):
    """One thread a pixel of the new image."""
    v, u = wp.tid()
    unit = scale[0] * HEADROOM
    if u == 0 and v == 0:
        new_scale[0] = unit
    pixel = wp.vec2(float(u), float(v))
    ray = ray_of(pixel, camera)
    z = find_depth(ray, pixel, depth, scale[0], camera, sweep)
    units = wp.rint(z / unit)
    new_depth[v, u] = wp.uint16(wp.where(units <= 65535.0, units, 0.0))

    late = lateness(float(v), rgb.shape[0])
    p = ray - late * wp.cross(sweep.spin, ray)
    if z > 0.0:
        # Where depth is not known, nothing tells how far a translation shifts the pixel.
        p = z * ray - late * shift(z * ray, sweep)
    if p[2] < MIN_DEPTH:
        p = ray
    q = project(p, camera)
    for channel in range(3):
        new_rgb[v, u, channel] = wp.uint8(color_at(rgb, q, channel) + 0.5)
