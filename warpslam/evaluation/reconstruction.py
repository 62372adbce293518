"""Reconstruction errors as the paper measures them (Sec. 4.1): accuracy, completion, completion ratio, depth L1.

    accuracy          mean distance from a point of the reconstruction to the true surface            [m]
    completion        mean distance from a point of the true surface to the reconstruction            [m]
    completion ratio  share of points of the true surface closer than 5 cm to the reconstruction      [0..1]
    depth L1          mean |rendered - true depth|                                                    [m]

Points are drawn uniformly over each surface, 200,000 a mesh; distances are to the nearest drawn point of the other one.
So two equal meshes are 0.5 / sqrt(points per square metre) apart, 1 cm for a room of 80 square metres. Only
what the cameras saw counts: both meshes are culled with the same views first.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from warpslam.camera import Intrinsics
from warpslam.errors import InputError, MeshError
from warpslam.evaluation.trajectory import align_horn

if TYPE_CHECKING:
    import trimesh

SAMPLE_COUNT = 200_000
RATIO_DISTANCE = 0.05  # [m]
OCCLUSION_TOLERANCE = 0.05  # [m]


@dataclass(frozen=True)
class ReconstructionResult:
    """Distances [m] between a reconstruction and the true surface.

    completion_ratio: Share, 0..1, of the true surface closer than 5 cm.
    T_truth_mesh: Transform that was applied to the reconstruction, (4, 4); identity without alignment.
    """

    accuracy: float
    completion: float
    completion_ratio: float
    sample_count: int
    T_truth_mesh: np.ndarray


def evaluate_reconstruction(
    mesh: trimesh.Trimesh,
    truth: trimesh.Trimesh,
    *,
    seen_truth: trimesh.Trimesh | None = None,
    sample_count: int = SAMPLE_COUNT,
    align: bool = True,
    seed: int = 0,
) -> ReconstructionResult:
    """Compare two meshes. What the cameras can't have seen is for the caller to cull first (`cull_mesh`).

    Args:
        mesh: Reconstruction [m].
        truth: True surface [m], against which accuracy is taken.
        seen_truth: Part of the true surface that completion is asked of; None for all of it.
        sample_count: Points drawn a mesh.
        align: Refine the pose of the reconstruction by point-to-point ICP within 10 cm first, as the protocol has it.
        seed: Seed of the drawn points.

    Raises:
        MeshError: A mesh has no surface.
    """
    points = sample_surface(mesh, sample_count, seed)
    truth_points = sample_surface(truth, sample_count, seed + 1)
    T = align_icp(points, truth_points) if align else np.eye(4)
    points = points @ T[:3, :3].T + T[:3, 3]
    asked = truth_points if seen_truth is None else sample_surface(seen_truth, sample_count, seed + 2)
    to_mesh = _distances(asked, points)
    return ReconstructionResult(
        accuracy=accuracy(points, truth_points),
        completion=float(to_mesh.mean()),
        completion_ratio=float((to_mesh < RATIO_DISTANCE).mean()),
        sample_count=sample_count,
        T_truth_mesh=T,
    )


def accuracy(points: np.ndarray, truth_points: np.ndarray) -> float:
    """Mean distance [m] from each reconstructed point (N, 3) to the nearest true point (M, 3)."""
    return float(_distances(points, truth_points).mean())


def completion(points: np.ndarray, truth_points: np.ndarray) -> float:
    """Mean distance [m] from each true point (M, 3) to the nearest reconstructed point (N, 3)."""
    return float(_distances(truth_points, points).mean())


def completion_ratio(points: np.ndarray, truth_points: np.ndarray, distance: float = RATIO_DISTANCE) -> float:
    """Share, 0..1, of the true points (M, 3) that lie closer than ``distance`` [m] to a reconstructed point (N, 3)."""
    return float((_distances(truth_points, points) < distance).mean())


def depth_l1(depth: np.ndarray, truth: np.ndarray, *, all_pixels: bool = False) -> float:
    """Mean |depth - truth| [m] of two depth images (H, W), 0 = no surface.

    Args:
        depth: Rendered depth [m].
        truth: True or measured depth [m].
        all_pixels: Average over all pixels, a miss counting as depth 0 (the paper's protocol on meshes); else over the
            pixels where ``truth`` has a value. NaN then if it has none.

    Raises:
        InputError: Shapes differ.
    """
    depth, truth = np.asarray(depth, dtype=np.float64), np.asarray(truth, dtype=np.float64)
    if depth.shape != truth.shape:
        raise InputError(f"depth {depth.shape} and truth {truth.shape} must have the same shape")
    counted = np.ones(truth.shape, dtype=bool) if all_pixels else truth > 0
    return float(np.abs(depth - truth)[counted].mean()) if counted.any() else float("nan")


def sample_surface(mesh: trimesh.Trimesh, count: int = SAMPLE_COUNT, seed: int = 0) -> np.ndarray:
    """Points drawn uniformly over the surface of ``mesh``, float64, shape (count, 3).

    Raises:
        MeshError: The mesh has no face with an area, or a vertex that is not finite.
    """
    vertices, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces)
    a, b, c = (vertices[faces[:, corner]] for corner in range(3)) if len(faces) else (np.zeros((0, 3)),) * 3
    areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    if not np.isfinite(areas).all():
        raise MeshError("the mesh has a vertex that is NaN or infinite, so its surface can't be sampled")
    if areas.sum() <= 0:
        raise MeshError(f"the mesh ({len(vertices)} vertices, {len(faces)} faces) has no surface to sample")
    rng = np.random.default_rng(seed)
    face = rng.choice(len(areas), size=count, p=areas / areas.sum())
    # Folding the unit square's upper half onto the lower one draws uniformly over the triangle.
    u, v = rng.random((2, count, 1))
    folded = u + v > 1
    u, v = np.where(folded, 1 - u, u), np.where(folded, 1 - v, v)
    return a[face] + u * (b - a)[face] + v * (c - a)[face]


def align_icp(
    source: np.ndarray, target: np.ndarray, *, threshold: float = 0.1, iterations: int = 30, subset: int = 20_000
) -> np.ndarray:
    """Rigid transform (4, 4) from ``source`` (N, 3) to ``target`` (M, 3) points [m], by point-to-point ICP.

    Starts from identity. Pairs further apart than ``threshold`` [m] are ignored; the result is identity if fewer than
    10 are closer. Every (N / subset)-th source point takes part.
    """
    from scipy.spatial import cKDTree

    tree = cKDTree(target)
    moving = source[:: max(1, len(source) // subset)]
    T = np.eye(4)
    previous = np.inf
    for _ in range(iterations):
        moved = moving @ T[:3, :3].T + T[:3, 3]
        distances, nearest = tree.query(moved, distance_upper_bound=threshold)
        paired = np.isfinite(distances)
        if paired.sum() < 10:
            return np.eye(4)
        T = align_horn(moving[paired], target[nearest[paired]])
        rmse = float(np.sqrt((distances[paired] ** 2).mean()))
        if abs(previous - rmse) < 1e-6:
            break
        previous = rmse
    return T


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
        depths: One depth image (H, W) [m] a view, 0 = missing. With it a point counts only where it is no more than
            ``tolerance`` behind the depth of its pixel; without it, wherever it projects into the image.
        tolerance: Accepted distance behind the depth [m].
    """
    points = np.asarray(points, dtype=np.float64)
    seen = np.zeros(len(points), dtype=bool)
    depth_images = iter(depths) if depths is not None else None
    for T_world_camera in np.asarray(poses, dtype=np.float64):
        depth = next(depth_images) if depth_images is not None else None
        if not np.isfinite(T_world_camera).all():
            continue
        # Only points not seen so far are projected: after a few views these are a fraction.
        rest = np.flatnonzero(~seen)
        R, t = T_world_camera[:3, :3], T_world_camera[:3, 3]
        x, y, z = ((points[rest] - t) @ R).T
        in_front = z > 1e-6
        rest, x, y, z = rest[in_front], x[in_front], y[in_front], z[in_front]
        column = np.rint(intrinsics.fx * x / z + intrinsics.cx)
        row = np.rint(intrinsics.fy * y / z + intrinsics.cy)
        inside = (column >= 0) & (column < intrinsics.width) & (row >= 0) & (row < intrinsics.height)
        if depth is not None:
            surface = depth[row[inside].astype(int), column[inside].astype(int)]
            inside[inside] = (surface > 0) & (z[inside] <= surface + tolerance)
        seen[rest[inside]] = True
    return seen


def cull_mesh(
    mesh: trimesh.Trimesh,
    poses: np.ndarray,
    intrinsics: Intrinsics,
    depths: Iterable[np.ndarray] | None = None,
    *,
    tolerance: float = OCCLUSION_TOLERANCE,
    max_edge: float | None = None,
) -> trimesh.Trimesh:
    """The part of ``mesh`` that the cameras saw: faces with at least one vertex that `visible_points` marks.

    Args:
        mesh: Mesh [m] in the world frame of the poses.
        poses: As in `visible_points`.
        intrinsics: As in `visible_points`.
        depths: As in `visible_points`.
        tolerance: As in `visible_points`.
        max_edge: Split faces until no edge is longer [m], so that a large triangle is cut where the view ends; None
            leaves the faces as they are.

    Raises:
        MeshError: The cameras saw nothing of the mesh.
    """
    import trimesh

    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    if max_edge is not None and len(faces):
        vertices, faces = trimesh.remesh.subdivide_to_size(vertices, faces, max_edge=max_edge, max_iter=20)
    seen = visible_points(vertices, poses, intrinsics, depths, tolerance=tolerance)
    kept = faces[seen[faces].any(axis=1)] if len(faces) else faces
    if len(kept) == 0:
        raise MeshError(f"none of the {len(faces)} faces was seen by any of the {len(poses)} cameras")
    used, inverse = np.unique(kept, return_inverse=True)
    return trimesh.Trimesh(vertices[used], inverse.reshape(-1, 3), process=False)


def _distances(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Distance of each of ``points`` (N, 3) to the nearest of ``others`` (M, 3)."""
    from scipy.spatial import cKDTree

    if len(points) == 0 or len(others) == 0:
        raise InputError(f"there are no distances between {len(points)} and {len(others)} points")
    distances, _ = cKDTree(others).query(points, workers=-1)
    return distances
