"""Rows of features in the joint system: where they pull, how much they count, when they are wanted."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from tests.tracking.direct.conftest import CAMERA
from tests.tracking.direct.test_tracker import errors, poses, take, track, tracker
from warpslam.camera import FrameMotion
from warpslam.kernels.direct import registration
from warpslam.poses import inverse, motion_between, motion_of
from warpslam.scene.image_pool import ImagePool
from warpslam.scene.keyframes import Keyframe
from warpslam.slam import Slam
from warpslam.slam_state import write_slam
from warpslam.tracking.direct.joint_rows import FEATURE_WEIGHT, feature_rows, is_far, pair_rows
from warpslam.tracking.direct.pyramid import records
from warpslam.tracking.direct.second import Picture, SecondWitness
from warpslam.tracking.direct.window import PairRows, Pose, refine_window

NEXT = motion_of(np.array([0.06, -0.02, 0.05, 0.02, -0.03, 0.01]))
TWIST = np.array([0.4, 0.1, -0.2, 0.3, 0.5, 0.2])


def witness(motion: FrameMotion | None = None) -> SecondWitness:
    """One keyframe at the origin."""
    pool = ImagePool(CAMERA, wp.get_device("cpu"))
    keyframe = Keyframe(0, pool.add(*take(np.eye(4), motion)), np.eye(4), motion or FrameMotion())
    return SecondWitness(CAMERA, wp.get_device("cpu"), 8.0, [keyframe], pool)


def test_rows_pull_to_where_the_camera_is():
    """From two centimetres and half a degree off, a step by the rows alone ends within millimetres of the truth."""
    off = motion_of(np.array([0.01, -0.01, 0.01, 0.004, -0.006, 0.004])) @ inverse(NEXT)
    features = witness().rows(Picture(*take(NEXT)), inverse(off), [0])
    rows = feature_rows(features, np.eye(4), off)
    H, g = np.float64(rows["H"][0]), np.float64(rows["g"][0])
    moved = motion_of(-np.linalg.solve(H, g)) @ off
    before, after = motion_between(inverse(NEXT), off), motion_between(inverse(NEXT), moved)
    assert before[0] > 0.015 and after[0] < 5e-3 and after[1] < 0.2
    found = features.at(inverse(off))
    np.testing.assert_allclose(H, FEATURE_WEIGHT * found.H, rtol=1e-5)


def test_few_features_are_no_rows():
    """Of a flat grey image, none; of one that shows something else, too few."""
    rgb, depth = take(NEXT)
    assert witness().rows(Picture(np.full_like(rgb, 128), depth), NEXT, [0]) is None
    noise = np.random.default_rng(0).integers(0, 256, rgb.shape, dtype=np.uint8)
    features = witness().rows(Picture(noise, depth), NEXT, [0])
    assert features is not None and feature_rows(features, np.eye(4), inverse(NEXT)) is None


@pytest.mark.parametrize("moving", ["frame", "keyframe"])
@pytest.mark.parametrize("known", [True, False])
def test_rows_are_of_one_time(known, moving):
    """Delay of depth and rolling shutter, told: the rows' minimum is near the truth; untold: a centimetre away."""
    still, motion = FrameMotion(), FrameMotion(tuple(TWIST), depth_offset=-0.02, readout=0.026)
    of_keyframe, of_frame = (still, motion) if moving == "frame" else (motion, still)
    second = witness(of_keyframe)
    second.keyframes[0].motion = of_keyframe if known else still
    rgb, depth = take(NEXT, of_frame)
    found = second.rows(Picture(rgb, depth, motion=of_frame if known else still), NEXT, [0]).at(NEXT)
    moved = motion_of(-np.linalg.solve(found.H, found.b)) @ inverse(NEXT)
    off = motion_between(moved, inverse(NEXT))[0]
    assert off < 4e-3 if known else off > 8e-3


def test_keyframe_whose_motion_is_corrected_is_learnt_anew():
    """Its features are those of the motion known by now."""
    motion = FrameMotion(tuple(TWIST), depth_offset=-0.02, readout=0.026)
    second = witness(motion)
    second.rows(Picture(*take(NEXT)), NEXT, [0])
    first = second._witness._keyframes[0]
    second.keyframes[0].motion = motion.with_twist(2 * TWIST)
    second.rows(Picture(*take(NEXT)), NEXT, [0])
    assert not np.array_equal(first.points, second._witness._keyframes[0].points)


class Blind:
    """A registrar whose images say nothing."""

    def overlap(self, row: int, points: list[int], transforms: np.ndarray) -> np.ndarray:
        return np.ones(len(points))

    def pairs(self, level: int, asked: np.ndarray, grey: float, depth: float) -> np.ndarray:
        return records(registration.PairSums, len(asked))


def test_features_put_keyframes_of_a_window_right():
    """Three keyframes, the last two off by a centimetre or two: by features alone they come to where they were."""
    truth = [motion_of(n * np.array([0.05, 0.01, 0.02, 0.01, -0.02, 0.0])) for n in range(3)]
    off = [np.eye(4), motion_of(0.008 * np.ones(6)), motion_of(-0.006 * np.ones(6))]
    pool = ImagePool(CAMERA, wp.get_device("cpu"))
    poses = [T @ error for T, error in zip(truth, off, strict=True)]
    keyframes = [Keyframe(n, pool.add(*take(T)), poses[n], FrameMotion()) for n, T in enumerate(truth)]
    second = SecondWitness(CAMERA, wp.get_device("cpu"), 8.0, keyframes, pool)

    def between(i: int, j: int, T: np.ndarray) -> PairRows | None:
        assert i < j
        found = second.between(i, j, T)
        return None if found is None else pair_rows(found, T)

    members = [Pose(n + 1, n, pose) for n, pose in enumerate(poses)]
    refined = refine_window(Blind(), members, 1, 2.0, 1.0, 3, between).poses
    apart = [motion_between(a, b) for a, b in zip(refined, truth, strict=True)]
    assert motion_between(poses[1], truth[1])[0] > 0.01
    assert max(step for step, _ in apart) < 4e-3 and max(turn for _, turn in apart) < 0.15


def test_keyframes_that_show_something_else_have_no_rows_in_common():
    """Noise beside a room."""
    pool = ImagePool(CAMERA, wp.get_device("cpu"))
    rgb, depth = take(np.eye(4))
    noise = np.random.default_rng(0).integers(0, 256, rgb.shape, dtype=np.uint8)
    keyframes = [Keyframe(n, pool.add(image, depth), np.eye(4), FrameMotion()) for n, image in enumerate((rgb, noise))]
    second = SecondWitness(CAMERA, wp.get_device("cpu"), 8.0, keyframes, pool)
    assert second.between(0, 1, np.eye(4)) is None


def test_features_that_see_another_place_are_not_rows():
    """Keyframes that were believed to be a step further than features say."""
    pool = ImagePool(CAMERA, wp.get_device("cpu"))
    keyframes = [Keyframe(n, pool.add(*take(np.eye(4))), np.eye(4), FrameMotion()) for n in range(2)]
    second = SecondWitness(CAMERA, wp.get_device("cpu"), 8.0, keyframes, pool)
    near, far = (motion_of(np.array([x, 0, 0, 0, 0, 0])) for x in (0.08, 0.12))
    found = [second.between(0, 1, T) for T in (near, far)]
    assert found[0] is not None and pair_rows(found[0], near) is not None
    assert found[1] is not None and pair_rows(found[1], far) is None


def test_far_is_a_centimetre_or_half_a_degree():
    """Within them a linearisation holds."""
    near, turned = motion_of([0.009, 0, 0, 0.008, 0, 0]), motion_of([0, 0, 0, 0.01, 0, 0])
    assert not is_far(np.eye(4), near) and is_far(np.eye(4), turned)
    assert is_far(np.eye(4), motion_of([0.011, 0, 0, 0, 0, 0]))


@pytest.mark.parametrize(("when", "asked"), [("always", range(5, 11)), ("doubt", [1]), ("never", [0])])
def test_features_are_asked_when_the_settings_say(monkeypatch, when, asked):
    """Each time a frame is registered; only where the speed is not known yet; never. It is found all the same."""
    slam, path, calls = tracker(feature_rows=when), [motion_of(n * 0.01 * np.ones(6)) for n in range(6)], []
    rows = SecondWitness.rows
    monkeypatch.setattr(SecondWitness, "rows", lambda self, *a: calls.append(a) or rows(self, *a))
    results = track(slam, path)
    assert errors(results, path)[:, 0].max() < 5e-3
    assert slam.direct.counts["sure"] == 4 and len(calls) in asked


def test_saved_and_loaded_it_goes_on_alike(tmp_path):
    """With rows of features in every frame the poses after loading are the same bytes."""
    frames = [take(pose) for pose in poses(9)]
    whole = tracker(feature_rows="always", window_features=True)
    expected = [whole.step(*frame) for frame in frames]
    part = tracker(feature_rows="always", window_features=True)
    for frame in frames[:5]:
        part.step(*frame)
    write_slam(tmp_path / "map", part.state())
    loaded = Slam.load(tmp_path / "map", "cpu")
    for frame, same in zip(frames[5:], expected[5:], strict=True):
        np.testing.assert_array_equal(loaded.step(*frame).T_world_camera, same.T_world_camera)
