"""What all baselines share: the record of frames, saved maps that are checked field by field, and what they refuse."""

from __future__ import annotations

import numpy as np
import pytest

from warpslam.baselines.base import Baseline
from warpslam.camera import Intrinsics
from warpslam.config import Config
from warpslam.errors import CheckpointError, ConfigError
from warpslam.frames import FrameResult
from warpslam.slam_state import saved_config
from warpslam.storage.state_file import StateFormat, read_state, write_state
from warpslam.trajectory import Located

CAMERA = Intrinsics(20, 20, 15.5, 11.5, 32, 24)


class Counter(Baseline):
    """Its map is the sum of all depth."""

    name = "counter"
    form = StateFormat("warpslam-counter", 2, "the map of a run with --method counter")

    def __init__(self, intrinsics, config=None, device=None, seed=0):
        super().__init__(intrinsics, config, device, seed)
        self.sum = np.zeros(1)

    def _step(self, frame):
        self.sum += frame.depth.sum()
        self.history.add(frame.timestamp, Located(frame.given_pose))
        return FrameResult(frame.index, frame.timestamp, frame.given_pose)

    def _state(self):
        return {}, {"sum": self.sum}

    def _restore(self, state):
        self.sum = state.array("sum", np.float64, (1,)).copy()


@pytest.fixture
def counter() -> Counter:
    """Two frames, and one without depth."""
    method = Counter(CAMERA, Config.from_preset(overrides=["tsdf.voxel=0.07"]), seed=3)
    rgb = np.full((24, 32, 3), 90, np.uint8)
    for depth in (2.0, 0.0, 3.0):
        method.step(rgb, np.full((24, 32), depth, np.float32), T_world_camera=np.eye(4))
    return method


def test_a_saved_map_goes_on_where_it_was(counter, tmp_path):
    """Map, trajectory, settings, camera and seed come back; the same content gives the same bytes."""
    a, b = tmp_path / "a.safetensors", tmp_path / "b.safetensors"
    counter.save(a)
    again = Counter.load(a)
    assert again.sum == counter.sum == 5.0 * 24 * 32
    assert (again.config, again.intrinsics, again.seed) == (counter.config, CAMERA, 3)
    assert again.trajectory.status == ["OK", "SKIPPED", "OK"]
    np.testing.assert_array_equal(again.trajectory.poses, counter.trajectory.poses)
    np.testing.assert_array_equal(again.trajectory.timestamps, counter.trajectory.timestamps)
    again.save(b)
    assert a.read_bytes() == b.read_bytes()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("seed", -1), ("config", {"grid": {"margin": -1}}), ("config", None), ("intrinsics", {"fx": 1}),
        ("intrinsics", []), ("status", np.zeros(2, np.uint8)), ("status", np.array([0, 0, 9], np.uint8)),
        ("status", np.zeros(3)), ("poses", np.zeros((3, 6))), ("first", -1), ("motion", np.full((4, 4), np.nan)),
        ("timestamps", np.zeros(2)), ("sum", np.zeros(2)), ("sum", np.full(1, np.nan)),
    ],
)  # fmt: skip
def test_every_field_is_checked(counter, tmp_path, name, value):
    """A header field or an array that can't be is a `CheckpointError` with the file and the field."""
    path = tmp_path / "map.safetensors"
    counter.save(path)
    header, arrays = read_state(path, Counter.form)
    (arrays if isinstance(value, np.ndarray) else header)[name] = value
    write_state(path, Counter.form, header, arrays)
    with pytest.raises(CheckpointError, match=f"map.safetensors: field {name}"):
        Counter.load(path)


def test_a_map_of_another_method_is_named(counter, tmp_path):
    """What lies there, and what to name instead, whichever way round."""
    path = tmp_path / "map.safetensors"
    counter.save(path)
    with pytest.raises(CheckpointError, match="is 'warpslam-counter'.*name the map of a run with --method nice-slam"):
        saved_config(path)
    write_state(path, StateFormat("warpslam-map", 2), {}, {})
    with pytest.raises(CheckpointError, match="is 'warpslam-map'.*name the map of a run with --method counter"):
        Counter.load(path)


def test_what_a_baseline_lacks_it_says(counter):
    """No refinement, no forecast: the method and the option to leave out; and nothing more to tell of its map."""
    with pytest.raises(ConfigError, match="method counter has no refinement.*--refine"):
        counter.refine(3)
    with pytest.raises(ConfigError, match="method counter forecasts nothing.*--forecast"):
        counter.mesh(forecast=True)
    assert counter.inventory() == {} and not counter.has_checkpoints
