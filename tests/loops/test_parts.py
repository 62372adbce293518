"""A camera that is switched on elsewhere in a map: mapped apart, recognised, joined; and never by one loop alone."""

from __future__ import annotations

import numpy as np
import pytest

from tests.loops.test_closer import CAMERA, ROOM, TURN
from warpslam import Slam
from warpslam.camera import FrameMotion
from warpslam.config import Config
from warpslam.frames import FrameStatus
from warpslam.loops.graph import PoseGraph
from warpslam.loops.retrieval import PlaceIndex, Words
from warpslam.poses import inverse, motion_between, motion_of

FIRST, SECOND = range(24), range(37, 72)
"""Frames of both recordings: the second one comes to where the first one was after 23 of its 35."""
SETTINGS = {"loops": {"enabled": True, "own_part_after": 4}}
MAPPED = {"mapping": {"pixels": 160, "iterations": 1, "first_iterations": 4, "every": 4}}


def pose(n: int) -> np.ndarray:
    """On a small circle, looking outwards."""
    angle = 2 * np.pi * n / TURN
    T = motion_of(np.array([0.0, 0.0, 0.0, 0.0, angle, 0.0]))
    T[:3, 3] = 0.5 * np.sin(angle), 0.05 * np.sin(2 * angle), 0.5 * np.cos(angle) - 0.5
    return T


@pytest.fixture(scope="module")
def frames() -> dict[int, tuple[np.ndarray, np.ndarray]]:
    return {n: ROOM.take(CAMERA, pose(n), FrameMotion()) for n in (*FIRST, *SECOND)}


def first_session(frames, mapping: bool, **loops) -> Slam:
    """A map of the first recording, whose camera may be anywhere then."""
    settings = {**SETTINGS, "loops": {**SETTINGS["loops"], **loops}}
    settings |= {"mapping": {**MAPPED["mapping"], "loss": "direct", "enabled": mapping}}
    slam = Slam(CAMERA, Config.from_dict(settings), "cpu")
    for n in FIRST:
        slam.step(*frames[n])
    slam.forget_pose()
    return slam


def off(slam: Slam) -> list[float]:
    """Error of each frame of the second recording that is OK [m]."""
    trajectory = slam.trajectory.after(len(FIRST))
    pairs = zip(SECOND, trajectory.poses, trajectory.status, strict=False)
    return [float(motion_between(pose(n), found)[0]) for n, found, status in pairs if status is FrameStatus.OK]


@pytest.mark.parametrize("mapping", [False, True], ids=["tracked", "mapped"])
def test_it_is_mapped_apart_and_joined(frames, tmp_path, mapping):
    """Lost at first, then far beside the map; when places are recognised all its frames lie where they were taken. In
    between it can be saved: what follows is the same to the byte.
    """
    slam = first_session(frames, mapping)
    known = [keyframe.pose.copy() for keyframe in slam.keyframes]
    results, apart = [], []
    for n in SECOND:
        if n == 62:
            slam.save(tmp_path / "map")
        results.append(slam.step(*frames[n]))
        apart.append(slam.loops.account()["apart_keyframes"])
    slam.wait()
    assert [result.status for result in results[:5]] == [FrameStatus.LOST] * 3 + [FrameStatus.OK] * 2
    assert results[5].T_world_camera[0, 3] > 5.0 and max(apart) >= 5
    account = slam.loops.account()
    assert account["joined"] == 1 and account["apart_keyframes"] == 0
    joined = next(n for n in range(len(apart) - 1, 0, -1) if apart[n - 1])
    assert SECOND[joined] >= 58, "nothing can be recognised before"
    assert len(off(slam)) == len(SECOND) - 3 and max(off(slam)) < 0.05
    for keyframe, before in zip(slam.keyframes, known, strict=False):
        assert motion_between(keyframe.pose, before)[0] < 0.02
    assert (account["remapped"] == 1) == mapping
    resumed = Slam.load(tmp_path / "map", "cpu")
    for n in SECOND[SECOND.index(62) :]:
        resumed.step(*frames[n])
    np.testing.assert_array_equal(resumed.trajectory.poses, slam.trajectory.poses)
    if mapping:
        for level, grid in slam.scene.grids.items():
            np.testing.assert_array_equal(resumed.scene.grids[level].state().features, grid.state().features, level)
        low, _ = slam.scene.bounds
        depth = frames[48][1]
        points = CAMERA.backproject(np.full(5, 80), np.arange(40, 90, 10), depth[40:90:10, 80].astype(float))
        points = points @ pose(48)[:3, :3].T + pose(48)[:3, 3]
        assert (points > low).all()
        assert np.abs(slam.scene.query_occupancy(points)).max() < 1.0


def test_without_it_a_camera_that_recognises_nothing_stays_lost(frames):
    slam = first_session(frames, False, own_part_after=0)
    assert all(slam.step(*frames[n]).status is FrameStatus.LOST for n in SECOND[:8])


def test_a_camera_that_was_only_looked_up_begins_no_part(frames, tmp_path):
    """In a map that is to stay as it is."""
    first_session(frames, False).save(tmp_path / "map")
    slam = Slam.load(tmp_path / "map", "cpu", localize_only=True)
    assert all(slam.step(*frames[n]).status is FrameStatus.LOST for n in SECOND[:8])


def test_one_loop_joins_nothing_nor_do_two_that_differ(frames):
    """Two keyframes of each part, with a lie first."""
    slam = first_session(frames, False)
    for n in SECOND[:12]:
        slam.step(*frames[n])
    loops = slam.loops
    parts = loops.graph.parts(len(slam.keyframes))
    old, new = np.flatnonzero(parts == 0), np.flatnonzero(parts > 0)
    assert len(old) > 2 and len(new) > 2
    of = [slam.keyframes[k].index for k in range(len(parts))]
    true = [pose(n) if n < len(FIRST) else pose(SECOND[n - len(FIRST)]) for n in of]

    def say(a: int, b: int, T: np.ndarray) -> bool:
        loops.graph.bridge(a, b, T, np.diag([1e-6] * 6))
        return loops._join(a, b, slam.history)

    a, b, c, d = int(old[0]), int(new[0]), int(old[1]), int(new[1])
    before = [keyframe.pose.copy() for keyframe in slam.keyframes]
    lie = inverse(true[a]) @ true[b] @ motion_of(np.array([0.5, 0, 0, 0, 0, 0]))
    assert not say(a, b, lie)
    assert not say(c, d, inverse(true[c]) @ true[d])
    for keyframe, pose_before in zip(slam.keyframes, before, strict=True):
        np.testing.assert_array_equal(keyframe.pose, pose_before)
    assert say(a, d, inverse(true[a]) @ true[d])
    assert set(loops.graph.loops) == {(c, d), (a, d)} and set(loops.graph.bridges) == {(a, b)}
    for k in new.tolist():
        step, turn = motion_between(slam.keyframes[k].pose, slam.keyframes[a].pose @ inverse(true[a]) @ true[k])
        assert step < 0.05 and turn < 1.0


def test_parts_of_a_graph():
    """By the number of their first keyframe; a bridge joins none."""
    graph, T, covariance = PoseGraph(), np.eye(4), np.eye(6)
    for i, j in ((0, 1), (2, 3), (3, 4)):
        graph.track(i, j, T, covariance)
    graph.bridge(0, 3, T, covariance)
    assert graph.parts(6).tolist() == [0, 0, 2, 2, 2, 5] and graph.are_linked(3, 0)
    graph.close(1, 4, T, covariance)
    assert graph.parts(6).tolist() == [0, 0, 0, 0, 0, 5]


def test_only_some_images_count():
    """Another part's place is found though a place of one's own shares more words."""
    rng = np.random.default_rng(0)
    shown = rng.integers(0, 256, (300, 32), np.uint8)
    index = PlaceIndex()
    for share in (0.0, 0.5, 0.0, 1.0):
        other = rng.integers(0, 256, (300, 32), np.uint8)
        count = int(300 * share)
        index.add(Words.of(np.concatenate([shown[:count], other[count:]])))
    words = Words.of(shown)
    assert index.likeliest(words, 1) == [3]
    assert index.likeliest(words, 1, among=np.array([True, True, True, False]), least=1.4) == [1]
