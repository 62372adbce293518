"""What a depth image sees of a grid's vertices: see `RayBatch.drop_unseen` and `warpslam.mapping.depth_start`."""

import warp as wp

from warpslam.kernels.frustum import MODULE
from warpslam.kernels.grid import Lattice, Vec32, row_position
from warpslam.kernels.pixels import Camera, nearest_pixel


@wp.struct
class FeatureLine:
    """Features ``base + s * slope`` of a vertex at signed distance s, clamped to ``truncation``; none beyond ``reach``
    [m].
    """

    base: Vec32
    slope: Vec32
    truncation: float
    reach: float


@wp.func
def behind_surface(p: wp.vec3, T_camera_world: wp.mat44, camera: Camera, image: wp.array2d[float]) -> float:
    """How far a point lies behind the surface that its nearest pixel measures [m]; infinite where none does.

    The nearest pixel: a mean over an outline is the depth of nothing.
    """
    q = wp.transform_point(T_camera_world, p)
    if q[2] <= 0.0:
        return wp.inf
    pixel = nearest_pixel(q, camera)
    u = pixel[0]
    v = pixel[1]
    if u < 0 or u >= image.shape[1] or v < 0 or v >= image.shape[0]:
        return wp.inf
    measured = image[v, u]
    if measured <= 0.0:
        return wp.inf
    return q[2] - measured


@wp.kernel(module=MODULE, enable_backward=False)
def mark_seen(
    start: int,
    lattice: Lattice,
    T_camera_world: wp.mat44,
    camera: Camera,
    image: wp.array2d[float],
    reach: float,
    seen: wp.array[wp.uint8],
):
    """Vertices in view that lie in front of the measured surface or less than ``reach`` behind it."""
    row = lattice.shared + start + wp.tid()
    if behind_surface(row_position(lattice, row), T_camera_world, camera, image) <= reach:
        seen[row] = wp.uint8(1)


@wp.kernel(module=MODULE, enable_backward=False)
def start_from_depth(
    lattice: Lattice,
    T_camera_world: wp.mat44,
    camera: Camera,
    image: wp.array2d[float],
    selected: wp.array[wp.uint8],
    line: FeatureLine,
    seen: wp.array[wp.uint8],
    features: wp.array[Vec32],
):
    """Vertices seen for the first time. Once started, a vertex is the optimiser's."""
    row = lattice.shared + wp.tid()
    if selected[row] == wp.uint8(0) or seen[row] != wp.uint8(0):
        return
    distance = behind_surface(row_position(lattice, row), T_camera_world, camera, image)
    if distance > line.reach:
        return
    seen[row] = wp.uint8(1)
    features[row] = line.base + wp.clamp(distance, -line.truncation, line.truncation) * line.slope
