"""The pose graph over keyframes: what tracking and loops say of pairs of them, and the poses that fit all of it best.

An edge (i, j) says T_i_j = W_i^-1 W_j, uncertain by exp(e) on its right, e = (v, w). Edges of tracking are believed.
Those of loops are weighed by graduated non-convexity with truncated least squares (Yang et al., RA-L 2020; GTSAM): one
that the others contradict ends with weight 0, however far it would pull, and whatever the start.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from warpslam.errors import ConfigError
from warpslam.poses import adjoint, inverse, motion_between, twist_of

LOOP_FLOOR = 3e-3, 2e-3
"""Standard deviations [m], [rad] that no loop is better than: views differ much, and a camera's errors with them."""
STEP_FLOOR, STEP_DRIFT = (2e-3, 2e-3), 0.05
"""The same of neighbours, and what adds to it for a metre or radian between them. Drift is no chance: errors of
neighbours add up, so what one registration knows of itself would not let a loop of 30 m close.
"""
HELD = 1e-5
"""Standard deviation of a pose that stays where it is [m, rad]."""
LEAST_WEIGHT = 0.5
"""Of a loop that counts."""
CONFIDENCE = 0.99
"""Probability with which an edge that is right counts."""
_GTSAM_ORDER = [3, 4, 5, 0, 1, 2]


@dataclass(frozen=True, eq=False)
class Edge:
    """What is known of two keyframes."""

    T_i_j: np.ndarray
    """float64 (4, 4)."""
    covariance: np.ndarray
    """Of e, float64 (6, 6)."""

    @classmethod
    def of(cls, i: int, j: int, T_i_j: np.ndarray, covariance: np.ndarray, floor: tuple[float, float]) -> Edge:
        """With the lower number first, and ``floor`` [m], [rad] added to the covariance."""
        if i > j:  # T^-1 exp(e') where T exp(e) was: e' = -Ad(T) e
            A = adjoint(T_i_j)
            T_i_j, covariance = inverse(T_i_j), A @ covariance @ A.T
        least = np.diag([floor[0] ** 2] * 3 + [floor[1] ** 2] * 3)
        return cls(T_i_j, 0.5 * (covariance + covariance.T) + least)

    def squared_error(self, W_i: np.ndarray, W_j: np.ndarray) -> float:
        """Squared Mahalanobis distance of two poses from it."""
        e = twist_of(inverse(self.T_i_j) @ inverse(W_i) @ W_j)
        return float(e @ np.linalg.solve(self.covariance, e))


@dataclass(frozen=True)
class Solution:
    """Poses that fit the edges."""

    poses: np.ndarray
    """float64 (N, 4, 4)."""
    weights: dict[tuple[int, int], float]
    """Of each loop, in [0, 1]."""


class PoseGraph:
    """Edges between keyframes, by their numbers, the lower one first."""

    def __init__(self) -> None:
        self.tracked: dict[tuple[int, int], Edge] = {}
        self.loops: dict[tuple[int, int], Edge] = {}
        self.bridges: dict[tuple[int, int], Edge] = {}
        """Loops between parts that nothing else joins: each is believed only when another one says the same."""

    def track(self, i: int, j: int, T_i_j: np.ndarray, covariance: np.ndarray) -> None:
        """Tracking says how two keyframes lie to each other; what it said before is replaced."""
        step, turn = motion_between(np.eye(4), T_i_j)
        floor = STEP_FLOOR[0] + STEP_DRIFT * float(step), STEP_FLOOR[1] + STEP_DRIFT * float(np.radians(turn))
        self.tracked[min(i, j), max(i, j)] = Edge.of(i, j, T_i_j, covariance, floor)

    def close(self, i: int, j: int, T_i_j: np.ndarray, covariance: np.ndarray) -> None:
        """A loop does."""
        self.loops[min(i, j), max(i, j)] = Edge.of(i, j, T_i_j, covariance, LOOP_FLOOR)

    def bridge(self, i: int, j: int, T_i_j: np.ndarray, covariance: np.ndarray) -> None:
        """A loop does, alone, of keyframes of two parts."""
        self.bridges[min(i, j), max(i, j)] = Edge.of(i, j, T_i_j, covariance, LOOP_FLOOR)

    def parts(self, count: int) -> np.ndarray:
        """Part of each of ``count`` keyframes, by the number of its first one, int64 (count,)."""
        return self._parts(count, self.loops)

    def settle(self, numbers: Collection[int], poses: Callable[[int], np.ndarray]) -> None:
        """Tracking has moved keyframes and believes how they lie to all others now; ``poses``: of a number, (4, 4)."""
        for (i, j), edge in self.tracked.items():
            if i in numbers or j in numbers:
                self.tracked[i, j] = replace(edge, T_i_j=inverse(poses(i)) @ poses(j))

    def are_linked(self, i: int, j: int) -> bool:
        """Whether there is an edge."""
        pair = min(i, j), max(i, j)
        return pair in self.tracked or pair in self.loops or pair in self.bridges

    def way(self, start: int, count: int) -> np.ndarray:
        """Length of the shortest way along edges from one of ``count`` keyframes to each [m], infinite where there is
        none, float64 (count,).
        """
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import dijkstra

        edges = self.tracked | self.loops
        if not edges:
            return np.where(np.arange(count) == start, 0.0, np.inf)
        i, j = np.array(list(edges)).T
        # An edge of no length would be none.
        length = [max(float(np.linalg.norm(edge.T_i_j[:3, 3])), 1e-3) for edge in edges.values()]
        return np.asarray(dijkstra(coo_array((length, (i, j)), (count, count)).tocsr(), directed=False, indices=start))

    def solve(self, poses: Sequence[np.ndarray] | np.ndarray, fixed: int = 0) -> Solution:
        """Poses (N, 4, 4) that fit all edges best, from ``poses`` on; the first ``fixed`` stay where they are, and of
        each part of the graph without any of these the first.

        Raises:
            ConfigError: GTSAM is not installed.
        """
        gtsam = import_gtsam()
        values = gtsam.Values()
        for n, pose in enumerate(poses):
            values.insert(n, gtsam.Pose3(np.asarray(pose, np.float64)))
        weights = self._weights(gtsam, values, fixed)
        # What is left of a loop that lies would still pull, by metres over millimetres: it is left out.
        kept = {pair: edge for pair, edge in self.loops.items() if weights[pair] >= LEAST_WEIGHT}
        graph = self._factors(gtsam, values, fixed, kept)
        found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
        return Solution(np.array([found.atPose3(n).matrix() for n in range(len(poses))]), weights)

    def _weights(self, gtsam: Any, values: Any, fixed: int) -> dict[tuple[int, int], float]:
        """Of each loop."""
        if not self.loops:
            return {}
        graph = self._factors(gtsam, values, fixed, self.loops)
        believed = graph.size() - len(self.loops)
        params = gtsam.GncLMParams()
        params.setKnownInliers(list(range(believed)))
        params.setLossType(gtsam.GncLossType.TLS)
        optimizer = gtsam.GncLMOptimizer(graph, values, params)
        optimizer.setInlierCostThresholdsAtProbability(CONFIDENCE)
        optimizer.optimize()
        return dict(zip(self.loops, np.asarray(optimizer.getWeights())[believed:].tolist(), strict=True))

    def _factors(self, gtsam: Any, values: Any, fixed: int, loops: Mapping[tuple[int, int], Edge]) -> Any:
        """A graph of what is held, of what tracking says, and of some loops, in this order."""
        graph, held = gtsam.NonlinearFactorGraph(), gtsam.noiseModel.Isotropic.Sigma(6, HELD)
        for n in [*range(fixed), *self._first_of_each_part(values.size(), fixed, loops)]:
            graph.add(gtsam.PriorFactorPose3(n, values.atPose3(n), held))
        for edges in (self.tracked, loops):
            for pair, edge in edges.items():
                # Covariances are of a twist (w, v) there.
                noise = gtsam.noiseModel.Gaussian.Covariance(edge.covariance[np.ix_(_GTSAM_ORDER, _GTSAM_ORDER)])
                graph.add(gtsam.BetweenFactorPose3(*pair, gtsam.Pose3(edge.T_i_j), noise))
        return graph

    def _first_of_each_part(self, count: int, fixed: int, loops: Mapping[tuple[int, int], Edge]) -> list[int]:
        """First keyframe of each part of the graph that has none of the first ``fixed``."""
        return [n for n in np.unique(self._parts(count, loops)).tolist() if n >= fixed]

    def _parts(self, count: int, loops: Mapping[tuple[int, int], Edge]) -> np.ndarray:
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        i, j = np.array([*self.tracked, *loops], np.int64).reshape(-1, 2).T
        _, parts = connected_components(coo_array((np.ones(len(i)), (i, j)), (count, count)), directed=False)
        _, first, part = np.unique(parts, return_index=True, return_inverse=True)
        return np.asarray(first[part.reshape(-1)], np.int64)


def import_gtsam() -> Any:
    """The package that solves pose graphs.

    Raises:
        ConfigError: It is not installed.
    """
    try:
        import gtsam
    except ImportError:
        raise ConfigError(
            "loops need the package gtsam; type: pip install 'gtsam>=4.3', or set loops.enabled=false"
        ) from None
    return gtsam


def edges_to_arrays(edges: Mapping[tuple[int, int], Edge]) -> dict[str, np.ndarray]:
    """Edges as plain arrays: "pairs" int64 (n, 2), "transforms" and "covariances", float64."""
    return {
        "pairs": np.array(list(edges), np.int64).reshape(-1, 2),
        "transforms": np.array([edge.T_i_j for edge in edges.values()], np.float64).reshape(-1, 4, 4),
        "covariances": np.array([edge.covariance for edge in edges.values()], np.float64).reshape(-1, 6, 6),
    }


def edges_from_arrays(
    pairs: np.ndarray, transforms: np.ndarray, covariances: np.ndarray
) -> dict[tuple[int, int], Edge]:
    """What `edges_to_arrays` was given."""
    return {
        (i, j): Edge(T.copy(), covariance.copy())
        for (i, j), T, covariance in zip(pairs.tolist(), transforms, covariances, strict=True)
    }
