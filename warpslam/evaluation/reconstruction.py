"""Reconstruction errors (Sec. 4.1): distances between surfaces, and depth on virtual views.

    accuracy             mean distance from a point of the reconstruction to the true surface             [m]
    completion           mean distance from a point of the true surface to the reconstruction             [m]
    accuracy ratio       share of points of the reconstruction closer than 5 cm to the true surface       [0..1]
    completion ratio     share of points of the true surface closer than 5 cm to the reconstruction       [0..1]
    F-score              2 a c / (a + c) of the two ratios                                                [0..1]
    normal consistency   mean |n . n'| of a point's normal and that of its nearest point, both ways       [0..1]
    depth L1             mean |depth of the reconstruction - true depth| seen from virtual cameras        [m]

Points are drawn uniformly over each surface, 200,000 a mesh; distances are to the nearest drawn point of the other one.
So two equal meshes are 0.5 / sqrt(points per square metre) apart, 1 cm for a room of 80 square metres. Only what counts
under a protocol (`warpslam.evaluation.culling`) is drawn, of both.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpslam.errors import InputError, MeshError
from warpslam.evaluation.culling import SAMPLE_COUNT, Culling, sample_surface
from warpslam.evaluation.trajectory_errors import align_horn

if TYPE_CHECKING:
    import trimesh

    from warpslam.evaluation.virtual_views import VirtualDepth

RATIO_DISTANCE = 0.05  # [m]


@dataclass(frozen=True)
class ReconstructionResult:
    """Distances [m] between a reconstruction and the true surface, and shares, 0..1."""

    protocol: str | None
    """What was compared, one of `warpslam.evaluation.PROTOCOLS`; None for all of both surfaces."""
    accuracy: float
    completion: float
    accuracy_ratio: float
    completion_ratio: float
    f_score: float
    normal_consistency: float
    sample_count: int
    """Points drawn on the smaller of the two samples."""
    T_truth_mesh: np.ndarray
    """Transform that was applied to the reconstruction, (4, 4); identity without alignment."""
    virtual_depth: VirtualDepth | None = None
    """Depth on virtual views; None where it was not asked for."""


def evaluate_reconstruction(
    mesh: trimesh.Trimesh,
    truth: trimesh.Trimesh,
    *,
    culling: Culling | None = None,
    sample_count: int = SAMPLE_COUNT,
    align: bool = True,
    seed: int = 0,
) -> ReconstructionResult:
    """Compare two meshes.

    Args:
        mesh: Reconstruction [m].
        truth: True surface [m].
        culling: What of both counts; None for all.
        sample_count: Points drawn a mesh.
        align: Refine the pose of the reconstruction by point-to-point ICP within 10 cm first, as the paper does.
        seed: Seed of the drawn points.

    Raises:
        MeshError: A mesh has no surface, or none that counts.
    """
    points, normals = sample_surface(mesh, sample_count, seed, culling=culling)
    truth_points, truth_normals = sample_surface(truth, sample_count, seed + 1, culling=culling)
    T = align_icp(points, truth_points) if align else np.eye(4)
    points, normals = points @ T[:3, :3].T + T[:3, 3], normals @ T[:3, :3].T
    to_truth, nearest_truth = _nearest(points, truth_points)
    to_mesh, nearest = _nearest(truth_points, points)
    share, truth_share = (float((d < RATIO_DISTANCE).mean()) for d in (to_truth, to_mesh))
    agreement = [
        np.abs((normals * truth_normals[nearest_truth]).sum(axis=1)).mean(),
        np.abs((truth_normals * normals[nearest]).sum(axis=1)).mean(),
    ]
    return ReconstructionResult(
        protocol=None if culling is None else culling.protocol,
        accuracy=float(to_truth.mean()),
        completion=float(to_mesh.mean()),
        accuracy_ratio=share,
        completion_ratio=truth_share,
        f_score=f_score(share, truth_share),
        normal_consistency=float(np.mean(agreement)),
        sample_count=min(len(points), len(truth_points)),
        T_truth_mesh=T,
    )


def reconstruction_metrics(result: ReconstructionResult) -> dict[str, Any]:
    """The figures of a reconstruction, named with their units, and the protocol they hold under."""
    metrics: dict[str, Any] = {
        "protocol": result.protocol,
        "accuracy_m": result.accuracy,
        "completion_m": result.completion,
        "accuracy_ratio_5cm": result.accuracy_ratio,
        "completion_ratio_5cm": result.completion_ratio,
        "f_score_5cm": result.f_score,
        "normal_consistency": result.normal_consistency,
        "samples": result.sample_count,
        "T_truth_mesh": result.T_truth_mesh,
    }
    depth = result.virtual_depth
    if depth is not None:
        metrics["depth_l1_m"] = depth.l1
        metrics["virtual_views"] = {
            "used": depth.view_count,
            "drawn": depth.drawn_count,
            "missed_share": depth.missed_share,
            "depth_l1_misses_as_zero_m": depth.l1_misses_as_zero,
        }
    return metrics


def accuracy(points: np.ndarray, truth_points: np.ndarray) -> float:
    """Mean distance [m] from each reconstructed point (N, 3) to the nearest true point (M, 3)."""
    return float(_nearest(points, truth_points)[0].mean())


def completion(points: np.ndarray, truth_points: np.ndarray) -> float:
    """Mean distance [m] from each true point (M, 3) to the nearest reconstructed point (N, 3)."""
    return float(_nearest(truth_points, points)[0].mean())


def completion_ratio(points: np.ndarray, truth_points: np.ndarray, distance: float = RATIO_DISTANCE) -> float:
    """Share, 0..1, of the true points (M, 3) that lie closer than ``distance`` [m] to a reconstructed point (N, 3)."""
    return float((_nearest(truth_points, points)[0] < distance).mean())


def f_score(accuracy_ratio: float, completion_ratio: float) -> float:
    """Harmonic mean of the two shares, 0..1."""
    total = accuracy_ratio + completion_ratio
    return 2.0 * accuracy_ratio * completion_ratio / total if total > 0 else 0.0


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


def load_mesh(path: str | Path) -> trimesh.Trimesh:
    """Read a triangle mesh; its shape only, textures are left out.

    Raises:
        MeshError: The file can't be read or holds no triangles.
    """
    import trimesh

    try:
        mesh = trimesh.load(str(path), force="mesh", process=False, skip_materials=True)
    except Exception as error:  # trimesh lets its parsers' own exceptions through
        raise MeshError(f"{path}: can't be read as a mesh ({error})") from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise MeshError(f"{path}: holds no triangles")
    return mesh


def _nearest(points: np.ndarray, others: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance of each of ``points`` (N, 3) to the nearest of ``others`` (M, 3), and which one that is."""
    from scipy.spatial import cKDTree

    if len(points) == 0 or len(others) == 0:
        raise InputError(f"there are no distances between {len(points)} and {len(others)} points")
    return cKDTree(others).query(points, workers=-1)
