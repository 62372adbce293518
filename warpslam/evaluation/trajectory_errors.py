"""Trajectory errors as the TUM RGB-D benchmark defines them, and the benchmark's file format.

    ATE  e_i = | s(p_i) - q_i |      p estimate, q truth [m], s the best rigid alignment (Horn, no scale) or identity
    RPE  E_i = (Q_i^-1 Q_i+d)^-1 (P_i^-1 P_i+d)    translation |t(E_i)| [m], rotation angle(E_i) [deg]

Sturm et al., A Benchmark for the Evaluation of RGB-D SLAM Systems, IROS 2012; Horn, Closed-form solution of absolute
orientation using unit quaternions, JOSA A 1987 (solved here by SVD, after Kabsch).
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any

import numpy as np

from warpslam.errors import InputError
from warpslam.poses import rotation_angles

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Statistics:
    """Errors of single frames or frame pairs and their summary, all in one unit."""

    rmse: float
    mean: float
    median: float
    std: float
    """Population standard deviation."""
    min: float
    max: float
    errors: np.ndarray
    """float64, shape (M,), in the order of the frames that were compared."""
    skipped_count: int
    """Frames (or pairs) left out because a truth pose is unknown."""


@dataclass(frozen=True)
class AteResult(Statistics):
    """Absolute trajectory error [m]."""

    frame_indices: np.ndarray
    """Index of the frame that each of ``errors`` belongs to, int, shape (M,)."""
    T_truth_estimate: np.ndarray
    """Transform that was applied to the estimate, (4, 4); identity without alignment."""
    aligned: bool
    """Whether the trajectories were aligned first."""


@dataclass(frozen=True)
class RpeResult:
    """Relative pose error over ``delta`` frames: translation [m] and rotation [deg]."""

    translation: Statistics
    """[m]."""
    rotation: Statistics
    """[degrees]."""
    delta: int
    """Frames between the two poses of a pair."""


def align_horn(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Rigid transform (4, 4) that takes points ``source`` (N, 3) to ``target`` (N, 3) with the least squared distances.

    A proper rotation and a translation, no scale. Where the points lie on one line the rotation about it is free and
    any minimiser is returned.

    Raises:
        InputError: Shapes differ, there is no point, or a coordinate is not finite.
    """
    source, target = np.asarray(source, dtype=np.float64), np.asarray(target, dtype=np.float64)
    if source.shape != target.shape or source.ndim != 2 or source.shape[1] != 3 or len(source) == 0:
        raise InputError(f"align_horn: source {source.shape} and target {target.shape} must both be (N, 3) with N >= 1")
    if not (np.isfinite(source).all() and np.isfinite(target).all()):
        raise InputError("align_horn: a point holds NaN or infinity; leave unknown poses out")
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    U, _, Vt = np.linalg.svd((target - target_mean).T @ (source - source_mean))
    # The sign keeps det R = +1: without it, a planar or noisy set may come out mirrored.
    sign = np.array([1.0, 1.0, 1.0 if np.linalg.det(U) * np.linalg.det(Vt) > 0 else -1.0])
    T = np.eye(4)
    T[:3, :3] = (U * sign) @ Vt
    T[:3, 3] = target_mean - T[:3, :3] @ source_mean
    return T


def ate(estimate: np.ndarray, truth: np.ndarray, align: bool = True) -> AteResult:
    """Absolute trajectory error of camera positions [m].

    Args:
        estimate: Camera-to-world transforms, shape (N, 4, 4).
        truth: Ground truth of the same frames, shape (N, 4, 4). Frames whose truth holds NaN or infinity are skipped.
        align: Align rigidly (no scale) before comparing.

    Raises:
        InputError: Shapes differ, the estimate is not finite, or no frame has a known truth.
    """
    estimate, truth, known = _checked(estimate, truth)
    if not known.any():
        raise InputError(f"none of the {len(truth)} ground-truth poses is known, so there is no error to compute")
    p, q = estimate[known, :3, 3], truth[known, :3, 3]
    T = align_horn(p, q) if align else np.eye(4)
    errors = np.linalg.norm(p @ T[:3, :3].T + T[:3, 3] - q, axis=1)
    return AteResult(
        **_summary(errors),
        errors=errors,
        skipped_count=int((~known).sum()),
        frame_indices=np.flatnonzero(known),
        T_truth_estimate=T,
        aligned=align,
    )


def rpe(estimate: np.ndarray, truth: np.ndarray, delta: int = 1) -> RpeResult:
    """Relative pose error over all pairs of frames (i, i + ``delta``).

    Args:
        estimate: Camera-to-world transforms, shape (N, 4, 4).
        truth: Ground truth of the same frames, shape (N, 4, 4). Pairs with an unknown (NaN) truth pose are skipped.
        delta: Distance of the two frames of a pair, in frames.

    Raises:
        InputError: Shapes differ, the estimate is not finite, or there is no pair with known truth.
    """
    estimate, truth, known = _checked(estimate, truth)
    if delta < 1:
        raise InputError(f"rpe: delta = {delta} must be at least 1 frame")
    pair_known = known[:-delta] & known[delta:]
    if not pair_known.any():
        raise InputError(f"rpe: no two of the {len(truth)} frames, {delta} apart, have a known ground-truth pose")
    first = np.flatnonzero(pair_known)
    motion_truth = np.linalg.inv(truth[first]) @ truth[first + delta]
    motion_estimate = np.linalg.inv(estimate[first]) @ estimate[first + delta]
    error = np.linalg.inv(motion_truth) @ motion_estimate
    skipped_count = int((~pair_known).sum())
    distances = np.linalg.norm(error[:, :3, 3], axis=1)
    angles = np.degrees(rotation_angles(error[:, :3, :3]))
    return RpeResult(
        translation=Statistics(**_summary(distances), errors=distances, skipped_count=skipped_count),
        rotation=Statistics(**_summary(angles), errors=angles, skipped_count=skipped_count),
        delta=delta,
    )


def trajectory_metrics(poses: np.ndarray, truth: np.ndarray) -> dict[str, Any]:
    """ATE with and without alignment, and RPE from frame to frame, of poses (N, 4, 4) against truth (N, 4, 4).

    Raises:
        InputError: As `ate` does. Without two neighbours of known truth there is no RPE.
    """
    aligned = ate(poses, truth)
    metrics: dict[str, Any] = {
        "ate_m": {
            "aligned": _figures(aligned),
            "unaligned": _figures(ate(poses, truth, align=False)),
            "frames_without_truth": aligned.skipped_count,
        }
    }
    try:
        relative = rpe(poses, truth)
    except InputError as error:
        log.info("no relative error: %s", error)
    else:
        metrics["rpe"] = {
            "delta_frames": relative.delta,
            "translation_m": _figures(relative.translation),
            "rotation_deg": _figures(relative.rotation),
        }
    return metrics


def _checked(estimate: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Both trajectories as float64 arrays, and which truth poses are known."""
    estimate, truth = np.asarray(estimate, dtype=np.float64), np.asarray(truth, dtype=np.float64)
    if estimate.shape != truth.shape or estimate.ndim != 3 or estimate.shape[1:] != (4, 4):
        raise InputError(f"estimate {estimate.shape} and truth {truth.shape} must both have shape (N, 4, 4)")
    bad = np.flatnonzero(~np.isfinite(estimate).all(axis=(1, 2)))
    if len(bad):
        raise InputError(f"{len(bad)} estimated poses hold NaN or infinity, the first is frame {bad[0]}")
    return estimate, truth, np.isfinite(truth).all(axis=(1, 2))


def _figures(error: Statistics) -> dict[str, float]:
    return {name: getattr(error, name) for name in ("rmse", "mean", "median", "std", "min", "max")}


def _summary(errors: np.ndarray) -> dict[str, float]:
    return {
        "rmse": float(np.sqrt(np.mean(errors**2))),
        "mean": float(np.mean(errors)),
        "median": float(np.median(errors)),
        "std": float(np.std(errors)),
        "min": float(np.min(errors)),
        "max": float(np.max(errors)),
    }
