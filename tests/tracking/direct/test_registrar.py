"""Pyramids, points, normal equations and registrations against NumPy and known poses."""

from __future__ import annotations

import numpy as np
import pytest

from tests.kernels.swept_room import SweptRoom
from tests.tracking.direct.conftest import CAMERA, ROOM
from warpslam.camera import NO_MOTION, FrameMotion
from warpslam.kernels.direct import points, registration
from warpslam.poses import inverse, motion_between, motion_of, twist_of
from warpslam.tracking.direct.measures import Measures
from warpslam.tracking.direct.pyramid import records
from warpslam.tracking.direct.registrar import new_tasks
from warpslam.tracking.direct.tracker import rotation_grid
from warpslam.tracking.direct.window import Pose, refine_window

START = np.eye(4)
NEXT = motion_of(np.array([0.06, -0.02, 0.05, 0.02, -0.03, 0.01]))


def task(T: np.ndarray, top: int = 4, low: int = 0) -> np.ndarray:
    """Registration of the frame in row 1 to keyframe 1."""
    tasks = new_tasks(1)
    tasks["keyframe"], tasks["row"], tasks["top"], tasks["low"] = 1, 1, top, low
    tasks["grey"], tasks["depth"], tasks["cost_level"], tasks["T"] = 2.0, 1.0, 0, T
    return tasks


def pair(T: np.ndarray, scales: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """The same pair for one evaluation."""
    pairs = records(registration.Pair)
    pairs["keyframe"], pairs["row"], pairs["T"] = 1, 1, T
    pairs["exposure"], pairs["scales"] = (1.0, 0.0), scales
    return pairs


@pytest.fixture
def pair_of_frames(bench):
    """Keyframe 1 at the start, the next frame in row 1."""
    bench.load(0, START)
    bench.registrar.select(0, 1)
    bench.load(1, NEXT)
    return bench


def test_levels_halve_grey_values_and_keep_depth_of_one_surface(bench):
    """Grey values are means of four; depth is the mean of those near the nearest, so that no outline is smeared."""
    bench.load(0, START)
    level, below = bench.plan.levels[1], bench.plan.levels[0]
    images = bench.registrar._images
    grey, depth = images.grey[0].numpy(), images.depth[0].numpy()

    def image(values, level):
        first, size = level["first"], level["width"] * level["height"]
        return values[first : first + size].reshape(level["height"], level["width"])

    cells = image(grey, below).reshape(level["height"], 2, level["width"], 2)
    np.testing.assert_allclose(image(grey, level), cells.mean(axis=(1, 3)), atol=1e-3)
    cells = image(depth, below).reshape(level["height"], 2, level["width"], 2).transpose(0, 2, 1, 3).reshape(-1, 4)
    near = cells <= 1.03 * cells.min(axis=1, keepdims=True)
    expected = (cells * near).sum(axis=1) / near.sum(axis=1)
    assert (~near).any(), "the room has no outline"
    np.testing.assert_allclose(image(depth, level).ravel(), expected, rtol=1e-5)


def test_points_lie_on_the_surface_with_its_normals(bench):
    """Those of the box: every point on a wall or the column, normals along its axes, towards the camera."""
    bench.load(0, START)
    bench.registrar.select(0, 1)
    kept = bench.registrar.points
    X, N = kept.position[1].numpy(), kept.normal[1].numpy()
    valid = X[:, 2] > 0
    assert valid.mean() > 0.9
    X, N = X[valid].astype(np.float64), N[valid]
    _, z = ROOM._hit(START, X / X[:, 2:])
    assert (np.abs(z - X[:, 2]) < 0.01).mean() > 0.97
    has_normal = np.linalg.norm(N, axis=1) > 0.5
    assert has_normal.mean() > 0.7
    assert (np.abs(N[has_normal]).max(axis=1) > 0.99).mean() > 0.99
    assert ((N * X)[has_normal].sum(axis=1) < 0).all()


@pytest.mark.parametrize(("grey", "depth"), [(1.0, 0.0), (0.0, 1.0)])
def test_gradient_is_that_of_the_cost(bench, grey, depth):
    """Derivative of the robust cost by the pose, by differences, for each kind of residual alone."""
    for row, pose in enumerate((START, NEXT)):
        bench.load(row, pose, room=SweptRoom())
    bench.registrar.select(0, 1)
    T = inverse(NEXT) @ motion_of(np.array([0.002, -0.001, 0.001, 0.001, 0.001, -0.001]))
    scales = (30.0, 30.0)
    registrar = bench.registrar

    def cost(xi: np.ndarray) -> float:
        return float(registrar.pairs(0, pair(motion_of(xi) @ T, scales), grey, depth)[0]["counts"][0])

    found = registrar.pairs(0, pair(T, scales), grey, depth)[0]
    step = 4e-4
    numeric = [(cost(step * axis) - cost(-step * axis)) / (2 * step) for axis in np.eye(6)]
    # What comes into view and what goes out makes the cost a little rough.
    assert np.linalg.norm(found["g"][:6] - numeric) < 0.06 * np.linalg.norm(numeric)


def test_scale_is_the_spread_of_the_residuals(pair_of_frames):
    """1.4826 times the median of |r| from the histogram, against residuals that are known: two equal images, one
    brighter by a constant.
    """
    bench = pair_of_frames
    bench.load(1, START, gain=1.0)
    asked = pair(np.eye(4), (20.0, 5.0))
    asked["exposure"] = (1.0, -7.0)
    found = bench.registrar.pairs(0, asked, 1.0, 1.0)[0]
    assert found["scales"][0] == pytest.approx(1.4826 * 7.0, abs=0.5)
    assert found["scales"][1] == pytest.approx(0.3)  # nothing is better than the floor


def test_registers_a_step(pair_of_frames):
    """From no motion at all to a millimetre, with all measures at their best."""
    result = pair_of_frames.registrar.register(task(np.eye(4)))[0]
    step, turn = motion_between(inverse(NEXT), np.float64(result["T"]))
    assert result["ok"] and step < 1e-3 and turn < 0.03
    measures = Measures.of(result["record_0"])
    assert measures.agreement > 0.95 and measures.correlation > 0.9 and measures.known > 0.8
    assert result["end_cost"] < 0.3 * result["start_cost"]


def test_exposure_does_not_move_the_camera(pair_of_frames):
    """An image that is a third darker is fitted by its gain."""
    pair_of_frames.load(1, NEXT, gain=0.7)
    result = pair_of_frames.registrar.register(task(np.eye(4)))[0]
    step, turn = motion_between(inverse(NEXT), np.float64(result["T"]))
    assert step < 2e-3 and turn < 0.06
    assert result["exposure"][0] == pytest.approx(0.7, abs=0.04)


def test_starts_side_by_side_are_those_one_by_one(pair_of_frames):
    """A batch gives what its members give alone, to the byte."""
    starts = [np.eye(4), inverse(NEXT), motion_of(np.array([0.1, 0, 0, 0, 0.05, 0]))]
    alone = [pair_of_frames.registrar.register(task(T))[0].tobytes() for T in starts]
    batch = pair_of_frames.registrar.register(np.concatenate([task(T) for T in starts]))
    assert [one.tobytes() for one in batch] == alone


def test_rotation_is_found_on_the_smallest_image(bench):
    """Fifteen degrees, which no pyramid bridges."""
    turned = motion_of(np.array([0, 0, 0, 0.05, np.radians(15.0), 0]))
    bench.load(0, START)
    bench.load(1, turned)
    grid = rotation_grid(24.0)
    scores = bench.registrar.rotations(bench.registrar.smallest(0)[None], 1, grid)[0]
    found = np.eye(4)
    found[:3, :3] = grid[scores.argmin()]
    assert motion_between(inverse(turned), found)[1] < 4.5


@pytest.mark.parametrize("known", [True, False])
def test_a_moving_camera_is_corrected(bench, known):
    """Delay of depth and rolling shutter, told: the pose of the middle row to millimetres; untold: much worse."""
    twist = np.array([0.4, 0.1, -0.2, 0.3, 0.5, 0.2])
    motion = FrameMotion(tuple(twist), depth_offset=-0.02, readout=0.026)
    bench.load(0, START)
    bench.registrar.select(0, 1)
    bench.load(1, NEXT, motion)
    if known:
        told = records(points.Motion)
        told["to_depth"], told["moves"] = motion_of(0.02 * twist), 1
        told["velocity"], told["spin"] = 0.026 * twist[:3], 0.026 * twist[3:]
        bench.registrar.set_motion(1, told)
    result = bench.registrar.register(task(np.eye(4)))[0]
    step, _ = motion_between(inverse(NEXT), np.float64(result["T"]))
    assert step < 1.5e-3 if known else step > 4e-3


def test_motion_is_taken_from_an_earlier_frame(bench):
    """The joint registration corrects the motion within the frame by the pose that it begins with."""
    twist = np.array([0.3, 0.0, -0.2, 0.2, 0.4, 0.1])
    motion, elapsed = FrameMotion(tuple(twist), depth_offset=-0.02, readout=0.026), 1 / 15
    pose = motion_of(elapsed * twist)
    bench.load(0, START)
    bench.registrar.select(0, 1)
    bench.load(1, pose, motion)
    started = bench.registrar.start(task(inverse(pose)))
    joint = records(registration.Joint)
    joint["row"], joint["count"], joint["keyframes"][0, 0] = 1, 1, 1
    joint["iterations"], joint["grey"], joint["depth"] = 6, 2.0, 1.0
    joint["T_earlier_reference"], joint["elapsed"] = np.eye(4), elapsed
    joint["delay"], joint["readout"] = -0.02, 0.026
    result = bench.registrar.join(started, joint, np.eye(4)[None]).numpy()[0]
    first = started.numpy()[0]
    uncorrected = motion_between(inverse(pose), np.float64(first["T"]))
    corrected = motion_between(inverse(pose), np.float64(result["T"]))
    assert uncorrected[0] > 0.01 and (corrected < 0.5 * uncorrected).all()
    told = bench.registrar._motions.numpy()[1]
    expected = twist_of(inverse(np.float64(first["T"]))) / elapsed
    np.testing.assert_allclose(np.concatenate([told["velocity"], told["spin"]]) / 0.026, expected, atol=1e-3)
    np.testing.assert_allclose(told["to_depth"], motion_of(0.02 * expected), atol=1e-5)


def joined(bench, start: np.ndarray, others: np.ndarray | None, count: int) -> np.ndarray:
    """Joint registration of row 1 to keyframe 1 from a pose on, which rows from elsewhere join."""
    asked = task(start)
    asked["top"], asked["iterations"] = 0, -1
    joint = records(registration.Joint)
    joint["row"], joint["count"], joint["keyframes"][0, 0] = 1, 1, 1
    joint["iterations"], joint["grey"], joint["depth"], joint["others"] = 10, 2.0, 1.0, count
    if others is not None:
        bench.registrar.put_rows(others, 0)
    return bench.registrar.join(bench.registrar.start(asked), joint, np.eye(4)[None]).numpy()[0].copy()


def test_rows_from_elsewhere_join(pair_of_frames):
    """Rows far stronger than the images pull the pose to their own minimum, wherever they are linearised, and count in
    H; rows of nothing leave every byte.
    """
    alone = joined(pair_of_frames, inverse(NEXT), None, 0)
    rows = records(registration.OtherRows)
    rows["T"] = motion_of(np.array([0.01, 0, 0, 0, 0, 0])) @ inverse(NEXT)
    assert joined(pair_of_frames, inverse(NEXT), rows, 1).tobytes() == alone.tobytes()
    xi = np.array([-0.015, 0.01, -0.01, 0.005, -0.005, 0.003])
    rows["H"] = np.diag([1e11] * 3 + [1e11] * 3)
    rows["g"] = -1e11 * xi
    found = joined(pair_of_frames, inverse(NEXT), rows, 1)
    step, turn = motion_between(motion_of(xi) @ np.float64(rows["T"][0]), np.float64(found["T"]))
    assert step < 3e-4 and turn < 0.02
    assert motion_between(np.float64(alone["T"]), np.float64(found["T"]))[0] > 5e-3
    np.testing.assert_allclose(np.diag(found["H"]), 1e11, rtol=0.01)


def test_overlap_is_the_share_that_is_seen_where_it_is(pair_of_frames):
    """All of itself, nearly all after a small step, and nothing from behind."""
    behind = motion_of(np.array([0, 0, 0, 0, np.pi - 0.01, 0]))
    transforms = np.array([inverse(NEXT), behind])
    shares = pair_of_frames.registrar.overlap(1, [1, 1], transforms)
    assert shares[0] > 0.85 and shares[1] == 0.0


def test_window_puts_keyframes_right(bench):
    """Two of four keyframes are a centimetre and half a degree off; the first is not moved."""
    rng = np.random.default_rng(3)
    truth = [motion_of(0.05 * n * np.array([1.0, 0.3, 0.5, 0.1, -0.3, 0.1])) for n in range(4)]
    for n, pose in enumerate(truth):
        bench.load(n, pose)
        bench.registrar.select(n, n + 1)
    noise = [np.zeros(6), 0.008 * rng.normal(size=6), np.zeros(6), 0.008 * rng.normal(size=6)]
    poses = [T @ motion_of(xi) for T, xi in zip(truth, noise, strict=True)]
    members = [Pose(n + 1, n, pose) for n, pose in enumerate(poses)]
    refined = refine_window(bench.registrar, members, 1, 2.0, 1.0, 4).poses
    np.testing.assert_array_equal(refined[0], poses[0])
    before = max(motion_between(a, b)[0] for a, b in zip(poses, truth, strict=True))
    after = max(motion_between(a, b)[0] for a, b in zip(refined, truth, strict=True))
    assert before > 5e-3 and after < 1e-3


def test_twists_and_motions_are_each_others_inverses():
    """exp and log, from nothing to nearly half a turn."""
    rng = np.random.default_rng(0)
    for size in (0.0, 1e-9, 1e-3, 1.0, 1.6):
        xi = size * rng.normal(size=6) / 2
        np.testing.assert_allclose(twist_of(motion_of(xi)), xi, atol=1e-9)
    np.testing.assert_allclose(inverse(NEXT) @ NEXT, np.eye(4), atol=1e-12)
    assert NO_MOTION.is_none and CAMERA.width == 320
