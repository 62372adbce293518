"""Keyframes refined together: direct registration of every overlapping pair, over all poses at once.

With T = W_j^-1 W_i and xi = Ad(T) d_i - d_j for motions W <- W exp(d), a pair adds Ad^T H Ad, H and -Ad^T H after its
gain and bias are eliminated. Sparse features that a pair has in common add rows to its H. Their points are not free:
depth was measured at each, and a keyframe takes its points along.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from warpslam.kernels.direct import registration
from warpslam.poses import adjoint, inverse, motion_of, orthonormalized, twist_of
from warpslam.tracking.direct.pyramid import records
from warpslam.tracking.direct.registrar import Registrar

MIN_OVERLAP = 0.3
"""Of a pair."""
MAX_STEP = 0.05
"""Of a pose in one iteration [m, rad]."""
FIXED = 1e12


@dataclass(frozen=True)
class Pose:
    """A keyframe of the window."""

    points: int
    """Row of its points."""
    row: int
    """Of its images."""
    T_world_camera: np.ndarray
    is_fixed: bool = False
    """Whether it stays where it is."""


@dataclass(frozen=True)
class Refined:
    """What a refinement comes to."""

    poses: list[np.ndarray]
    """Of the members, (4, 4)."""
    information: dict[tuple[int, int], np.ndarray]
    """Of each pair (i, j), i < j, that was registered: of W_i^-1 W_j exp(e), e = (v, w); float64 (6, 6)."""


@dataclass(frozen=True)
class PairRows:
    """What a pair has in common beside its images, linearised once."""

    T: np.ndarray
    """T_j_i (4, 4) where it was."""
    H: np.ndarray
    """J' W J for T <- exp(xi) T, (6, 6)."""
    g: np.ndarray
    """J' W r (6,)."""

    def at(self, T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """H and g near there."""
        return self.H, self.g + self.H @ twist_of(orthonormalized(T @ inverse(self.T)))


def refine_window(
    registrar: Registrar,
    members: Sequence[Pose],
    level: int,
    grey: float,
    depth: float,
    iterations: int,
    more: Callable[[int, int, np.ndarray], PairRows | None] | None = None,
) -> Refined:
    """Refine the poses of the members; the first, and those that are fixed, stay where they are.

    more: Rows of the points of member i in the later member j, at T_j_i (4, 4); None where there are none.
    """
    poses = [member.T_world_camera.copy() for member in members]
    information: dict[tuple[int, int], np.ndarray] = {}
    pairs = _overlapping(registrar, members)
    if not pairs:
        return Refined(poses, information)
    asked = records(registration.Pair, len(pairs))
    asked["exposure"] = (1.0, 0.0)
    asked["keyframe"], asked["row"] = zip(*((members[i].points, members[j].row) for i, j in pairs), strict=True)
    count = len(members)
    added: dict[tuple[int, int], PairRows] = {}
    for i, j in pairs:
        rows = more(i, j, inverse(poses[j]) @ poses[i]) if more is not None and i < j else None
        if rows is not None:
            added[i, j] = rows
    for _ in range(iterations):
        transforms = [inverse(poses[j]) @ poses[i] for i, j in pairs]
        asked["T"] = transforms
        sums = registrar.pairs(level, asked, grey, depth)
        A, b = np.zeros((count, 6, count, 6)), np.zeros((count, 6))
        information.clear()
        for (i, j), T, pair, found in zip(pairs, transforms, asked, sums, strict=True):
            H, g = np.asarray(found["H"], np.float64), np.asarray(found["g"], np.float64)
            H, g = np.where(np.isfinite(H), H, 0.0), np.where(np.isfinite(g), g, 0.0)
            gain, bias = (float(value) for value in pair["exposure"])
            own = H[6:, 6:] + np.diag([100.0, 1e-3])
            rest = g[6:] + np.array([100.0 * (gain - 1.0), 0.0])
            left = H[:6, 6:] @ np.linalg.inv(own)
            h, q = H[:6, :6] - left @ H[6:, :6], g[:6] - left @ rest
            step = np.linalg.solve(own, rest)
            pair["exposure"] = np.clip(gain - step[0], 0.3, 3.0), bias - step[1]
            pair["scales"] = found["scales"]
            if (i, j) in added:
                H_more, g_more = added[i, j].at(T)
                h, q = h + H_more, q + g_more
            Ad = adjoint(T)
            A[i, :, i] += Ad.T @ h @ Ad
            A[j, :, j] += h
            A[i, :, j] -= Ad.T @ h
            A[j, :, i] -= h @ Ad
            b[i] += Ad.T @ q
            b[j] -= q
            # T exp(-xi) = exp(-Ad(T) xi) T: both ways of a pair speak of its second member's axes.
            known = h if i < j else Ad.T @ h @ Ad
            information[min(i, j), max(i, j)] = information.get((min(i, j), max(i, j)), 0.0) + known
        M = A.reshape(6 * count, 6 * count)
        M[np.diag_indices_from(M)] = 1.001 * M.diagonal() + 1.0
        fixed = [n for n, member in enumerate(members) if n == 0 or member.is_fixed]
        for n in fixed:
            M[range(6 * n, 6 * n + 6), range(6 * n, 6 * n + 6)] += FIXED
        steps = -np.linalg.solve(M, b.reshape(-1)).reshape(count, 6)
        for k in (k for k in range(count) if k not in fixed):
            poses[k] = orthonormalized(poses[k] @ motion_of(np.clip(steps[k], -MAX_STEP, MAX_STEP)))
    return Refined(poses, information)


def _overlapping(registrar: Registrar, members: Sequence[Pose]) -> list[tuple[int, int]]:
    """Pairs (i, j) where j sees enough of what i has points on."""
    pairs = []
    poses = np.array([member.T_world_camera for member in members])
    for j, member in enumerate(members):
        others = [i for i in range(len(members)) if i != j]
        transforms = inverse(member.T_world_camera) @ poses[others]
        shares = registrar.overlap(member.row, [members[i].points for i in others], transforms)
        pairs += [(i, j) for i, share in zip(others, shares, strict=True) if share > MIN_OVERLAP]
    return sorted(pairs)
