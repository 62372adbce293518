"""What of a scene counts: three named culling protocols, applied to the reconstruction and the true surface alike.

    frustum                     in the image of some frame, at any distance and also behind other surfaces (Sec. 4.1)
    frustum+occlusion           in the image of some frame, and no farther than 5 cm behind what it measured there
    frustum+occlusion+virtual   as before; or in the image of some frame, no deeper than the deepest point it measured,
                                and not hidden from virtual cameras, which stand in the space that the frames saw to be
                                free and look at what they saw from other sides; their depth is that of the true mesh

Figures of different protocols can't be compared: the first asks for surface that no camera saw, the second leaves out
whatever was invented behind a surface, the third asks for some of what was hidden. So every figure names its protocol.
Culling is by point, not by face: it does not depend on how large a mesh's triangles are.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from warpslam.camera import Intrinsics
from warpslam.errors import ConfigError, InputError, MeshError

if TYPE_CHECKING:
    import trimesh

PROTOCOLS = ("frustum", "frustum+occlusion", "frustum+occlusion+virtual")
DEFAULT_PROTOCOL = "frustum+occlusion"
SAMPLE_COUNT = 200_000
OCCLUSION_TOLERANCE = 0.05  # [m]
_SAMPLING_ROUNDS = 40
_LARGE_TRIANGLE = 0.25  # [m] from its middle to a corner
_MOST_TRIANGLES = 500_000


@dataclass(frozen=True)
class Views:
    """Depth images of one camera."""

    poses: np.ndarray
    """Camera-to-world transforms, shape (F, 4, 4); a view with an unknown (NaN) pose sees nothing."""
    intrinsics: Intrinsics
    depths: Sequence[np.ndarray]
    """Depth images (H, W) [m], F of them, 0 = missing."""


class Culling:
    """One protocol and the views it goes by.

    Args:
        protocol: One of `PROTOCOLS`.
        frames: Views of the sequence.
        virtual: Views of the virtual cameras, for the protocol that has them.

    Raises:
        ConfigError: There is no such protocol, or it needs virtual views and has none.
    """

    def __init__(self, protocol: str, frames: Views, virtual: Views | None = None) -> None:
        check_protocol(protocol)
        if protocol.endswith("virtual") and virtual is None:
            raise ConfigError(f"protocol {protocol} needs virtual views; draw some, or use {DEFAULT_PROTOCOL}")
        self.protocol = protocol
        self.frames = frames
        self._occlusion = protocol != "frustum"
        self._virtual = virtual if protocol.endswith("virtual") else None

    def keeps(self, points: np.ndarray) -> np.ndarray:
        """Which of the world points (N, 3) [m] count, bool (N,)."""
        frames, virtual = self.frames, self._virtual
        depths = frames.depths if self._occlusion else None
        kept = visible_points(points, frames.poses, frames.intrinsics, depths)
        if virtual is not None:
            rest = np.flatnonzero(~kept)
            rest = rest[visible_points(points[rest], virtual.poses, virtual.intrinsics, virtual.depths)]
            # Through a window a virtual camera sees the street: only what the frames were pointed at is asked for.
            kept[rest] = visible_points(points[rest], frames.poses, frames.intrinsics, self._deepest)
        return kept

    @cached_property
    def _deepest(self) -> list[np.ndarray]:
        """Depth of the deepest point of each frame [m], of no axis."""
        return [np.asarray(np.max(depth)) for depth in self.frames.depths]

    def may_keep(self, centers: np.ndarray, radii: np.ndarray) -> np.ndarray:
        """Which balls (N, 3), (N,) [m] may hold a point that counts, bool (N,); never wrong about one that does."""
        kept = np.zeros(len(centers), dtype=bool)
        for T_world_camera, deepest in zip(self.frames.poses, self._deepest, strict=True):
            rest = np.flatnonzero(~kept)
            farthest = float(deepest) + OCCLUSION_TOLERANCE if self._occlusion else np.inf
            kept[rest] = _ball_in_frustum(centers[rest], radii[rest], T_world_camera, self.frames.intrinsics, farthest)
        return kept


def check_protocol(protocol: str) -> None:
    """Raise `ConfigError` where there is no such protocol."""
    if protocol not in PROTOCOLS:
        raise ConfigError(f"protocol {protocol!r} is unknown; choose one of {', '.join(PROTOCOLS)}")


def visible_points(
    points: np.ndarray,
    poses: np.ndarray,
    intrinsics: Intrinsics,
    depths: Iterable[np.ndarray] | None = None,
    *,
    tolerance: float = OCCLUSION_TOLERANCE,
) -> np.ndarray:
    """Which points any of the cameras saw, bool, shape (N,).

    Args:
        points: World points [m], shape (N, 3).
        poses: Camera-to-world transforms, shape (F, 4, 4); a view with an unknown (NaN) pose is skipped.
        intrinsics: Camera of all views.
        depths: One depth image (H, W) [m] a view, 0 = missing, or one depth for all of its pixels. With it a point
            counts only where it is no more than ``tolerance`` behind the depth of its pixel; without it, wherever it
            projects into the image.
        tolerance: Accepted distance behind the depth [m]; negative: it must lie that far in front of it.

    Raises:
        InputError: A depth image has another size than those of the camera.
    """
    import warp as wp

    from warpslam.field.arrays import struct
    from warpslam.kernels.raycast import DepthViews, mark_seen_points
    from warpslam.runtime.launching import Launcher

    device = wp.get_device("cpu")
    poses = np.asarray(poses, dtype=np.float64).reshape(-1, 4, 4)
    known = np.flatnonzero(np.isfinite(poses).all(axis=(1, 2)))
    images = [np.float32(np.inf)] * len(poses) if depths is None else list(depths)
    images = [np.require(images[n], np.float32, "C") for n in known]
    for n, image in zip(known, images, strict=True):
        if image.ndim and image.shape != (intrinsics.height, intrinsics.width):
            raise InputError(f"depths[{n}] has shape {image.shape}, expected {(intrinsics.height, intrinsics.width)}")
    points, seen = np.ascontiguousarray(points, np.float64).reshape(-1, 3), np.zeros(len(points), np.uint8)

    def given(values: np.ndarray | list, dtype: type) -> wp.array:
        return wp.array(values, dtype=dtype, device=device, copy=False)

    k = intrinsics
    views = struct(
        DepthViews,
        rotation=given(np.ascontiguousarray(poses[known, :3, :3]), wp.mat33d),
        origin=given(np.ascontiguousarray(poses[known, :3, 3]), wp.vec3d),
        image=given(np.array([image.ctypes.data if image.ndim else 0 for image in images], np.uint64), wp.uint64),
        reach=given(np.array([0.0 if image.ndim else image for image in images], np.float32), wp.float32),
        focal=wp.vec2d(k.fx, k.fy),
        center=wp.vec2d(k.cx, k.cy),
        width=k.width,
        height=k.height,
    )
    inputs = [given(points, wp.vec3d), views, wp.float64(tolerance), given(seen, wp.uint8)]
    if len(points) and len(known):
        Launcher(device).spread(mark_seen_points, len(points), inputs)
    return seen.astype(bool)


def sample_surface(
    mesh: trimesh.Trimesh, count: int = SAMPLE_COUNT, seed: int = 0, *, culling: Culling | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Points drawn uniformly over the surface of ``mesh`` and the normals of their faces, float64, (count, 3) each.

    With ``culling``, over the part of the surface that counts; where that is a very small part, there are fewer points.

    Raises:
        MeshError: The mesh has no face with an area, or a vertex that is not finite, or nothing of it counts.
    """
    vertices, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces)
    corners = vertices[faces] if len(faces) else np.zeros((0, 3, 3))
    if not np.isfinite(corners).all():
        raise MeshError("the mesh has a vertex that is NaN or infinite, so its surface can't be sampled")
    if not _vectors(corners).any():
        raise MeshError(f"the mesh ({len(vertices)} vertices, {len(faces)} faces) has no surface to sample")
    rng = np.random.default_rng(seed)
    if culling is None:
        return _draw(rng, corners, count)
    corners = _near_triangles(corners, culling)
    parts: list[tuple[np.ndarray, np.ndarray]] = []
    missing = count
    for _ in range(_SAMPLING_ROUNDS if _vectors(corners).any() else 0):
        points, of_points = _draw(rng, corners, count)
        kept = culling.keeps(points)
        parts.append((points[kept][:missing], of_points[kept][:missing]))
        missing -= len(parts[-1][0])
        if missing == 0:
            break
    if missing == count:
        raise MeshError(
            f"none of the {len(faces)} faces is seen by any of the {len(culling.frames.poses)} frames under "
            f"{culling.protocol}; check that mesh and poses are in the same world frame"
        )
    found, normals_found = zip(*parts, strict=True)
    return np.concatenate(found), np.concatenate(normals_found)


def _near_triangles(corners: np.ndarray, culling: Culling) -> np.ndarray:
    """The triangles (F, 3, 3) that may hold a point that counts; large ones are split, so that little else is left."""
    while True:
        middle = corners.mean(axis=1)
        radii = np.linalg.norm(corners - middle[:, None], axis=2).max(axis=1, initial=0.0)
        near = culling.may_keep(middle, radii)
        corners, large = corners[near], radii[near] > _LARGE_TRIANGLE
        if not large.any() or len(corners) > _MOST_TRIANGLES:
            return corners
        a, b, c = corners[large].transpose(1, 0, 2)
        ab, bc, ca = 0.5 * (a + b), 0.5 * (b + c), 0.5 * (c + a)
        quarters = [np.stack(quarter, axis=1) for quarter in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        corners = np.concatenate([corners[~large], *quarters])


def _vectors(corners: np.ndarray) -> np.ndarray:
    """Normals of triangles (F, 3, 3), as long as twice their area, (F, 3)."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def _draw(rng: np.random.Generator, corners: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points on triangles (F, 3, 3), uniform over their area, and the unit normals there, (count, 3) each."""
    normals = _vectors(corners)
    doubled = np.linalg.norm(normals, axis=1)
    face = rng.choice(len(doubled), size=count, p=doubled / doubled.sum())
    # Folding the unit square's upper half onto the lower one draws uniformly over the triangle.
    u, v = rng.random((2, count, 1))
    folded = u + v > 1
    u, v = np.where(folded, 1 - u, u), np.where(folded, 1 - v, v)
    a, b, c = corners[face].transpose(1, 0, 2)
    return a + u * (b - a) + v * (c - a), normals[face] / doubled[face, None]


def _ball_in_frustum(
    centers: np.ndarray, radii: np.ndarray, T_world_camera: np.ndarray, camera: Intrinsics, farthest: float
) -> np.ndarray:
    if not np.isfinite(T_world_camera).all():
        return np.zeros(len(centers), dtype=bool)
    x, y, z = ((centers - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]).T
    inside = (z >= -radii) & (z - radii <= farthest)
    for first, last, value in (
        ((-0.5 - camera.cx) / camera.fx, (camera.width - 0.5 - camera.cx) / camera.fx, x),
        ((-0.5 - camera.cy) / camera.fy, (camera.height - 0.5 - camera.cy) / camera.fy, y),
    ):
        # The planes' normals (1, -tangent) are not of unit length.
        inside &= value - first * z >= -radii * np.hypot(1.0, first)
        inside &= last * z - value >= -radii * np.hypot(1.0, last)
    return inside
