"""The camera's timing, estimated while it is tracked."""

from __future__ import annotations

import numpy as np
import pytest

from tests.tracking.direct.conftest import CAMERA, ROOM
from warpslam.camera import NO_MOTION, ONE_MOMENT, FrameMotion, SensorTiming
from warpslam.config import Config
from warpslam.errors import CheckpointError
from warpslam.kernels.direct.timing import COLUMNS, TimedPair
from warpslam.poses import adjoint, inverse, motion_of, twist_of
from warpslam.slam import Slam
from warpslam.slam_state import state_arrays, state_from_arrays
from warpslam.tracking.direct import timing
from warpslam.tracking.direct.pyramid import records

STAMPED = 0.006
"""By which depth is stamped later than colour [s]."""
COUNT = 60


def twist_at(n: int) -> np.ndarray:
    """Of a hand that shakes, at frame ``n`` [m/s, rad/s]."""
    a = 0.45 * n
    return np.array(
        [0.5 * np.sin(a), 0.3 * np.cos(0.8 * a), 0.2 * np.sin(1.3 * a), 0.3 * np.cos(a), 0.4 * np.sin(a), 0]
    )


def recording(true: SensorTiming) -> list[tuple[np.ndarray, np.ndarray]]:
    """Colour and depth of `COUNT` frames."""
    pose, frames = np.eye(4), []
    for n in range(COUNT):
        offset = STAMPED + true.depth_delay
        frames.append(ROOM.take(CAMERA, pose, FrameMotion(tuple(twist_at(n)), offset, true.readout)))
        pose = pose @ motion_of(twist_at(n) / 60) @ motion_of(twist_at(n + 1) / 60)
    return frames


@pytest.fixture(scope="module")
def late() -> list[tuple[np.ndarray, np.ndarray]]:
    """Depth is older than its stamp says, and rows are read one after the other."""
    return recording(SensorTiming(-0.02, 0.026))


@pytest.fixture(autouse=True)
def short_blocks(monkeypatch):
    """A block of four frames is enough here."""
    monkeypatch.setattr(timing, "BLOCK", 4)
    monkeypatch.setattr(timing, "LATER_BLOCKS", 3)


def new_slam(*overrides: str, believed: SensorTiming = ONE_MOMENT) -> Slam:
    """One that only tracks, with a keyframe every few frames."""
    near = ["direct.keyframe_step=0.02", "direct.keyframe_turn=2"]
    config = Config.from_preset("default", ["mapping.enabled=false", *near, *overrides])
    return Slam(CAMERA, config, "cpu", timing=believed)


def step(slam: Slam, frames: list[tuple[np.ndarray, np.ndarray]], first: int, *, stamped: bool = True) -> list:
    """Frames from ``first`` on; what each result says of the timing."""
    results = []
    for n, (rgb, depth) in enumerate(frames[first:], start=first):
        results.append(slam.step(rgb, depth, n / 30, depth_timestamp=n / 30 + STAMPED if stamped else None))
    assert {result.status for result in results} == {"OK"}
    return [(result.index, result.sensor_timing) for result in results if result.sensor_timing]


@pytest.mark.parametrize(("delay", "readout"), [(-0.02, 0.026), (0.02, 0.026), (0.025, 0.0)])
def test_planted_timing_is_found(late, delay, readout):
    """Late and early depth, rolling and global shutter: within the deviation that is told, in the end to 4 ms; used."""
    slam = new_slam()
    (first, found), *later = step(slam, late if delay < 0 else recording(SensorTiming(delay, readout)), 0)
    assert 24 <= first <= 32 and len(later) >= 1
    for told in (found, *(more for _, more in later)):
        for name, true in (("depth_delay", delay), ("readout", readout)):
            assert abs(told[name] - true) < 3 * told[f"{name}_sigma"], (told, name)
    last = later[-1][1]
    assert abs(last["depth_delay"] - delay) < 4e-3 and abs(last["readout"] - readout) < 4e-3
    assert slam.timing == SensorTiming(last["depth_delay"], last["readout"])
    assert slam.direct.readout == pytest.approx(last["readout"])
    for keyframe in slam.keyframes:
        assert keyframe.motion.depth_offset == pytest.approx(STAMPED + last["depth_delay"])
        assert keyframe.motion.readout == pytest.approx(last["readout"])


def test_images_of_one_moment_have_no_timing():
    """What can't be told from none is none."""
    slam = new_slam()
    found = step(slam, recording(ONE_MOMENT), 0)
    assert found == [] and slam.timing == ONE_MOMENT
    scores = np.array(list(slam.timing_estimator._blocks.values()))
    change, sigma = timing.solve(scores)
    assert len(scores) > timing.FIRST_BLOCKS and (np.abs(change) < 3 * sigma).all() and max(sigma) < timing.MAX_SIGMA


def test_it_is_off_where_timing_is_known_or_not_wanted(late):
    """Told, switched off, without stamps of depth, and with the paper's settings."""
    for slam in (
        new_slam("direct.timing=given"),
        new_slam("sensor_timing=false"),
        new_slam(believed=SensorTiming(-0.02, 0.026)),
        Slam(CAMERA, Config.from_preset("paper_replica"), "cpu"),
    ):
        assert slam.timing_estimator is None
    slam, plain = new_slam(), new_slam("direct.timing=given")
    assert step(slam, late[:12], 0, stamped=False) == step(plain, late[:12], 0, stamped=False) == []
    assert len(slam.timing_estimator.state().blocks) == 0
    assert slam.trajectory.poses.tobytes() == plain.trajectory.poses.tobytes()


def test_a_run_that_is_resumed_finds_the_same(late):
    """From states before and after the estimate everything goes on to the bit."""
    whole, states = new_slam(), {}
    for n in range(COUNT):
        step(whole, late[: n + 1], n)
        states[n + 1] = state_arrays(whole.state())
    assert states[COUNT][0]["timing"] != vars(ONE_MOMENT)
    for first in (20, 33, 36):
        again = Slam.from_state(state_from_arrays("map", *states[first]), "cpu")
        step(again, late, first)
        header, arrays = state_arrays(again.state())
        assert header == states[COUNT][0], first
        for name, array in states[COUNT][1].items():
            np.testing.assert_array_equal(arrays[name], array, err_msg=f"{name}, from frame {first} on")


def test_saved_state_is_checked(late):
    """Fields that are missing or don't fit are named."""
    slam = new_slam()
    step(slam, late[:8], 0)
    header, arrays = state_arrays(slam.state())
    assert len(arrays["timing_blocks"]) > 0
    for name, value in (("since", -1), ("stage", "none"), ("first", None)):
        damaged = {**header, "timing_estimate": {**header["timing_estimate"], name: value}}
        with pytest.raises(CheckpointError, match="timing_estimate"):
            state_from_arrays("map", damaged, arrays)
    with pytest.raises(CheckpointError, match="timing_blocks"):
        state_from_arrays("map", header, {**arrays, "timing_blocks": np.zeros((3, 4))})


@pytest.mark.parametrize("delay", [-0.015, 0.015])
def test_sums_of_a_pair_point_to_the_delay(bench, delay):
    """A frame whose depth is late, seen from a keyframe at rest: its sign and, with both kinds of shutter, its size."""
    pose, twist = motion_of(np.array([0.03, 0.01, -0.02, 0.01, 0.02, 0.0])), np.array([0.4, 0.2, -0.3, 0.3, -0.4, 0.2])
    bench.load(0, np.eye(4), NO_MOTION)
    bench.registrar.select(0, 1)
    bench.load(1, pose, FrameMotion(tuple(twist), depth_offset=delay))
    pair = records(TimedPair)
    pair["keyframe"], pair["row"], pair["T"], pair["frame_twist"] = 1, 1, inverse(pose), twist
    found = bench.registrar.timing(1, pair, 2.0, 1.0)[0]
    H = np.zeros((COLUMNS, COLUMNS))
    H[np.tril_indices(COLUMNS)] = found["entries"]
    scores = timing.eliminated(H + np.tril(H, -1).T)
    assert scores[0] > 0 and scores[2] > 0
    step = -np.linalg.solve(np.array([[scores[0], scores[1]], [scores[1], scores[2]]]), scores[3:])
    assert 0.5 < step[0] / delay < 1.5 and abs(step[1]) < 0.006


def test_keyframes_own_motion_counts_against_the_frames(bench):
    """Where keyframe and frame move alike, a delay shows in neither."""
    twist = np.array([0.4, 0.2, -0.3, 0.3, -0.4, 0.2])
    pose = motion_of(twist / 20)
    bench.load(0, np.eye(4))
    bench.registrar.select(0, 1)
    bench.load(1, pose)
    information = []
    for own in (np.zeros(6), twist):
        pair = records(TimedPair)
        pair["keyframe"], pair["row"], pair["T"], pair["frame_twist"] = 1, 1, inverse(pose), twist
        pair["keyframe_twist"] = adjoint(inverse(pose)) @ own
        entries = bench.registrar.timing(1, pair, 2.0, 1.0)[0]["entries"]
        H = np.zeros((COLUMNS, COLUMNS))
        H[np.tril_indices(COLUMNS)] = entries
        information.append(timing.eliminated(H + np.tril(H, -1).T)[0])
    assert information[1] < 1e-3 * information[0]


def test_deviation_is_that_of_blocks():
    """Blocks that contradict one another make an estimate uncertain; no readout is negative."""
    H = np.array([4e6, 0.0, 4e6])
    agreeing = np.array([[*H, -4e4, 4e4]] * 8)
    step, sigma = timing.solve(agreeing)
    np.testing.assert_allclose(step * timing.INFORMATION, [0.01, -0.01])
    np.testing.assert_allclose(sigma, timing.BIAS, rtol=1e-6)
    rng = np.random.default_rng(0)
    noise = np.concatenate([np.zeros((8, 3)), 4e4 * rng.normal(size=(8, 2))], axis=1)
    _, uncertain = timing.solve(agreeing + noise)
    assert (uncertain > 0.003).all()
    held, _ = timing.solve(agreeing, least=(-np.inf, 0.0))
    np.testing.assert_allclose(held * timing.INFORMATION, [0.01, 0.0], atol=1e-12)
    _, unknown = timing.solve(np.zeros((8, 5)))
    assert np.isinf(unknown).all()


def test_short_twists_are_twists():
    """A few degrees between two poses: as the logarithm has it, to a part in a thousand."""
    rng = np.random.default_rng(1)
    for _ in range(20):
        before, xi = (
            motion_of(rng.normal(size=6)),
            np.concatenate([0.1 * rng.normal(size=3), 0.05 * rng.normal(size=3)]),
        )
        after = before @ motion_of(xi)
        expected = twist_of(inverse(before) @ after)
        np.testing.assert_allclose(timing._short_twist(before, after), expected, atol=2e-4)
