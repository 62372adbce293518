"""What the depth images are evidence of: space that was observed, space near a surface, space only in reach.

How a point is judged in a view, and what *observed* and *near* are: `warpslam.kernels.visibility`. Behind a surface
means behind it by no more than `behind`, near it no farther than `band`.

A point is *in reach* of a view (A.4) if it lies no deeper than the view's largest depth and projects into its image,
enlarged on every side.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from warpslam.camera import Intrinsics
from warpslam.errors import InputError, MeshError
from warpslam.kernels.visibility import NEAR, Views, classify_points, find_facing, find_reached
from warpslam.runtime.environment import named_device
from warpslam.runtime.launching import Launcher
from warpslam.scene.mapped_views import ObservedView

# The reference enlarges images by 1000 px; in focal lengths of its Replica camera (600 px), as images have many sizes.
REACH_MARGIN = 1000.0 / 600.0

# At grazing angles the distance to a surface is far shorter than the way along z; these bound that way, behind it as a
# multiple of behind and in front of it as a multiple of the band. They also spare most points the plane.
_MAX_BEHIND_ALONG_Z = 3.0
_MAX_FRONT_ALONG_Z = 5.0
_CLOUD_SIZE = 200_000


class Evidence:
    """All views on the device, and the questions asked of them.

    lo, hi: Corners (3,) of a box around all that can be observed [m].
    cloud: Camera centres and measured points (N, 3) [m], thinned out.
    """

    def __init__(self, views: Sequence[ObservedView], behind: float, band: float, device: str | None) -> None:
        views = [view for view in views if view.depth.any()]
        if not views:
            raise MeshError("no view with depth to mesh from; pass the keyframes of a sequence that has been mapped")
        self.device = named_device(device)
        self._launcher = Launcher(self.device)
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

        images = np.array([[s, c.width, c.height] for s, c in zip(starts[:-1], cameras, strict=True)])
        self._views = Views()
        self._views.T_camera_world = upload(self.T_camera_world.astype(np.float32), wp.mat44)
        pinholes = np.array([[c.fx, c.fy, c.cx, c.cy] for c in cameras], dtype=np.float32)
        self._views.pinhole = upload(pinholes, wp.vec4)
        self._views.image = upload(images, wp.vec3i)
        self._views.depth = upload(np.concatenate([view.depth.ravel() for view in views]), wp.float32)
        self._views.max_behind, self._views.max_front = self.max_behind, self.max_front

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
        corner = wp.vec3i(*(int(i) - 1 for i in start))
        inputs = [corner, voxel, wp.array(visible, dtype=wp.int32, device=self.device), self._views]
        self._launcher.spread(classify_points, padded, [*inputs, self.behind, self.band, state])
        states = state.numpy()
        near = states == NEAR
        near = near[:-2] | near[1:-1] | near[2:]
        near = near[:, :-2] | near[:, 1:-1] | near[:, 2:]
        near = near[:, :, :-2] | near[:, :, 1:-1] | near[:, :, 2:]
        return states[1:-1, 1:-1, 1:-1] > 0, near

    def reached(self, start: np.ndarray, shape: tuple[int, int, int], visible: np.ndarray, voxel: float) -> np.ndarray:
        """Which points of a block are in reach of one of the views `visible`; bool, `shape`."""
        reached = wp.zeros(shape, dtype=wp.uint8, device=self.device)
        wp.launch(
            find_reached,
            dim=shape,
            inputs=[
                wp.vec3i(*(int(i) for i in start)),
                voxel,
                wp.array(visible, dtype=wp.int32, device=self.device),
                self._views,
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
        self._launcher.spread(find_facing, len(points), [*vectors, self._views, least, most, facing])
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
