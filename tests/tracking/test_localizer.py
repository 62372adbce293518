"""Tracking failure and recovery: what is noticed, and a camera that comes back after a gap."""

from __future__ import annotations

import numpy as np
import pytest

from warpslam.camera import Intrinsics
from warpslam.config import Config
from warpslam.field.decoder_files import load_decoders
from warpslam.poses import motion_between, pose_from_vector
from warpslam.slam import Slam
from warpslam.synthetic import SyntheticSequence
from warpslam.tracking.direct.tracker import DirectTracker
from warpslam.tracking.localizer import Localizer
from warpslam.tracking.thumbnail import Thumbnail
from warpslam.trajectory import FrameHistory, Located

CAMERA = Intrinsics(62.5, 62.5, 39.5, 29.5, 80, 60)
SETTINGS = [
    "tracking.pixels=300",
    "tracking.ignore_edge_u=3",
    "tracking.ignore_edge_v=3",
    "tracking.recovery_factor=3",
    "mapping.first_iterations=150",
    "mapping.iterations=30",
    "mapping.pixels=400",
    "mapping.coarse=false",
    "mapping.every=2",
    "keyframes.every=4",
]
STRIDE, BEFORE = 4, 26  # the camera walks 1.3 m and turns by 50 degrees
BACK_AT = 34  # in between two keyframes, far from where the camera was last


@pytest.fixture(scope="module")
def sequence() -> SyntheticSequence:
    """A camera walking through a furnished room."""
    return SyntheticSequence(0, 400, intrinsics=CAMERA)


@pytest.fixture(scope="module", params=["gauss_newton", "direct"])
def optimizer(request) -> str:
    """Tracking against renders, and against keyframes."""
    return request.param


@pytest.fixture(scope="module")
def saved(sequence, optimizer, tmp_path_factory):
    """A map of the first frames, in a file."""
    settings = [*SETTINGS, f"tracking.optimizer={optimizer}"]
    slam = Slam(CAMERA, Config.from_preset("rendering", settings), "cpu", decoders=load_decoders())
    for n in range(BEFORE):
        frame = sequence[STRIDE * n]
        result = slam.step(frame.rgb, frame.depth, frame.timestamp, frame.T_world_camera if n == 0 else None)
        assert result.status == "OK"
    path = tmp_path_factory.mktemp("map") / "map.safetensors"
    slam.save(path)
    return path


def error(result, frame) -> float:
    """Distance of an estimated camera from the true one [m]."""
    return motion_between(result.T_world_camera, frame.T_world_camera)[0]


def test_camera_is_found_again_after_a_gap(sequence, saved):
    """After a gap the camera looks at known ground from 0.9 m away: its pose is found within 3 cm, at once, and
    tracking and mapping go on from there.
    """
    slam = Slam.load(saved, "cpu")
    for n in range(3):
        frame = sequence[BACK_AT + n]
        result = slam.step(frame.rgb, frame.depth, frame.timestamp)
        assert result.status == "OK", result.message
        assert error(result, frame) < 0.03


def test_camera_stays_lost_without_the_keyframe_search(sequence, saved, optimizer):
    """The same gap, keyframes left alone: the frame is lost, keeps the last pose, and the map is untouched."""
    if optimizer == "direct":
        pytest.skip("direct tracking always searches")
    slam = Slam.load(saved, "cpu")
    slam.config.tracking.relocalization = False
    features = slam.scene.grids["middle"].state().features.copy()
    last, keyframes = slam.trajectory.poses[-1], len(slam.keyframes)
    frame = sequence[BACK_AT]
    result = slam.step(frame.rgb, frame.depth, frame.timestamp)
    assert result.status == "LOST" and result.message
    np.testing.assert_allclose(result.T_world_camera, last, atol=1e-12)
    np.testing.assert_array_equal(slam.scene.grids["middle"].state().features, features)
    assert len(slam.keyframes) == keyframes


def test_unknown_ground_is_no_place_to_be_found_at(sequence, saved):
    """Frames that show nothing the map knows stay lost, whatever keyframe resembles them; known ground ends it."""
    slam = Slam.load(saved, "cpu")
    for n in (250, 254):
        frame = sequence[n]
        assert slam.step(frame.rgb, frame.depth, frame.timestamp).status == "LOST"
    frame = sequence[BACK_AT]
    result = slam.step(frame.rgb, frame.depth, frame.timestamp)
    assert result.status == "OK" and error(result, frame) < 0.03
    assert slam.trajectory.status[-3:] == ["LOST", "LOST", "OK"]


def test_localize_only_leaves_the_map_alone(sequence, saved, optimizer):
    """The first pose is found against the keyframes without any hint (direct tracking believes it after three frames
    more), later ones are tracked, and nothing of the map changes.
    """
    confirmed = BACK_AT + (3 if optimizer == "direct" else 0)
    slam = Slam.load(saved, "cpu", localize_only=True)
    before = {level: grid.state().features.copy() for level, grid in slam.scene.grids.items()}
    keyframes, bounds = len(slam.keyframes), [side.copy() for side in slam.scene.bounds]
    for n in range(BACK_AT, BACK_AT + 6):
        frame = sequence[n]
        result = slam.step(frame.rgb, frame.depth, frame.timestamp)
        if n < confirmed:
            assert result.status == "LOST" and "to be confirmed" in result.message
        else:
            assert result.status == "OK" and error(result, frame) < 0.03
    assert slam.finish() == {}
    for level, grid in slam.scene.grids.items():
        np.testing.assert_array_equal(grid.state().features, before[level])
    assert len(slam.keyframes) == keyframes
    np.testing.assert_array_equal(slam.scene.bounds, bounds)


def test_localize_only_takes_a_given_first_pose(sequence, saved, monkeypatch):
    """A pose that comes with the first frame is taken, and nothing is searched."""
    slam = Slam.load(saved, "cpu", localize_only=True)
    for tracker, search in ((Localizer, "_likely"), (DirectTracker, "_relocalize")):
        monkeypatch.setattr(tracker, search, lambda *arguments: pytest.fail("the keyframes were searched"))
    for n in (BACK_AT, BACK_AT + 1):
        frame = sequence[n]
        result = slam.step(frame.rgb, frame.depth, frame.timestamp, frame.T_world_camera if n == BACK_AT else None)
        assert result.status == "OK" and error(result, frame) < 0.03


def track(steps: list[float], status: str = "", first: int = 0) -> FrameHistory:
    """A camera that moved along x by ``steps`` [m]; ``status`` has a letter a frame."""
    history = FrameHistory()
    for n, x in enumerate(np.cumsum([0.0, *steps])):
        letter = status[n] if status else "O"
        if n == first:
            history.break_off()
        if letter == "S":
            history.skip(float(n))
        else:
            history.add(float(n), Located(at(x), "nowhere" if letter == "L" else "", depth_error=0.02))
    if first > len(steps):
        history.break_off()
    return history


def at(x: float) -> np.ndarray:
    return pose_from_vector(np.array([1.0, 0, 0, 0, x, 0, 0]))


def test_jump_is_told_from_a_fast_camera():
    """30 cm after steps of 1 cm are a jump, after steps of 10 cm or none they are not; more frames allow for more."""
    assert track([0.01] * 5).is_jump(at(0.35), 0.1, 10.0)
    assert not track([0.01] * 5).is_jump(at(0.14), 0.1, 10.0)
    assert not track([0.1] * 5).is_jump(at(0.8), 0.1, 10.0)
    assert not track([0.01] * 5 + [0.0] * 3, "OOOOOOSSS").is_jump(at(0.35), 0.1, 10.0)
    assert not track([]).is_jump(at(0.3), 0.1, 10.0) and track([]).is_jump(at(0.6), 0.1, 10.0)
    turned = at(0.05)
    turned[:3, :3] = [[0.9, -np.sqrt(0.19), 0], [np.sqrt(0.19), 0.9, 0], [0, 0, 1]]
    assert track([0.01] * 5).is_jump(turned, 0.1, 10.0) and not track([0.01] * 5).is_jump(turned, 0.1, 30.0)


def test_starts_follow_what_is_known():
    """Constant speed from two frames in a row; the last known pose after a loss; none before the first."""
    ahead, here = track([0.1, 0.1]).starts(True)
    np.testing.assert_allclose([ahead[0, 3], here[0, 3]], [0.3, 0.2], atol=1e-12)
    assert len(track([0.1, 0.1]).starts(False)) == 1
    (here,) = track([0.1, 0.1, 0.0], "OOOL").starts(True)
    assert here[0, 3] == pytest.approx(0.2)
    assert len(track([0.1, 0.1], first=2).starts(True)) == 1
    assert track([0.1], first=2).starts(True) == []


def test_thumbnails_tell_views_apart(sequence):
    """A frame is most like its neighbour, less like one further on; one without shared depth is no candidate."""
    first, near, far = (Thumbnail.of(frame.rgb, frame.depth) for frame in map(sequence.__getitem__, (0, 5, 60)))
    assert first.difference(first) == 0
    assert 0 < first.difference(near) < first.difference(far) < np.inf
    assert first.difference(Thumbnail.of(sequence[0].rgb, np.zeros_like(sequence[0].depth))) == np.inf
