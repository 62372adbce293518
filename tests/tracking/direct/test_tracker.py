"""Direct tracking as the engine uses it: found, lost, found again, and saved."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from tests.tracking.direct.conftest import CAMERA, ROOM
from warpslam import Slam
from warpslam.camera import FrameMotion, SensorTiming
from warpslam.config import Config
from warpslam.frames import FrameResult, FrameStatus
from warpslam.poses import inverse, motion_between, motion_of, twist_of
from warpslam.runtime.cores import slice_count
from warpslam.slam_state import write_slam

STEP = np.array([0.03, 0.005, 0.02, 0.004, -0.02, 0.003])


def poses(count: int) -> list[np.ndarray]:
    """A camera that goes on by one step a frame."""
    return [motion_of(n * STEP) for n in range(count)]


def tracker(**direct: float | str) -> Slam:
    """Tracks, and maps nothing."""
    return Slam(CAMERA, Config.from_dict({"mapping": {"enabled": False}, "direct": direct}), "cpu")


def take(pose: np.ndarray, motion: FrameMotion | None = None) -> tuple[np.ndarray, np.ndarray]:
    return ROOM.take(CAMERA, pose, motion or FrameMotion())


def track(slam: Slam, path: list[np.ndarray]) -> list[FrameResult]:
    return [slam.step(*take(pose)) for pose in path]


def errors(results: list[FrameResult], path: list[np.ndarray]) -> np.ndarray:
    """Distance [m] and angle [degrees] of each pose from the true one."""
    return np.array([motion_between(a.T_world_camera, b) for a, b in zip(results, path, strict=True)])


def dark_room(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Another place: noise that nothing fits, and a wall of another shape."""
    rng = np.random.default_rng(seed)
    rgb = rng.integers(0, 256, (CAMERA.height, CAMERA.width, 3), dtype=np.uint8)
    return rgb, (1.0 + rng.random((CAMERA.height, CAMERA.width))).astype(np.float32)


def test_follows_a_camera():
    """To a few millimetres, with nothing lost, keyframes where they are needed and figures that say so."""
    slam, path = tracker(), poses(24)
    results = track(slam, path)
    assert {result.status for result in results} == {FrameStatus.OK}
    off = errors(results, path)
    assert off[:, 0].max() < 5e-3 and off[:, 1].max() < 0.15
    assert 2 <= len(slam.keyframes) <= 12
    for result in results[1:]:
        assert result.inliers > 0.8 and result.correlation > 0.8
        shift, turn = result.sigma
        assert 0 < shift < 0.02 and 0 < turn < 1.0


def test_uncertainty_covers_the_error():
    """True errors against the keyframe lie within two sigma in most frames, and sigma is not just large."""
    slam, path = tracker(window=0), poses(20)
    results = track(slam, path)
    inside, sigmas = [], []
    for result, pose in list(zip(results, path, strict=True))[1:]:
        anchor = slam.direct._anchors[result.index]
        keyframe = slam.keyframes[anchor.keyframe]
        if keyframe.index == result.index:
            continue
        true = inverse(path[keyframe.index]) @ pose
        error = twist_of(inverse(anchor.T_keyframe_frame) @ true)
        inside.append(np.linalg.norm(error[:3]) < 2 * result.sigma[0])
        sigmas.append(result.sigma[0])
    assert np.mean(inside) >= 0.8 and np.median(sigmas) < 3e-3


def test_another_place_is_no_place():
    """Frames of nowhere are LOST and say why; the camera that comes back is found where it was left."""
    slam, path = tracker(), poses(12)
    track(slam, path[:8])
    lost = [slam.step(*dark_room(seed)) for seed in range(3)]
    assert {result.status for result in lost} == {FrameStatus.LOST}
    assert all("correlate" in result.message or "registration" in result.message for result in lost)
    back = track(slam, path[8:])
    assert back[0].status is FrameStatus.OK
    assert errors(back, path[8:])[:, 0].max() < 5e-3


def test_a_place_found_again_is_confirmed_first():
    """After a long loss three more frames must agree before the pose is believed."""
    slam, path = tracker(), poses(6)
    track(slam, path)
    for seed in range(12):
        assert slam.step(*dark_room(seed)).status is FrameStatus.LOST
    again = [path[-1] @ motion_of(1e-3 * n * np.ones(6)) for n in range(5)]
    back = track(slam, again)
    assert [result.status for result in back] == [FrameStatus.LOST] * 3 + [FrameStatus.OK] * 2
    assert "confirmed" in back[0].message
    assert errors(back[3:], again[3:])[:, 0].max() < 5e-3


def test_a_frame_without_doubt_is_few_launches(monkeypatch):
    """Twelve kernels, two of them in slices, and one read of what they found."""
    slam, path = tracker(), [motion_of(0.15 * n * STEP) for n in range(8)]
    track(slam, path[:-1])
    launches, reads = [], []
    launch, read = wp.Launch.launch, wp.array.numpy
    monkeypatch.setattr(wp.Launch, "launch", lambda self, *a, **k: launches.append(self) or launch(self, *a, **k))
    monkeypatch.setattr(wp.array, "numpy", lambda self, *a, **k: reads.append(self) or read(self, *a, **k))
    sure = slam.direct.counts["sure"]
    slam.step(*take(path[-1]))
    assert slam.direct.counts["sure"] == sure + 1
    assert 0 < len(launches) <= 12 + 2 * (slice_count(slam.device) - 1) and len(reads) == 1


def test_fast_turns_are_found():
    """Turns of 14 degrees back and forth, which constant speed foretells wrongly each time."""
    turns = [motion_of(np.array([0, 0, 0, 0, np.radians(14.0 * (n % 2)), 0])) for n in range(5)]
    results = track(tracker(), turns)
    assert {result.status for result in results} == {FrameStatus.OK}
    assert errors(results, turns)[:, 0].max() < 0.01 and errors(results, turns)[:, 1].max() < 0.3


def test_a_camera_that_stands_still_does_not_move():
    """Noise of image and depth moves it by less than a millimetre."""
    slam, rng = tracker(), np.random.default_rng(0)
    rgb, depth = take(np.eye(4))
    for _ in range(25):
        noisy = np.clip(rgb + rng.normal(0, 4.0, rgb.shape), 0, 255).astype(np.uint8)
        result = slam.step(noisy, depth * (1 + rng.normal(0, 0.004, depth.shape)).astype(np.float32))
        assert result.status is FrameStatus.OK
        assert np.linalg.norm(result.T_world_camera[:3, 3]) < 1e-3
    assert len(slam.keyframes) == 1


def test_a_frozen_image_is_nothing_new():
    """The same image to the bit is skipped; the next one is tracked as if nothing had been."""
    slam, path = tracker(), poses(5)
    track(slam, path[:3])
    frozen = slam.step(*take(path[2]))
    assert frozen.status is FrameStatus.SKIPPED and "to the bit" in frozen.message
    after = track(slam, path[3:])
    assert {result.status for result in after} == {FrameStatus.OK}
    assert errors(after, path[3:])[:, 0].max() < 5e-3


@pytest.mark.parametrize("timed", [True, False])
def test_delay_and_readout_are_corrected(timed):
    """A rolling shutter and late depth, told and untold: the error of a camera that speeds up."""
    timing = SensorTiming(depth_delay=-0.02, readout=0.026)
    config = Config.from_dict({"mapping": {"enabled": False}, "sensor_timing": timed})
    slam = Slam(CAMERA, config, "cpu", timing=timing)
    twists = [
        np.array([0.5 * np.sin(0.15 * n), 0.1, 0.3 * np.cos(0.15 * n), 0, 0.6 * np.sin(0.15 * n), 0]) for n in range(24)
    ]
    pose, path, results = np.eye(4), [], []
    for n, twist in enumerate(twists):
        rgb, depth = take(pose, FrameMotion(tuple(twist), -0.02, 0.026))
        results.append(slam.step(rgb, depth, n / 30))
        path.append(pose)
        pose = pose @ motion_of(twist / 30)
    steps = [inverse(path[n - 1]) @ path[n] for n in range(6, 24)]
    found = [inverse(results[n - 1].T_world_camera) @ results[n].T_world_camera for n in range(6, 24)]
    error = np.median([motion_between(a, b)[0] for a, b in zip(found, steps, strict=True)])
    assert error < 1.5e-3 if timed else error > 1.5e-3


def test_saved_and_loaded_it_goes_on_alike(tmp_path):
    """Poses after loading are the same bytes, lost frames and keyframes included."""
    path = poses(18)
    frames = [take(pose) for pose in path]
    frames[9] = dark_room(1)
    whole = tracker()
    expected = [whole.step(*frame) for frame in frames]
    assert FrameStatus.LOST in {result.status for result in expected}
    for stop in (2, 7, 10, 12):
        part = tracker()
        for frame in frames[:stop]:
            part.step(*frame)
        write_slam(tmp_path / "map", part.state())
        loaded = Slam.load(tmp_path / "map", "cpu")
        rest = [loaded.step(*frame) for frame in frames[stop:]]
        for result, same in zip(rest, expected[stop:], strict=True):
            assert result.status is same.status
            np.testing.assert_array_equal(result.T_world_camera, same.T_world_camera)
        np.testing.assert_array_equal(loaded.trajectory.poses, whole.trajectory.poses)


def test_a_map_that_is_only_looked_at_stays(tmp_path):
    """Its keyframes keep their poses while the camera goes where none of them is."""
    slam, path = tracker(), poses(22)
    track(slam, path[:10])
    write_slam(tmp_path / "map", slam.state())
    looking = Slam.load(tmp_path / "map", "cpu", localize_only=True)
    before = [keyframe.pose.copy() for keyframe in looking.keyframes]
    results = track(looking, path[8:])
    assert results[-1].status is FrameStatus.OK and len(looking.keyframes) > len(before)
    for keyframe, pose in zip(looking.keyframes, before, strict=False):
        np.testing.assert_array_equal(keyframe.pose, pose)


def test_given_poses_start_a_trajectory():
    """The first pose is taken as it is given, and so is one after the camera was forgotten."""
    slam, path = tracker(), poses(4)
    origin = motion_of(np.array([1.0, 2.0, 3.0, 0.3, 0.2, 0.1]))
    first = slam.step(*take(path[0]), T_world_camera=origin)
    np.testing.assert_allclose(first.T_world_camera, origin, atol=1e-12)
    second = slam.step(*take(path[1]))
    assert motion_between(second.T_world_camera, origin @ path[1])[0] < 3e-3
    slam.forget_pose()
    third = slam.step(*take(path[2]), T_world_camera=path[2])
    np.testing.assert_allclose(third.T_world_camera, path[2], atol=1e-12)
