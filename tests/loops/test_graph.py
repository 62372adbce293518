"""Pose graphs: a circle that closes, loops that lie, and edges either way."""

import sys

import numpy as np
import pytest

from warpslam.errors import ConfigError
from warpslam.loops.graph import PoseGraph, edges_from_arrays, edges_to_arrays
from warpslam.poses import adjoint, inverse, motion_between, motion_of

COUNT = 60
TIGHT = np.diag([2e-3**2] * 3 + [1e-3**2] * 3)


@pytest.fixture
def circle() -> tuple[np.ndarray, np.ndarray, PoseGraph]:
    """True poses of a way around a circle, those that tracking drifted to, and its edges."""
    rng = np.random.default_rng(4)
    step = motion_of(np.array([0.2, 0.0, 0.1, 0.0, 2 * np.pi / (COUNT - 1), 0.0]))
    true, drifted, graph = [np.eye(4)], [np.eye(4)], PoseGraph()
    for n in range(1, COUNT):
        true.append(true[-1] @ step)
        measured = step @ motion_of(rng.normal(0.002, 0.002, 6))
        drifted.append(drifted[-1] @ measured)
        graph.track(n - 1, n, measured, TIGHT)
    return np.array(true), np.array(drifted), graph


def furthest(poses: np.ndarray, true: np.ndarray) -> float:
    """Largest distance from the truth [m]."""
    return float(np.linalg.norm(poses[:, :3, 3] - true[:, :3, 3], axis=1).max())


def test_a_loop_takes_out_the_drift(circle):
    true, drifted, graph = circle
    before = furthest(drifted, true)
    graph.close(0, COUNT - 1, inverse(true[0]) @ true[-1], TIGHT)
    solution = graph.solve(drifted)
    assert before > 0.3
    assert furthest(solution.poses, true) < 0.35 * before
    assert motion_between(solution.poses[-1], true[-1])[0] < 0.01
    np.testing.assert_allclose(solution.poses[0], drifted[0], atol=1e-4)
    assert solution.weights == {(0, COUNT - 1): 1.0}


def test_without_a_loop_nothing_moves(circle):
    _, drifted, graph = circle
    np.testing.assert_allclose(graph.solve(drifted).poses, drifted, atol=1e-9)


def test_a_loop_that_lies_gets_no_weight(circle):
    """Beside one that is right, and alone."""
    true, drifted, graph = circle
    lie = inverse(true[10]) @ true[40]
    lie[:3, 3] += [1.5, 0.0, 1.0]
    graph.close(10, 40, lie, TIGHT)
    alone = graph.solve(drifted)
    assert alone.weights[10, 40] < 1e-3
    assert furthest(alone.poses, drifted) < 1e-3
    graph.close(0, COUNT - 1, inverse(true[0]) @ true[-1], TIGHT)
    both = graph.solve(drifted)
    assert both.weights[10, 40] < 1e-3 and both.weights[0, COUNT - 1] > 0.99
    assert motion_between(both.poses[-1], true[-1])[0] < 0.01


def test_parts_that_only_a_lie_joins_stay_apart(circle):
    """Each keeps its first pose; and a loop that is right moves the one that came later as a whole."""
    true, drifted, graph = circle
    offset = motion_of(np.array([5.0, 0.0, 0.0, 0.0, 0.3, 0.0]))
    for (i, j), edge in list(graph.tracked.items()):
        graph.track(i + COUNT, j + COUNT, edge.T_i_j, TIGHT)
    poses = np.concatenate([drifted, offset @ drifted])
    graph.close(3, COUNT + 3, np.eye(4), TIGHT)
    joined = graph.solve(poses)
    np.testing.assert_allclose(joined.poses[COUNT:], drifted, atol=1e-3)
    graph.close(3, COUNT + 3, np.eye(4), TIGHT)
    for n in (10, 20):
        graph.close(n, COUNT + n, inverse(poses[n]) @ poses[COUNT + n], TIGHT)
    apart = graph.solve(poses)
    assert apart.weights[3, COUNT + 3] < 1e-3 and apart.weights[10, COUNT + 10] > 0.99
    np.testing.assert_allclose(apart.poses, poses, atol=1e-2)


def test_edges_are_the_same_either_way(circle):
    """T_j_i and the covariance in the axes of i tell what T_i_j and that in the axes of j do."""
    true, drifted, one = circle
    other = PoseGraph()
    other.tracked = dict(one.tracked)
    T, covariance = inverse(true[0]) @ true[-1], np.diag([1e-6, 4e-6, 9e-6, 1e-6, 1e-6, 4e-6])
    one.close(0, COUNT - 1, T, covariance)
    A = adjoint(T)
    other.close(COUNT - 1, 0, inverse(T), A @ covariance @ A.T)
    a, b = one.loops[0, COUNT - 1], other.loops[0, COUNT - 1]
    np.testing.assert_allclose(a.T_i_j, b.T_i_j, atol=1e-12)
    np.testing.assert_allclose(a.covariance, b.covariance, atol=1e-9)


def test_the_same_graph_gives_the_same_bytes(circle):
    true, drifted, graph = circle
    graph.close(0, COUNT - 1, inverse(true[0]) @ true[-1], TIGHT)
    again = PoseGraph()
    again.tracked = edges_from_arrays(**edges_to_arrays(graph.tracked))
    again.loops = edges_from_arrays(**edges_to_arrays(graph.loops))
    np.testing.assert_array_equal(graph.solve(drifted).poses, again.solve(drifted).poses)


def test_fixed_keyframes_and_each_part_stay(circle):
    """Those of a map that is only looked at; and what no edge leads to."""
    true, drifted, graph = circle
    graph.close(0, COUNT - 1, inverse(true[0]) @ true[-1], TIGHT)
    poses = np.concatenate([drifted, [motion_of(np.ones(6)), motion_of(2 * np.ones(6))]])
    solution = graph.solve(poses, fixed=20)
    np.testing.assert_allclose(solution.poses[:20], poses[:20], atol=1e-3)
    np.testing.assert_allclose(solution.poses[COUNT:], poses[COUNT:], atol=1e-9)
    assert np.abs(solution.poses[30:COUNT] - poses[30:COUNT]).max() > 0.01


def test_the_way_is_the_shortest(circle):
    true, _, graph = circle
    step = float(np.linalg.norm(inverse(true[0])[:3] @ true[1][:, 3]))
    way = graph.way(0, COUNT + 1)
    assert way[30] == pytest.approx(30 * step, rel=0.05)
    assert np.isinf(way[COUNT])
    graph.close(0, COUNT - 1, inverse(true[0]) @ true[-1], TIGHT)
    assert graph.way(0, COUNT)[COUNT - 2] == pytest.approx(step, rel=0.1)


def test_what_was_settled_is_what_is_believed(circle):
    _, drifted, graph = circle
    moved = drifted.copy()
    moved[7] = moved[7] @ motion_of(0.1 * np.ones(6))
    before = graph.tracked[3, 4].T_i_j
    graph.settle({7}, lambda n: moved[n])
    np.testing.assert_allclose(graph.solve(moved).poses, moved, atol=1e-9)
    assert graph.tracked[3, 4].T_i_j is before


def test_without_gtsam_it_says_what_to_install(circle, monkeypatch):
    _, drifted, graph = circle
    monkeypatch.setitem(sys.modules, "gtsam", None)
    with pytest.raises(ConfigError, match="pip install 'gtsam>=4.3'"):
        graph.solve(drifted)
