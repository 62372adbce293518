"""What the depth images are evidence of: space that was observed, space near a surface, space only in reach.

How a point p is judged in a view. Let it project to pixel (u, v) at z-depth Z. The inverse depth of a plane is affine
in (u, v), so four neighbouring depths of one surface give the plane a X + b Y + c Z = 1 (camera coordinates),
    a = fx dw/du,  b = fy dw/dv,  c = w(u, v) - a X/Z - b Y/Z,    w = 1 / depth, interpolated,
and the signed distance of p to it is s = (1 - Z w) / |(a, b, c)|, positive in front. At depth edges s = depth - Z with
the nearest pixel. Along z alone, a floor seen from far would lose the lattice layer below it: 10 cm of z can be 1 cm of
height. p is *observed* if s >= -behind in some view, and *near* a surface if |s| <= band in some view.

p is *in reach* of a view (A.4) if it lies no deeper than the view's largest depth and projects into its image, enlarged
on every side.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from warpslam.camera import Intrinsics
from warpslam.errors import InputError, MeshError
from warpslam.scene.mapped_views import ObservedView

# The reference enlarges images by 1000 px; in focal lengths of its Replica camera (600 px), as images have many sizes.
REACH_MARGIN = 1000.0 / 600.0

_NOT_SEEN = wp.constant(-1.0e30)
_NEAREST_Z = 1.0e-3
# Neighbouring depths that differ by more than this share are two surfaces, not one slanted surface.
_DEPTH_EDGE = wp.constant(0.1)
# At grazing angles the distance to a surface is far shorter than the way along z; these bound that way, behind it as a
# multiple of behind and in front of it as a multiple of the band. They also spare most points the plane.
_MAX_BEHIND_ALONG_Z = 3.0
_MAX_FRONT_ALONG_Z = 5.0
_CLOUD_SIZE = 200_000


_OBSERVED = wp.constant(1)
_NEAR = wp.constant(2)


@wp.func
def _signed_distance(
    p: wp.vec3,
    view: int,
    T_camera_world: wp.array[wp.mat44],
    pinhole: wp.array[wp.vec4],
    image: wp.array[wp.vec3i],
    depth: wp.array[wp.float32],
    max_behind: float,
    max_front: float,
) -> float:
    """Signed distance [m] to the surface that `view` measured on the ray of `p`; _NOT_SEEN where it measured none."""
    q = wp.transform_point(T_camera_world[view], p)
    if q[2] <= _NEAREST_Z:
        return _NOT_SEEN
    x = q[0] / q[2]
    y = q[1] / q[2]
    f = pinhole[view]
    u = f[0] * x + f[2]
    v = f[1] * y + f[3]
    start = image[view][0]
    width = image[view][1]
    height = image[view][2]
    if u < -0.5 or v < -0.5 or u >= float(width) - 0.5 or v >= float(height) - 0.5:
        return _NOT_SEEN
    nearest = depth[start + int(v + 0.5) * width + int(u + 0.5)]
    distance = nearest - q[2]
    if nearest <= 0.0 or distance < -max_behind:
        return _NOT_SEEN
    if distance > max_front:
        return distance
    i = wp.min(int(wp.max(u, 0.0)), width - 2)
    j = wp.min(int(wp.max(v, 0.0)), height - 2)
    corner = start + j * width + i
    d00 = depth[corner]
    d01 = depth[corner + 1]
    d10 = depth[corner + width]
    d11 = depth[corner + width + 1]
    least = wp.min(wp.min(d00, d01), wp.min(d10, d11))
    most = wp.max(wp.max(d00, d01), wp.max(d10, d11))
    if least > 0.0 and most - least <= _DEPTH_EDGE * least:
        s = u - float(i)
        t = v - float(j)
        w00 = 1.0 / d00
        w01 = 1.0 / d01
        w10 = 1.0 / d10
        w11 = 1.0 / d11
        w = wp.lerp(wp.lerp(w00, w01, s), wp.lerp(w10, w11, s), t)
        a = f[0] * wp.lerp(w01 - w00, w11 - w10, t)
        b = f[1] * wp.lerp(w10 - w00, w11 - w01, s)
        c = w - a * x - b * y
        distance = (1.0 - q[2] * w) / wp.length(wp.vec3(a, b, c))
    return distance


@wp.kernel(enable_backward=False)
def _classify_kernel(
    first: wp.vec3i,
    voxel: float,
    visible: wp.array[wp.int32],
    T_camera_world: wp.array[wp.mat44],
    pinhole: wp.array[wp.vec4],
    image: wp.array[wp.vec3i],
    depth: wp.array[wp.float32],
    max_behind: float,
    max_front: float,
    behind: float,
    band: float,
    state: wp.array3d[wp.uint8],
):
    i, j, k = wp.tid()
    p = wp.vec3(float(first[0] + i) * voxel, float(first[1] + j) * voxel, float(first[2] + k) * voxel)
    observed = wp.bool(False)
    near = wp.bool(False)
    for n in range(visible.shape[0]):
        s = _signed_distance(p, visible[n], T_camera_world, pinhole, image, depth, max_behind, max_front)
        if s > _NOT_SEEN:
            observed = observed or s >= -behind
            near = near or wp.abs(s) <= band
        if observed and near:
            break
    if observed:
        state[i, j, k] = wp.uint8(wp.where(near, _NEAR, _OBSERVED))


@wp.kernel(enable_backward=False)
def _facing_kernel(
    points: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    centers: wp.array[wp.vec3],
    T_camera_world: wp.array[wp.mat44],
    pinhole: wp.array[wp.vec4],
    image: wp.array[wp.vec3i],
    depth: wp.array[wp.float32],
    max_behind: float,
    max_front: float,
    least: float,
    most: float,
    facing: wp.array[wp.uint8],
):
    n = wp.tid()
    for view in range(centers.shape[0]):
        ray = centers[view] - points[n]
        if wp.dot(normals[n], ray) > 0.0:
            s = _signed_distance(points[n], view, T_camera_world, pinhole, image, depth, max_behind, max_front)
            if s >= least and s < most:
                facing[n] = wp.uint8(1)
                break


@wp.kernel(enable_backward=False)
def _reach_kernel(
    first: wp.vec3i,
    voxel: float,
    visible: wp.array[wp.int32],
    T_camera_world: wp.array[wp.mat44],
    pinhole: wp.array[wp.vec4],
    image: wp.array[wp.vec3i],
    deepest: wp.array[wp.float32],
    margin: float,
    reached: wp.array3d[wp.uint8],
):
    i, j, k = wp.tid()
    p = wp.vec3(float(first[0] + i) * voxel, float(first[1] + j) * voxel, float(first[2] + k) * voxel)
    for n in range(visible.shape[0]):
        view = visible[n]
        q = wp.transform_point(T_camera_world[view], p)
        if q[2] > _NEAREST_Z and q[2] <= deepest[view]:
            f = pinhole[view]
            # Distance from the image's centre, both in focal lengths.
            u = wp.abs(q[0] / q[2] - (0.5 * float(image[view][1] - 1) - f[2]) / f[0])
            v = wp.abs(q[1] / q[2] - (0.5 * float(image[view][2] - 1) - f[3]) / f[1])
            if u <= 0.5 * float(image[view][1]) / f[0] + margin and v <= 0.5 * float(image[view][2]) / f[1] + margin:
                reached[i, j, k] = wp.uint8(1)
                break


class Evidence:
    """All views on the device, and the questions asked of them.

    lo, hi: Corners (3,) of a box around all that can be observed [m].
    cloud: Camera centres and measured points (N, 3) [m], thinned out.
    """

    def __init__(self, views: Sequence[ObservedView], behind: float, band: float, device: str | None) -> None:
        views = [view for view in views if view.depth.any()]
        if not views:
            raise MeshError("no view with depth to mesh from; pass the keyframes of a sequence that has been mapped")
        self.device = wp.get_device(device)
        self.behind, self.band = behind, band
        self.max_behind = _MAX_BEHIND_ALONG_Z * behind
        self.max_front = _MAX_FRONT_ALONG_Z * band
        starts = np.cumsum([0] + [view.depth.size for view in views])
        if starts[-1] >= 2**31:
            raise InputError(f"the views hold {starts[-1]} pixels, more than 2^31; pass downsampled depth images")
        self.T_camera_world = np.stack([np.linalg.inv(view.T_world_camera) for view in views])
        self.centers = np.stack([view.T_world_camera[:3, 3] for view in views])
        cameras = [view.intrinsics for view in views]
        self.planes = _frustum_planes(cameras, 0.0)
        self.reach_planes = _frustum_planes(cameras, REACH_MARGIN)
        self.deepest = np.array([view.depth.max() for view in views], dtype=np.float32)
        self.farthest = self.deepest + self.max_behind
        clouds = [view.points() for view in views]
        ends = np.concatenate([self.centers] + [[cloud.min(axis=0), cloud.max(axis=0)] for cloud in clouds])
        self.lo, self.hi = ends.min(axis=0) - self.max_behind, ends.max(axis=0) + self.max_behind
        stride = int(1 + starts[-1] // _CLOUD_SIZE)
        self.cloud = np.concatenate([self.centers] + [cloud[::stride] for cloud in clouds])

        def upload(values: Any, dtype: Any) -> wp.array:
            return wp.array(values, dtype=dtype, device=self.device)

        self._views = [
            upload(self.T_camera_world.astype(np.float32), wp.mat44),
            upload(np.array([[c.fx, c.fy, c.cx, c.cy] for c in cameras], dtype=np.float32), wp.vec4),
            upload(np.array([[s, c.width, c.height] for s, c in zip(starts[:-1], cameras, strict=True)]), wp.vec3i),
            upload(np.concatenate([view.depth.ravel() for view in views]), wp.float32),
        ]

    def visible(self, lo: np.ndarray, hi: np.ndarray, *, in_reach: bool = False) -> np.ndarray:
        """Indices (M,) int32 of the views whose frustum may hold a point of the box from `lo` to `hi` [m].

        in_reach: The frustum is the enlarged one.
        """
        planes = self.reach_planes if in_reach else self.planes
        corners = np.array([[(lo, hi)[bit >> axis & 1][axis] for axis in range(3)] for bit in range(8)])
        q = np.einsum("vij,cj->vci", self.T_camera_world[:, :3, :3], corners) + self.T_camera_world[:, None, :3, 3]
        inside_any = (np.einsum("vpi,vci->vpc", planes, q) >= 0).any(axis=2).all(axis=1)
        return np.flatnonzero(inside_any & (q[..., 2].min(axis=1) <= self.farthest)).astype(np.int32)

    def classify(
        self, start: np.ndarray, shape: tuple[int, int, int], visible: np.ndarray, voxel: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Which points of a block are observed, and which are near a surface or next to such a point; bool, `shape`.

        At a silhouette the pixel of a point one voxel off the surface may already show the background. Were that point
        taken as free unasked, the vertex between the two would be misplaced; hence the layer around the near points.
        """
        padded = tuple(n + 2 for n in shape)
        state = wp.zeros(padded, dtype=wp.uint8, device=self.device)
        wp.launch(
            _classify_kernel,
            dim=padded,
            inputs=[
                wp.vec3i(*(int(i) - 1 for i in start)),
                voxel,
                wp.array(visible, dtype=wp.int32, device=self.device),
                *self._views,
                self.max_behind,
                self.max_front,
                self.behind,
                self.band,
            ],
            outputs=[state],
            device=self.device,
        )
        states = state.numpy()
        near = states == _NEAR
        near = near[:-2] | near[1:-1] | near[2:]
        near = near[:, :-2] | near[:, 1:-1] | near[:, 2:]
        near = near[:, :, :-2] | near[:, :, 1:-1] | near[:, :, 2:]
        return states[1:-1, 1:-1, 1:-1] > 0, near

    def reached(self, start: np.ndarray, shape: tuple[int, int, int], visible: np.ndarray, voxel: float) -> np.ndarray:
        """Which points of a block are in reach of one of the views `visible`; bool, `shape`."""
        reached = wp.zeros(shape, dtype=wp.uint8, device=self.device)
        wp.launch(
            _reach_kernel,
            dim=shape,
            inputs=[
                wp.vec3i(*(int(i) for i in start)),
                voxel,
                wp.array(visible, dtype=wp.int32, device=self.device),
                *self._views[:3],
                wp.array(self.deepest, dtype=wp.float32, device=self.device),
                REACH_MARGIN,
            ],
            outputs=[reached],
            device=self.device,
        )
        return reached.numpy().astype(bool)

    def facing(self, points: np.ndarray, normals: np.ndarray, least: float, most: float = np.inf) -> np.ndarray:
        """Whether some view, which a point's normal points to, has it at a signed distance in [`least`, `most`) [m].

        points, normals: (N, 3). Returns bool (N,).
        """
        facing = wp.zeros(len(points), dtype=wp.uint8, device=self.device)
        vectors = [wp.array(x, dtype=wp.vec3, device=self.device) for x in (points, normals, self.centers)]
        wp.launch(
            _facing_kernel,
            dim=len(points),
            inputs=[*vectors, *self._views, self.max_behind, self.max_front, least, most],
            outputs=[facing],
            device=self.device,
        )
        return facing.numpy().astype(bool)


def _frustum_planes(cameras: list[Intrinsics], margin: float) -> np.ndarray:
    """Normals (views, 5, 3): half-spaces n . q >= 0 through the camera centre, the sides of the frustum and its front.

    margin: By how much the image is larger on each side, in focal lengths.
    """
    left = np.array([(-0.5 - c.cx) / c.fx - margin for c in cameras])
    right = np.array([(c.width - 0.5 - c.cx) / c.fx + margin for c in cameras])
    top = np.array([(-0.5 - c.cy) / c.fy - margin for c in cameras])
    bottom = np.array([(c.height - 0.5 - c.cy) / c.fy + margin for c in cameras])
    one, zero = np.ones(len(cameras)), np.zeros(len(cameras))
    planes = [[one, zero, -left], [-one, zero, right], [zero, one, -top], [zero, -one, bottom], [zero, zero, one]]
    return np.array(planes).transpose(2, 0, 1)
