"""Whether two keyframes show one place: what each gate lets through, and what it does not."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from tests.kernels.swept_room import SweptRoom
from warpslam import Slam
from warpslam.camera import FrameMotion, Intrinsics
from warpslam.config import Config
from warpslam.loops.verification import LEAST_SEEN, MOST_EMPTY, Gate, depth_consistency, rigid_motion
from warpslam.poses import inverse, motion_between, motion_of

CAMERA = Intrinsics(140.0, 140.0, 79.5, 59.5, 160, 120)
WIDE = Intrinsics(262.5, 262.5, 159.5, 119.5, 320, 240)
ROOM = SweptRoom(pillar=0.35, grain=25.0)
TILE = 0.3
MOVED = motion_of(np.array([0.25, 0.05, 0.1, 0.03, -0.1, 0.05]))

Images = tuple[np.ndarray, np.ndarray]


def room(pose: np.ndarray, which: SweptRoom = ROOM) -> Images:
    return which.take(CAMERA, pose, FrameMotion())


def wall(pose: np.ndarray, color: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Images:
    """A wall at z = 1.2 m, by the grey value at x and y."""
    v, u = np.mgrid[: WIDE.height, : WIDE.width].astype(float)
    rays = WIDE.backproject(u, v, 1.0) @ pose[:3, :3].T
    z = (1.2 - pose[2, 3]) / rays[..., 2]
    points = pose[:3, 3] + z[..., None] * rays
    grey = np.clip(color(points[..., 0], points[..., 1]), 0, 255).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2), z.astype(np.float32)


def tiles(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Equal ones, with joints between."""
    joint = np.minimum(*(np.abs(side - TILE * np.round(side / TILE)) for side in (x, y)))
    return np.where(joint < 0.012, 90.0, 170.0)


def pictures(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Cells of which no two are alike."""
    cell = np.floor(x / 0.06) * 12.9898 + np.floor(y / 0.06) * 78.233
    return 130.0 + 80.0 * np.sin(1e4 * np.sin(cell))


def keyframes(camera: Intrinsics, frames: list[tuple[np.ndarray, Images]]) -> Slam:
    """One for each of some poses that are given, in a row."""
    slam = Slam(camera, Config.from_dict({"mapping": {"enabled": False}, "loops": {"enabled": True}}), "cpu")
    for pose, (rgb, depth) in frames:
        slam.forget_pose()
        slam.step(rgb, depth, T_world_camera=pose)
    assert len(slam.keyframes) == len(frames)
    return slam


def test_most_points_decide_on_a_motion():
    """Two thirds of the pairs lie; what is left gives it to a few millimetres, the same each time."""
    rng = np.random.default_rng(3)
    points = WIDE.backproject(rng.uniform(0, 320, 90), rng.uniform(0, 240, 90), rng.uniform(1.0, 3.0, 90))
    seen = points @ MOVED[:3, :3].T + MOVED[:3, 3] + rng.normal(0.0, 0.004, points.shape)
    seen[:60] = points[rng.permutation(60)]
    T, inliers = rigid_motion(points, seen, WIDE)
    step, turn = motion_between(T, MOVED)
    assert step < 0.01 and turn < 0.3 and 25 <= inliers <= 32
    np.testing.assert_array_equal(rigid_motion(points, seen, WIDE)[0], T)


def test_depth_of_two_views_of_a_room_is_consistent():
    _, one = room(np.eye(4))
    _, other = room(MOVED)
    for a, b, T in ((one, other, inverse(MOVED)), (other, one, MOVED)):
        seen, empty = depth_consistency(a, b, T, CAMERA, 10.0)
        assert seen > 0.4 and empty < 0.01


def test_depth_tells_a_room_with_a_pillar_from_one_without():
    """What one measured on the pillar lies where the other saw as far as the wall."""
    _, one = room(np.eye(4))
    _, other = room(np.eye(4), SweptRoom(grain=25.0))
    seen, empty = depth_consistency(one, other, np.eye(4), CAMERA, 10.0)
    assert seen > LEAST_SEEN and empty > 2 * MOST_EMPTY
    # The other way round the wall behind it may be hidden.
    assert depth_consistency(other, one, np.eye(4), CAMERA, 10.0)[1] < MOST_EMPTY


def test_without_depth_nothing_is_consistent():
    nothing = np.zeros((CAMERA.height, CAMERA.width), np.float32)
    _, one = room(np.eye(4))
    assert depth_consistency(nothing, one, np.eye(4), CAMERA, 10.0) == (0.0, 1.0)
    assert depth_consistency(one, nothing, np.eye(4), CAMERA, 10.0)[0] == 0.0


def test_two_views_of_a_room_pass():
    """By their features alone, to half a centimetre, with a covariance that covers it."""
    slam = keyframes(CAMERA, [(np.eye(4), room(np.eye(4))), (np.eye(4), room(MOVED))])
    first = slam.loops.verifier.by_features(0, 1)
    assert first.gate is Gate.PASSED and motion_between(first.T_a_b, MOVED)[0] < 0.1
    verdict = slam.loops.verifier.by_images(0, 1, first.T_a_b)
    assert verdict.gate is Gate.PASSED, verdict.why
    step, turn = motion_between(verdict.T_a_b, MOVED)
    assert step < 5e-3 and turn < 0.2
    assert 0 < np.linalg.eigvalsh(verdict.covariance)[-1] < 0.05**2


def test_another_room_does_not():
    """Neither one of another form, painted alike, nor where no feature is the same."""
    other = SweptRoom(half=(1.6, 1.4, 2.0), grain=25.0)
    slam = keyframes(CAMERA, [(np.eye(4), room(np.eye(4))), (np.eye(4), room(np.eye(4), other))])
    assert slam.loops.verifier.by_images(0, 1, np.eye(4)).gate is not Gate.PASSED
    away = motion_of(np.array([0, 0, 0, 0, np.pi, 0]))
    slam = keyframes(CAMERA, [(np.eye(4), room(np.eye(4))), (np.eye(4), room(away))])
    assert slam.loops.verifier.by_features(0, 1).gate is Gate.GEOMETRY


def test_a_room_with_a_post_is_another_one():
    """Features and registration agree; what one measured on the post lies where the other saw as far as the wall."""
    bare, post = SweptRoom(grain=25.0), SweptRoom(pillar=0.1, grain=25.0)
    slam = keyframes(CAMERA, [(np.eye(4), room(np.eye(4), bare)), (np.eye(4), room(MOVED, post))])
    assert slam.loops.verifier.by_features(0, 1).gate is Gate.PASSED
    assert slam.loops.verifier.by_images(0, 1, MOVED).gate is Gate.DEPTH


@pytest.mark.parametrize("shift", [0.0, TILE])
def test_a_wall_of_equal_tiles_proves_no_place(shift):
    """A tile further on all fits as well, so not even the right pose is believed; pictures tell."""
    aside = motion_of(np.array([0.06, 0.0, 0.0, 0.0, 0.0, 0.0]))
    start = motion_of(np.array([shift, 0.0, 0.0, 0.0, 0.0, 0.0])) @ aside
    slam = keyframes(WIDE, [(np.eye(4), wall(np.eye(4), tiles)), (np.eye(4), wall(aside, tiles))])
    assert slam.loops.verifier.by_images(0, 1, start).gate is Gate.UNIQUE
    slam = keyframes(WIDE, [(np.eye(4), wall(np.eye(4), pictures)), (np.eye(4), wall(aside, pictures))])
    verdict = slam.loops.verifier.by_images(0, 1, start)
    assert (verdict.gate is Gate.PASSED) == (shift == 0.0), verdict.why
