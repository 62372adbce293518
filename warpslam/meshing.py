"""From the occupancy field to a coloured triangle mesh (supplement A.4): marching cubes over what was observed.

The lattice is metric and anchored at the world origin: point (i, j, k) lies at (i, j, k) * voxel. It is visited block
by block, so memory follows the block and the mesh, not the scene. Every quantity at a lattice point depends on that
point alone and every vertex is named by its lattice edge, therefore the mesh does not depend on the size of the blocks,
and vertices of neighbouring blocks merge exactly, without a distance threshold.

How a lattice point p is judged in a view. Let it project to pixel (u, v) at z-depth Z. The inverse depth of a plane is
affine in (u, v), so four neighbouring depths of one surface give the plane a X + b Y + c Z = 1 (camera coordinates),
    a = fx dw/du,  b = fy dw/dv,  c = w(u, v) - a X/Z - b Y/Z,    w = 1 / depth, interpolated,
and the signed distance of p to it is s = (1 - Z w) / |(a, b, c)|, positive in front. At depth edges s = depth - Z with
the nearest pixel. Along z alone, a floor seen from far would lose the lattice layer below it: 10 cm of z can be 1 cm of
height. p is *observed* if s >= -behind_surface in some view, and *near* a surface if |s| <= band in some view.

A cell is meshed only if its 8 corners are observed, so the border of what was seen makes no surface. Unobserved points
hold `UNOBSERVED_LOGIT` (the paper's "zero occupancy").

Importing this module imports Warp.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import trimesh
import warp as wp
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from warp.geometry import IsoSurfaceMarchingCubes

from warpslam.camera import Intrinsics, check_transform
from warpslam.errors import InputError, MeshError
from warpslam.profiling import phase

UNOBSERVED_LOGIT = -100.0
# What an observed point farther than the band from every surface holds: free, without asking the field.
FREE_LOGIT = -1.0

_BLOCK_CELLS = 64
_QUERY_CHUNK = 131072
_NOT_SEEN = wp.constant(-1.0e30)
_NEAREST_Z = 1.0e-3
# Neighbouring depths that differ by more than this share are two surfaces, not one slanted surface.
_DEPTH_EDGE = wp.constant(0.1)
# At grazing angles the distance to a surface is far shorter than the way along z; these bound that way, behind it as a
# multiple of behind_surface and in front of it as a multiple of the band. They also spare most points the plane.
_MAX_BEHIND_ALONG_Z = 3.0
_MAX_FRONT_ALONG_Z = 5.0


class Field(Protocol):
    """What the mesher asks of a scene."""

    @property
    def bounds(self) -> tuple[Any, Any]:
        """Corners (lo (3,), hi (3,)) [m] of the region in which the field is defined."""

    def query_occupancy(self, points: np.ndarray, level: str = "fine") -> np.ndarray:
        """Occupancy logits (N,) float32 of world points (N, 3) float32 [m]; above 0 is occupied."""

    def query_color(self, points: np.ndarray) -> np.ndarray:
        """Colours (N, 3) float32 in [0, 1] of world points (N, 3) float32 [m]."""


@dataclass(frozen=True)
class ObservedView:
    """A depth image and where it was taken: the evidence for what has been seen.

    depth: z-depth [m], float32, shape (H, W). Zero, negative and non-finite pixels count as missing.
    intrinsics: Camera of exactly this image (`Intrinsics.scaled` for a downsampled one).
    T_world_camera: Camera-to-world transform, shape (4, 4), OpenCV axes.

    Raises `InputError` where the depth is no image of the camera's size or the transform is not rigid.
    """

    depth: np.ndarray
    intrinsics: Intrinsics
    T_world_camera: np.ndarray

    def __post_init__(self) -> None:
        depth = np.asarray(self.depth, dtype=np.float32)
        size = (self.intrinsics.height, self.intrinsics.width)
        if depth.shape != size or min(size) < 2:
            raise InputError(
                f"ObservedView.depth has shape {depth.shape}, the camera's image {size}, and 2 x 2 is the least; "
                "for a resized image pass intrinsics.scaled(width, height)"
            )
        valid = np.isfinite(depth) & (depth > 0)
        object.__setattr__(self, "depth", np.where(valid, depth, np.float32(0.0)))
        object.__setattr__(self, "T_world_camera", check_transform(self.T_world_camera, "ObservedView.T_world_camera"))

    def points(self) -> np.ndarray:
        """World points [m] of the pixels with depth, float64, shape (N, 3)."""
        v, u = np.nonzero(self.depth)
        z = self.depth[v, u].astype(np.float64)
        camera = self.intrinsics
        local = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=1)
        return local @ self.T_world_camera[:3, :3].T + self.T_world_camera[:3, 3]


@phase("meshing")
def extract_mesh(
    scene: Field,
    views: Sequence[ObservedView],
    *,
    voxel: float = 0.02,
    level_set: float = 0.0,
    min_component_area: float = 0.2,
    behind_surface: float = 0.1,
    band: float | None = 0.15,
    cull_back_faces: bool = True,
    block_cells: int = _BLOCK_CELLS,
    device: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> trimesh.Trimesh:
    """Mesh of the observed part of the occupancy field, with colours and vertex normals (supplement A.4).

    scene: Field to mesh, see `Field`.
    views: Depth images that say what was seen, usually the keyframes; a fraction of the resolution is enough.
    voxel: Lattice spacing [m].
    level_set: Logit of the surface; above is occupied.
    min_component_area: Connected pieces with less area [m^2] are dropped.
    behind_surface: Points up to this far behind a measured surface [m] count as observed; at least two voxels are used.
    band: The field is asked only at points this close to a measured surface [m] (at least two voxels); other observed
        points are taken as free. None asks it at every observed point, which also shows floating artefacts.
    cull_back_faces: Drop faces that no observing view sees from the front: a map is untrained a few centimetres behind
        a surface and may turn free again there, which would make a second, inner shell.
    block_cells: Cells a block has along each axis. Trades memory for overhead; the mesh does not depend on it.
    device: Warp device of the seen test; None is Warp's default.
    progress: Called with (blocks done, blocks).

    Returns a mesh in world metres whose normals point to free space; vertex colours are uint8 RGBA.
    Raises `MeshError` where there is nothing to mesh or the field is not finite, `InputError` for a bad argument.
    """
    _check_arguments(voxel, level_set, min_component_area, behind_surface, band, block_cells)
    behind = max(behind_surface, 2.0 * voxel)
    evidence = _Evidence(views, behind, np.inf if band is None else max(band, 2.0 * voxel), device)
    lo, hi = _lattice_range(scene, evidence, voxel)
    surface = _Surface(lo, hi, voxel)
    range_of_logits = np.array([np.inf, -np.inf])
    observed_count = 0
    blocks = list(_blocks(lo, hi, block_cells, evidence, voxel))
    for done, (start, shape, visible) in enumerate(blocks):
        observed, near = evidence.classify(start, shape, visible, voxel)
        observed_count += int(np.count_nonzero(observed))
        cells = _all_corners(observed)
        wanted = _touches(cells, shape) & observed & near
        if wanted.any():
            logits = np.where(observed, np.float32(FREE_LOGIT + level_set), np.float32(UNOBSERVED_LOGIT))
            points = ((np.argwhere(wanted) + start) * voxel).astype(np.float32)
            values = _query_occupancy(scene, points)
            range_of_logits = np.array([min(range_of_logits[0], values.min()), max(range_of_logits[1], values.max())])
            logits[wanted] = values
            surface.add_block(logits, cells, start, level_set)
        if progress is not None:
            progress(done + 1, len(blocks))
    if observed_count == 0:
        raise MeshError(
            f"no lattice point was observed: the views and the scene bounds {_text(scene.bounds)} do not overlap, or "
            f"voxel = {voxel} m is larger than what was seen; check the poses and the depth scale"
        )
    vertices, faces = surface.merged()
    if len(faces) == 0:
        raise MeshError(
            f"no surface: {observed_count} lattice points were observed and the logits asked for lie in "
            f"[{range_of_logits[0]:.3g}, {range_of_logits[1]:.3g}], which does not cross level_set = {level_set} "
            "between observed neighbours; map more frames, use a smaller voxel, or change level_set"
        )
    if cull_back_faces:
        facing = evidence.facing(vertices, _vertex_normals(vertices, faces))[faces].any(axis=1)
        if not facing.any():
            raise MeshError(
                f"all {len(faces)} faces were seen from behind only, so the field is inside out where it was observed; "
                "check the poses and the depth scale, or pass cull_back_faces=False to look at the faces"
            )
        vertices, faces = _keep_faces(vertices, faces, facing)
    vertices, faces = _drop_small_components(vertices, faces, min_component_area)
    colors = _query_colors(scene, vertices)
    return trimesh.Trimesh(
        vertices=vertices,
        faces=faces,
        vertex_normals=_vertex_normals(vertices, faces),
        vertex_colors=colors,
        process=False,
    )


def write_ply(mesh: trimesh.Trimesh, path: str | os.PathLike[str]) -> Path:
    """Write a binary PLY file with vertex normals and colours; an existing file is replaced only once all is written.

    Raises `MeshError` where the mesh is empty or the file can't be written.
    """
    path = Path(path)
    if len(mesh.faces) == 0:
        raise MeshError(f"{path}: the mesh has no faces, so there is nothing to write; extract a mesh first")
    data = trimesh.exchange.ply.export_ply(mesh, encoding="binary", vertex_normal=True)
    partial = path.with_name(path.name + ".partial")
    try:
        partial.write_bytes(data)
        os.replace(partial, path)
    except OSError as error:
        with contextlib.suppress(OSError):
            partial.unlink()
        raise MeshError(
            f"{path}: can't be written ({error.strerror}); check that the folder exists and is writable"
        ) from error
    return path


# ---------------------------------------------------------------------------------------------------------------------
# Seen test

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
    behind: float,
    facing: wp.array[wp.uint8],
):
    n = wp.tid()
    for view in range(centers.shape[0]):
        ray = centers[view] - points[n]
        if wp.dot(normals[n], ray) > 0.0:
            s = _signed_distance(points[n], view, T_camera_world, pinhole, image, depth, max_behind, max_front)
            if s >= -behind:
                facing[n] = wp.uint8(1)
                break


class _Evidence:
    """All views on the device, and the two questions asked of them."""

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
        # Rays at the four image corners: every pixel's ray is a convex combination of them.
        left = np.array([(-0.5 - c.cx) / c.fx for c in cameras])
        right = np.array([(c.width - 0.5 - c.cx) / c.fx for c in cameras])
        top = np.array([(-0.5 - c.cy) / c.fy for c in cameras])
        bottom = np.array([(c.height - 0.5 - c.cy) / c.fy for c in cameras])
        # Rows are half-spaces n . q >= 0 through the camera centre: the sides of the frustum and its front.
        one, zero = np.ones(len(views)), np.zeros(len(views))
        planes = [[one, zero, -left], [-one, zero, right], [zero, one, -top], [zero, -one, bottom], [zero, zero, one]]
        self.planes = np.array(planes).transpose(2, 0, 1)
        self.farthest = np.array([view.depth.max() for view in views]) + self.max_behind
        cloud = [self.centers] + [_extent(view.points()) for view in views]
        self.lo = np.concatenate(cloud).min(axis=0) - self.max_behind
        self.hi = np.concatenate(cloud).max(axis=0) + self.max_behind

        def upload(values: Any, dtype: Any) -> wp.array:
            return wp.array(values, dtype=dtype, device=self.device)

        self._views = [
            upload(self.T_camera_world.astype(np.float32), wp.mat44),
            upload(np.array([[c.fx, c.fy, c.cx, c.cy] for c in cameras], dtype=np.float32), wp.vec4),
            upload(np.array([[s, c.width, c.height] for s, c in zip(starts[:-1], cameras, strict=True)]), wp.vec3i),
            upload(np.concatenate([view.depth.ravel() for view in views]), wp.float32),
        ]

    def visible(self, lo: np.ndarray, hi: np.ndarray) -> np.ndarray:
        """Indices (M,) int32 of the views whose frustum may hold a point of the box from `lo` to `hi` [m]."""
        corners = np.array([[(lo, hi)[bit >> axis & 1][axis] for axis in range(3)] for bit in range(8)])
        q = np.einsum("vij,cj->vci", self.T_camera_world[:, :3, :3], corners) + self.T_camera_world[:, None, :3, 3]
        inside_any = (np.einsum("vpi,vci->vpc", self.planes, q) >= 0).any(axis=2).all(axis=1)
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

    def facing(self, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Whether some view observes each point (N, 3) [m] from the side its normal points to, bool (N,)."""
        facing = wp.zeros(len(points), dtype=wp.uint8, device=self.device)
        vectors = [wp.array(x, dtype=wp.vec3, device=self.device) for x in (points, normals, self.centers)]
        wp.launch(
            _facing_kernel,
            dim=len(points),
            # Half the margin: across a rounded solid, views see some of the far inside within the whole of it.
            inputs=[*vectors, *self._views, self.max_behind, self.max_front, 0.5 * self.behind],
            outputs=[facing],
            device=self.device,
        )
        return facing.numpy().astype(bool)


# ---------------------------------------------------------------------------------------------------------------------
# Lattice and blocks


def _lattice_range(scene: Field, evidence: _Evidence, voxel: float) -> tuple[np.ndarray, np.ndarray]:
    """First and last lattice index (3,) int64 inside both the scene's bounds and the reach of the views."""
    scene_lo, scene_hi = (np.asarray(corner, dtype=np.float64) for corner in scene.bounds)
    if scene_lo.shape != (3,) or scene_hi.shape != (3,) or np.isnan([scene_lo, scene_hi]).any():
        raise MeshError(f"scene.bounds = {_text(scene.bounds)} must be two points of three numbers [m]")
    lo = np.ceil(np.maximum(scene_lo, evidence.lo) / voxel).astype(np.int64)
    hi = np.floor(np.minimum(scene_hi, evidence.hi) / voxel).astype(np.int64)
    if (hi <= lo).any():
        raise MeshError(
            f"no lattice point was observed: the scene bounds {_text(scene.bounds)} hold no cell of {voxel} m within "
            f"the reach of the views {_text((evidence.lo, evidence.hi))}; check the poses and the depth scale"
        )
    return lo, hi


def _blocks(
    lo: np.ndarray, hi: np.ndarray, block_cells: int, evidence: _Evidence, voxel: float
) -> Iterator[tuple[np.ndarray, tuple[int, int, int], np.ndarray]]:
    """Blocks that some view may have observed: first index (3,), points along each axis, views. Faces are shared."""
    for i in range(int(lo[0]), int(hi[0]), block_cells):
        for j in range(int(lo[1]), int(hi[1]), block_cells):
            for k in range(int(lo[2]), int(hi[2]), block_cells):
                start = np.array([i, j, k], dtype=np.int64)
                end = np.minimum(start + block_cells, hi)
                visible = evidence.visible(start * voxel, end * voxel)
                if len(visible):
                    x, y, z = (int(n) for n in end - start + 1)
                    yield start, (x, y, z), visible


def _corner_views(points: np.ndarray) -> list[np.ndarray]:
    """Values of the 8 corners of every cell as views of the point array, in the order of the tables."""
    n = [size - 1 for size in points.shape]
    offsets = IsoSurfaceMarchingCubes.CUBE_CORNER_OFFSETS
    return [points[i : i + n[0], j : j + n[1], k : k + n[2]] for i, j, k in offsets]


def _all_corners(points: np.ndarray) -> np.ndarray:
    """Cells all of whose corners are set, bool (nx-1, ny-1, nz-1)."""
    return np.logical_and.reduce(_corner_views(points))


def _touches(cells: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Points that are a corner of a set cell, bool, of the given shape."""
    points = np.zeros(shape, dtype=bool)
    for corner in _corner_views(points):
        corner |= cells
    return points


# ---------------------------------------------------------------------------------------------------------------------
# Marching cubes


class _Surface:
    """Collects the triangles of all blocks; a vertex is named by the lattice edge it lies on."""

    def __init__(self, lo: np.ndarray, hi: np.ndarray, voxel: float) -> None:
        tables = IsoSurfaceMarchingCubes
        corners = np.array(tables.CUBE_CORNER_OFFSETS)
        pairs = np.array(tables.EDGE_TO_CORNERS)
        self.edge_start = corners[pairs[:, 0]]
        self.edge_axis = np.argmax(corners[pairs[:, 1]] - self.edge_start, axis=1)
        self.case_start = np.array(tables.CASE_TO_TRI_RANGE)
        self.case_edges = np.array(tables.TRI_LOCAL_INDICES)
        self.lo, self.voxel = lo, voxel
        extent = hi - lo + 1
        self.stride = np.array([extent[1] * extent[2], extent[2], 1], dtype=np.int64)
        self.keys: list[np.ndarray] = []
        self.positions: list[np.ndarray] = []
        self.faces: list[np.ndarray] = []
        self.cells: list[np.ndarray] = []

    def add_block(self, logits: np.ndarray, cells: np.ndarray, start: np.ndarray, level_set: float) -> None:
        """Triangles of the cells set in `cells`; `logits` holds the block's points, `start` its first lattice index."""
        code = np.zeros(cells.shape, dtype=np.uint8)
        for bit, corner in enumerate(_corner_views(logits > level_set)):
            code |= corner.astype(np.uint8) << np.uint8(bit)
        cell = np.argwhere(cells & (code != 0) & (code != 255))
        if len(cell) == 0:
            return
        case = code[tuple(cell.T)].astype(np.int64)
        count = self.case_start[case + 1] - self.case_start[case]
        owner = np.repeat(np.arange(len(cell)), count)
        nth = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
        edge = self.case_edges[self.case_start[case][owner] + nth]

        point = cell[owner] + self.edge_start[edge]
        axis = self.edge_axis[edge]
        key = ((point + start - self.lo) @ self.stride) * 3 + axis
        unique, first = np.unique(key, return_index=True)
        a, axis = point[first], axis[first]
        b = a + np.eye(3, dtype=np.int64)[axis]
        value_a, value_b = (logits[tuple(p.T)].astype(np.float64) for p in (a, b))
        # A vertex exactly on a lattice point would be shared by several edges and give triangles without area.
        t = np.clip((level_set - value_a) / (value_b - value_a), 1e-3, 1.0 - 1e-3)
        position = (a + start).astype(np.float64)
        position[np.arange(len(a)), axis] += t
        self.keys.append(unique)
        self.positions.append(position * self.voxel)
        # The tables wind triangles so that normals point to higher values; ours point to free space.
        self.faces.append(key.reshape(-1, 3)[:, ::-1])
        self.cells.append(((cell + start - self.lo) @ self.stride)[owner[::3]])

    def merged(self) -> tuple[np.ndarray, np.ndarray]:
        """Vertices (V, 3) float64 [m] and faces (F, 3) int64, both ordered along the lattice."""
        if not self.keys:
            return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
        keys, first = np.unique(np.concatenate(self.keys), return_index=True)
        order = np.argsort(np.concatenate(self.cells), kind="stable")
        faces = np.searchsorted(keys, np.concatenate(self.faces)[order])
        return np.concatenate(self.positions)[first], faces


# ---------------------------------------------------------------------------------------------------------------------
# Cleaning, normals, colours


def _keep_faces(vertices: np.ndarray, faces: np.ndarray, keep: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The mesh with only the faces where `keep` (F,) is set, and only the vertices they use."""
    used, index = np.unique(faces[keep], return_inverse=True)
    return vertices[used], index.reshape(-1, 3)


def _drop_small_components(vertices: np.ndarray, faces: np.ndarray, min_area: float) -> tuple[np.ndarray, np.ndarray]:
    """The mesh without connected pieces of less than `min_area` [m^2]; raises `MeshError` if none is left."""
    rows, columns = faces.ravel(), np.roll(faces, 1, axis=1).ravel()
    graph = coo_matrix((np.ones(len(rows), dtype=np.uint8), (rows, columns)), shape=(len(vertices),) * 2)
    label = connected_components(graph, directed=False)[1][faces[:, 0]]
    doubled = np.linalg.norm(_face_vectors(vertices, faces), axis=1)
    area = np.bincount(label, weights=0.5 * doubled)
    keep = area[label] >= min_area
    if not keep.any():
        raise MeshError(
            f"no surface is left: the largest connected piece has {area.max():.3g} m^2, less than min_component_area = "
            f"{min_area} m^2; map more frames or lower min_component_area"
        )
    return _keep_faces(vertices, faces, keep)


def _face_vectors(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Normals (F, 3) of the faces, as long as twice their area."""
    a, b, c = (vertices[faces[:, n]] for n in range(3))
    return np.cross(b - a, c - a)


def _vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals (V, 3) float64: the mean of the faces around a vertex, weighted by area."""
    vectors = np.repeat(_face_vectors(vertices, faces), 3, axis=0)
    total = np.stack([np.bincount(faces.ravel(), weights=vectors[:, n], minlength=len(vertices)) for n in range(3)], 1)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)


def _query_occupancy(scene: Field, points: np.ndarray) -> np.ndarray:
    """Logits (N,) float32 at points (N, 3); raises `MeshError` where the field is not finite."""
    parts = [points[n : n + _QUERY_CHUNK] for n in range(0, len(points), _QUERY_CHUNK)]
    logits = np.concatenate([np.asarray(scene.query_occupancy(part, level="fine"), dtype=np.float32) for part in parts])
    if logits.shape != (len(points),):
        raise MeshError(f"scene.query_occupancy returned shape {logits.shape} for {len(points)} points, expected (N,)")
    _check_finite(logits, points, "query_occupancy", "occupancy logits")
    return logits


def _query_colors(scene: Field, vertices: np.ndarray) -> np.ndarray:
    """Colours (V, 4) uint8 RGBA at the vertices; raises `MeshError` where the field is not finite."""
    points = vertices.astype(np.float32)
    parts = [points[n : n + _QUERY_CHUNK] for n in range(0, len(points), _QUERY_CHUNK)]
    colors = np.concatenate([np.asarray(scene.query_color(part), dtype=np.float32) for part in parts])
    if colors.shape != (len(points), 3):
        raise MeshError(f"scene.query_color returned shape {colors.shape} for {len(points)} points, expected (N, 3)")
    _check_finite(colors, points, "query_color", "colours")
    rgb = np.rint(np.clip(colors, 0.0, 1.0) * 255.0).astype(np.uint8)
    return np.concatenate([rgb, np.full((len(rgb), 1), 255, dtype=np.uint8)], axis=1)


def _check_finite(values: np.ndarray, points: np.ndarray, method: str, name: str) -> None:
    bad = ~np.isfinite(values.reshape(len(points), -1)).all(axis=1)
    if bad.any():
        where = points[np.argmax(bad)]
        raise MeshError(
            f"scene.{method} returned NaN or infinite {name} at {bad.sum()} of {len(points)} points, first at "
            f"{_text(where)} m: the map is damaged; mesh an earlier checkpoint or run again with lower learning rates"
        )


def _check_arguments(
    voxel: float, level_set: float, min_area: float, behind: float, band: float | None, block_cells: int
) -> None:
    for name, value, low_ok in (
        ("voxel", voxel, False),
        ("min_component_area", min_area, True),
        ("behind_surface", behind, True),
        ("band", 1.0 if band is None else band, False),
    ):
        if not np.isfinite(value) or value < 0 or (value == 0 and not low_ok):
            raise InputError(f"{name} = {value!r} must be a finite number {'of at least' if low_ok else 'above'} 0")
    if not np.isfinite(level_set):
        raise InputError(f"level_set = {level_set!r} must be finite")
    if block_cells != int(block_cells) or block_cells < 1:
        raise InputError(f"block_cells = {block_cells!r} must be a whole number of at least 1")


def _extent(points: np.ndarray) -> np.ndarray:
    return np.stack([points.min(axis=0), points.max(axis=0)])


def _text(values: Any) -> str:
    return np.array2string(np.asarray(values, dtype=np.float64), precision=3, separator=", ").replace("\n", "")
