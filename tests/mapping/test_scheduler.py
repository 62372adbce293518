"""Schedules: mapping beside tracking gives the same kind of map, is never far behind, and hides no failure."""

import dataclasses
import threading
import time

import numpy as np
import pytest

from tests.test_slam import CAMERA, DECODERS, SMALL
from warpslam.config import Config
from warpslam.errors import MapSizeError
from warpslam.evaluation import ate
from warpslam.mapping.scheduler import THREAD_NAME, Overlapped, Strict
from warpslam.slam import Slam
from warpslam.synthetic import SyntheticSequence

OVERLAPPED = "schedule=overlapped"
WAIT = 60.0  # [s]; a test that hangs fails instead


@pytest.fixture(scope="module")
def frames():
    """Eight frames of a furnished room."""
    sequence = SyntheticSequence(1, 8, intrinsics=CAMERA)
    return [sequence[n] for n in range(8)]


def new_slam(*overrides: str, schedule: str = OVERLAPPED) -> Slam:
    return Slam(CAMERA, Config.from_preset("default", [*SMALL, schedule, *overrides]), "cpu", 0, decoders=DECODERS)


def step(slam: Slam, frame):
    return slam.step(frame.rgb, frame.depth, frame.timestamp, frame.T_world_camera)


def mapping_threads() -> list[str]:
    return [thread.name for thread in threading.enumerate() if thread.name.startswith(THREAD_NAME)]


def features(slam: Slam) -> dict[str, np.ndarray]:
    return {level: grid.state().features.copy() for level, grid in slam.scene.grids.items()}


class Gate:
    """Holds the mapper up at the start of its calls until `open` is set, and notes the frames it got.

    error: Raised then, with the mapper's map spoilt.
    """

    def __init__(self, slam: Slam, monkeypatch) -> None:
        self.open, self.reached, self.frames = threading.Event(), threading.Event(), []
        self.error: Exception | None = None
        original = slam.mapper.start_frame

        def start_frame(images, frame, vector, keyframes):
            self.frames.append(frame)
            self.reached.set()
            assert self.open.wait(WAIT)
            if self.error is not None:
                slam.mapper.scene.grids["middle"].features.fill_(np.nan)
                raise self.error
            return original(images, frame, vector, keyframes)

        monkeypatch.setattr(slam.mapper, "start_frame", start_frame)


@pytest.fixture
def gated(frames, monkeypatch):
    """A SLAM object after its first frame whose mapper waits at a gate; the gate is open in the end."""
    slam = new_slam()
    step(slam, frames[0])
    gate = Gate(slam, monkeypatch)
    yield slam, gate
    gate.open.set()
    slam.wait()


def test_waiting_after_every_frame_equals_strict(frames):
    """If each task is taken over before the next frame, nothing may differ from strict: poses, features, decoder."""
    strict, overlapped = new_slam(schedule="schedule=strict"), new_slam()
    assert isinstance(strict.scheduler, Strict) and isinstance(overlapped.scheduler, Overlapped)
    for frame in frames:
        for slam in (strict, overlapped):
            step(slam, frame)
            slam.wait()
    for slam in (strict, overlapped):
        slam.finish()
    np.testing.assert_array_equal(overlapped.trajectory.poses, strict.trajectory.poses)
    for level, values in features(strict).items():
        np.testing.assert_array_equal(overlapped.scene.grids[level].state().features, values)
    for name, tensor in strict.scene.decoders["color"].unpack().tensors.items():
        np.testing.assert_array_equal(overlapped.scene.decoders["color"].unpack().tensors[name], tensor)
    for ours, theirs in zip(overlapped.keyframes, strict.keyframes, strict=True):
        np.testing.assert_array_equal(ours.pose, theirs.pose)


def test_tracking_goes_on_while_the_mapper_works(frames, gated):
    """A frame is tracked against the map as it was last taken over, and the mapper maps the frame it was given."""
    slam, gate = gated
    step(slam, frames[1])
    step(slam, frames[2])
    assert gate.reached.wait(WAIT)
    before, version = features(slam), slam.scheduler.version
    assert step(slam, frames[3]).status == "OK"
    assert slam.scheduler.version == version == 1
    for level, values in before.items():
        np.testing.assert_array_equal(slam.scene.grids[level].state().features, values)
    gate.open.set()
    slam.wait()
    assert slam.scheduler.version == 2
    waited = new_slam()
    for frame in frames[:3]:
        step(waited, frame)
        waited.wait()
    for level, values in features(waited).items():
        np.testing.assert_array_equal(slam.scene.grids[level].state().features, values)
    assert not np.array_equal(slam.scene.grids["middle"].state().features, before["middle"])


@pytest.mark.parametrize("optimizer", ["adam", "gauss_newton"])
def test_mapper_and_tracker_leave_each_other_alone(frames, monkeypatch, optimizer):
    """Both at the same time, each recording its iterations anew, compute to the bit what they compute by themselves."""
    monkeypatch.setattr("psutil.Process.cpu_affinity", lambda self: [0, 1], raising=False)
    settings = [f"tracking.optimizer={optimizer}", "mapping.bundle_adjustment_keyframes=2", "mapping.iterations=20"]

    def track(slam: Slam) -> np.ndarray:
        slam.tracker._launcher.forget()
        start = frames[4].T_world_camera
        return slam.tracker.track(slam.scene.arrays(), slam.images, 4, start).T_world_camera

    alone, together = new_slam(*settings), new_slam(*settings)
    for slam in (alone, together):
        for frame in frames[:4]:
            step(slam, frame)
            slam.wait()
    gate = Gate(alone, monkeypatch)
    step(alone, frames[4])
    expected = track(alone)
    gate.open.set()
    alone.wait()
    step(together, frames[4])
    poses = []
    while not together.scheduler.has_finished:
        poses.append(track(together))
    together.wait()
    assert len(poses) > 1
    for pose in poses:
        np.testing.assert_array_equal(pose, expected)
    for level, values in features(alone).items():
        np.testing.assert_array_equal(together.scene.grids[level].state().features, values)
    np.testing.assert_array_equal(together.trajectory.poses, alone.trajectory.poses)


def test_map_is_at_most_one_task_behind(frames, gated):
    """The frame that is to be mapped next is not even tracked before the last one is in the map."""
    slam, gate = gated
    for frame in frames[1:4]:
        step(slam, frame)
    waiting = threading.Thread(target=step, args=(slam, frames[4]))
    waiting.start()
    waiting.join(0.5)
    assert waiting.is_alive() and gate.frames == [2] and slam.scheduler.version == 1
    assert len(slam.history) == 4  # (`Slam.trajectory` would wait, too)
    gate.open.set()
    waiting.join(WAIT)
    assert not waiting.is_alive() and slam.scheduler.version == 2
    slam.wait()
    assert gate.frames == [2, 4] and slam.scheduler.version == 3


def test_refined_poses_reach_keyframes_and_trajectory(frames, monkeypatch):
    """Bundle adjustment beside tracking refines keyframes, also the one that was made from the frame being mapped."""
    slam = new_slam(
        "mapping.loss=rendering",
        "tracking.optimizer=gauss_newton",
        "mapping.bundle_adjustment_keyframes=2",
        "keyframes.every=2",
    )
    for frame in frames[:4]:
        step(slam, frame)
        slam.wait()
    gate = Gate(slam, monkeypatch)
    inserted = step(slam, frames[4])
    assert slam.keyframes[-1].index == 4
    tracked = slam.keyframes[-1].pose.copy()
    np.testing.assert_array_equal(slam.trajectory.poses[4], inserted.T_world_camera)
    gate.open.set()
    slam.wait()
    assert not np.array_equal(slam.keyframes[-1].pose, tracked)
    for keyframe in slam.keyframes:
        np.testing.assert_array_equal(slam.history.pose(keyframe.index), keyframe.pose)


def test_losses_come_with_the_frame_that_takes_them_over(frames, gated):
    """The first frame has the losses of its own mapping, a later one those of the task that was done when it came."""
    slam, gate = gated
    step(slam, frames[1])
    assert set(step(slam, frames[2]).losses) == {"tracking"}
    gate.open.set()
    while not slam.scheduler.has_finished:
        time.sleep(0.01)
    assert {"tracking", "direct"} <= set(step(slam, frames[3]).losses)


def test_map_grows_beside_tracking(frames, monkeypatch):
    """A view into the unknown makes the tracker's map grow to what the mapper's has grown to; old rows move along."""
    slam = new_slam("mapping.every=1", "tracking.use_given_poses=true", "mapping.bundle_adjustment=false")
    step(slam, frames[0])
    gate, high = Gate(slam, monkeypatch), slam.scene.bounds[1].copy()
    rows = slam.scene.grids["middle"].row_count
    moved = frames[1].T_world_camera.copy()
    moved[:3, 3] += 3.0
    step(slam, dataclasses.replace(frames[1], T_world_camera=moved))
    assert slam.scene.grids["middle"].row_count == rows
    gate.open.set()
    slam.wait()
    assert slam.scene.grids["middle"].row_count > rows and (slam.scene.bounds[1] >= high + 2.0).all()
    for level, grid in slam.mapper.scene.grids.items():
        np.testing.assert_array_equal(slam.scene.grids[level].state().features, grid.state().features)
        assert slam.scene.grids[level].features.ptr != grid.features.ptr
    assert step(slam, frames[2]).status == "OK"


@pytest.mark.parametrize("call", ["step", "finish", "save"])
def test_failure_of_the_mapper_surfaces_once(frames, gated, tmp_path, call):
    """The next call raises what the mapper raised; the map is as before, and the run can go on."""
    slam, gate = gated
    before = features(slam)
    gate.error = MapSizeError("too large")
    step(slam, frames[1])
    step(slam, frames[2])
    gate.open.set()
    while not slam.scheduler.has_finished:
        time.sleep(0.01)
    calls = {
        "step": lambda: step(slam, frames[3]),
        "finish": slam.finish,
        "save": lambda: slam.save(tmp_path / "map"),
    }
    count = len(slam.trajectory.poses)
    with pytest.raises(MapSizeError, match="too large"):
        calls[call]()
    assert len(slam.trajectory.poses) == count and not mapping_threads()
    for level, values in before.items():
        np.testing.assert_array_equal(slam.scene.grids[level].state().features, values)
    gate.error = None
    for frame in frames[3:6]:
        assert step(slam, frame).status == "OK"
    slam.finish()
    assert np.isfinite(slam.scene.grids["middle"].state().features).all()


def test_interrupt_while_waiting_loses_nothing(frames, gated, monkeypatch):
    """Ctrl-C in a step that waits for the mapper leaves its task under way; finish takes it over."""
    slam, gate = gated
    for frame in frames[1:4]:
        step(slam, frame)
    future = slam.scheduler._beside._future
    with monkeypatch.context() as patch:
        patch.setattr(future, "result", lambda: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            step(slam, frames[4])
    assert slam.scheduler.version == 1
    gate.open.set()
    slam.finish()
    assert slam.scheduler.version > 2 and not mapping_threads()


def test_finish_leaves_no_thread_and_maps_the_last_frame(frames):
    """After finish the mapper has ended, the last frame is mapped, and both maps are the same."""
    slam = new_slam()
    for frame in frames:
        step(slam, frame)
    timings = slam.finish()
    assert not mapping_threads() and {"mapping", "refinement"} <= set(timings)
    assert slam._mapped == 7
    for level, grid in slam.mapper.scene.grids.items():
        np.testing.assert_array_equal(slam.scene.grids[level].state().features, grid.state().features)


def test_saving_waits_and_a_loaded_map_goes_on(frames, gated, tmp_path):
    """The file holds the task that was under way; what is loaded from it maps further."""
    slam, gate = gated
    for frame in frames[1:4]:
        step(slam, frame)
    threading.Timer(0.3, gate.open.set).start()
    slam.save(tmp_path / "map")
    assert slam.scheduler.version == 2
    loaded = Slam.load(tmp_path / "map", "cpu")
    assert isinstance(loaded.scheduler, Overlapped)
    for level, values in features(slam).items():
        np.testing.assert_array_equal(loaded.scene.grids[level].state().features, values)
    for other in (slam, loaded):
        for frame in frames[4:6]:
            step(other, frame)
            other.wait()
    np.testing.assert_array_equal(loaded.trajectory.poses, slam.trajectory.poses)


def test_memory_limit_counts_both_maps(frames):
    """The mapper's map refuses to grow beyond what the tracker's copy leaves of the limit."""
    slam = new_slam("grid.layout=dense")
    step(slam, frames[0])
    low, high = slam.scene.bounds
    alone, beside = slam.scene.gigabytes(low, high), slam.mapper.scene.gigabytes(low, high)
    rows = sum(float(np.prod((high - low) / grid.spacing + 2)) for grid in slam.scene.grids.values())
    assert beside - alone == pytest.approx(rows * 32 * 4 / 1e9)


@pytest.mark.slow
def test_accuracy_on_the_demo_sequence():
    """ATE of an overlapped run is within 10 % of strict, plus 2 mm, on the sequence of `warpslam demo`."""
    from warpslam.synthetic.demo import INTRINSICS, PRESET, demo_sequence

    sequence = demo_sequence()
    errors = {}
    for schedule in ("strict", "overlapped"):
        config = Config.from_preset(PRESET, [f"schedule={schedule}"])
        slam = Slam(INTRINSICS, config, "cpu", 0, decoders=DECODERS)
        for frame in sequence:
            step(slam, frame)
        slam.finish()
        errors[schedule] = ate(slam.trajectory.poses, np.array([frame.T_world_camera for frame in sequence])).rmse
    assert errors["overlapped"] < 1.1 * errors["strict"] + 0.002, errors
