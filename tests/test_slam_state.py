"""Saved SLAM state: every field is needed and checked; the budget for keyframe images; memory figures."""

from __future__ import annotations

import json
import tracemalloc

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tools.attacks.values import mutated_json
from warpslam.camera import Intrinsics, SensorTiming
from warpslam.config import Config
from warpslam.errors import CheckpointError, ConfigError, InputError, MapSizeError
from warpslam.field.decoder_files import load_decoders
from warpslam.slam import Slam
from warpslam.slam_state import state_arrays, state_from_arrays
from warpslam.synthetic import SyntheticSequence
from warpslam.tracking.direct import tracker

CAMERA = Intrinsics(40.0, 40.0, 23.5, 17.5, 48, 36)
IMAGE_GIGABYTES = 5 * 48 * 36 / 1e9
SETTINGS = [
    "tracking.pixels=32", "tracking.iterations=2", "tracking.ignore_edge_u=2", "tracking.ignore_edge_v=2",
    "tracking.lost_depth_error=10", "tracking.lost_inliers=0", "tracking.max_step=10", "tracking.max_turn=180",
    "mapping.pixels=60", "mapping.every=2", "mapping.first_iterations=10", "mapping.iterations=5", "mapping.window=3",
    "mapping.coarse_iterations=1", "mapping.refinement_rounds=1", "mapping.bundle_adjustment_keyframes=2",
    "keyframes.every=1", "tracking.recovery_factor=1", "direct.keyframe_overlap=0.999",
]  # fmt: skip


@pytest.fixture(scope="module")
def frames():
    """Frames of a furnished room."""
    sequence = SyntheticSequence(0, 10, intrinsics=CAMERA)
    return [sequence[n] for n in range(10)]


def run(frames, *overrides: str) -> Slam:
    """Over images that are taken as if by a sensor with a delay and a rolling shutter."""
    config = Config.from_preset("default", [*SETTINGS, *overrides])
    slam = Slam(CAMERA, config, "cpu", decoders=load_decoders(), timing=SensorTiming(-0.02, 0.03))
    for frame in frames:
        slam.step(frame.rgb, frame.depth, frame.timestamp)
    return slam


@pytest.fixture(scope="module")
def state(frames):
    """Header and arrays after four frames, one without depth and one that is lost."""
    slam = run(frames[:3])
    slam.step(frames[3].rgb, np.zeros_like(frames[3].depth))
    slam.config.tracking.relocalization = False
    noise = np.random.default_rng(0).uniform(0.3, 9.0, frames[4].depth.shape).astype(np.float32)
    assert slam.step(frames[4].rgb, noise).status == "LOST"
    return state_arrays(slam.state())


def test_everything_comes_back(state):
    """The state of a loaded map is the state that was saved, to the last bit."""
    header, arrays = state
    again_header, again = state_arrays(Slam.from_state(state_from_arrays("map", header, arrays), "cpu").state())
    assert again_header == header and again.keys() == arrays.keys()
    for name, array in arrays.items():
        assert again[name].dtype == array.dtype, name
        np.testing.assert_array_equal(again[name], array, err_msg=name)


@pytest.mark.parametrize("forgotten", [False, True])
def test_saved_at_bad_moments_it_goes_on_exactly(frames, monkeypatch, forgotten):
    """With more keyframes than are looked at or whose images are held, frames that are lost, one without depth, and a
    pose that was forgotten: from a state before, amid and after them the others get the same poses, to the bit.
    """
    for name, value in (("RECENT", 2), ("CACHED", 3), ("NEAR_KEYFRAMES", 3)):
        monkeypatch.setattr(tracker, name, value)
    noise = np.random.default_rng(0).uniform(0.3, 9.0, frames[4].depth.shape).astype(np.float32)
    depths = [frame.depth for frame in frames]
    depths[5], depths[6], depths[7] = noise, np.zeros_like(noise), noise

    def step(slam: Slam, n: int) -> None:
        if n == 6 and forgotten:
            slam.forget_pose()
        slam.step(frames[n % 10].rgb, depths[n] if n < 10 else frames[n - 10].depth, n / 30)

    def start(state=None) -> Slam:
        return run([], "mapping.enabled=false") if state is None else Slam.from_state(state, "cpu")

    whole, states = start(), []
    for n in range(14):
        step(whole, n)
        states.append(state_arrays(whole.state()))
    assert len(whole.keyframes) > 5 and {"LOST", "SKIPPED"} < set(whole.trajectory.status)
    assert (states[4][1]["direct_overlap"] == -1).any()
    for first in (5, 6, 8, 11):
        again = start(state_from_arrays("map", *states[first - 1]))
        for n in range(first, 14):
            step(again, n)
        header, arrays = state_arrays(again.state())
        assert header == states[-1][0], first
        for name, array in states[-1][1].items():
            np.testing.assert_array_equal(arrays[name], array, err_msg=f"{name}, from frame {first} on")


@pytest.mark.parametrize("layout", ["dense", "blocks"])
def test_free_space_goes_on_after_a_restart(frames, layout):
    """With middle features that begin as free space a run from a state in its midst is the whole run, to the bit; a
    state of before there was that setting has noise.
    """
    overrides = ("grid.middle_start=free", f"grid.layout={layout}", "grid.margin=0.1", "mapping.every=1")
    whole = run(frames[:1], *overrides)
    header, arrays = state_arrays(whole.state())
    again = Slam.from_state(state_from_arrays("map", header, arrays), "cpu")
    rows = whole.scene.grids["middle"].row_count
    for slam in (whole, again):
        for frame in frames[1::4]:
            slam.step(frame.rgb, frame.depth, frame.timestamp)
        assert slam.scene.grids["middle"].row_count > rows
    for name, array in state_arrays(whole.state())[1].items():
        np.testing.assert_array_equal(state_arrays(again.state())[1][name], array, err_msg=name)
    del header["config"]["grid"]["middle_start"], header["config"]["tracking"]["coarse_term"]
    del header["config"]["tracking"]["filter_by"]
    older = Slam.from_state(state_from_arrays("map", header, arrays), "cpu").config
    assert (older.grid.middle_start, older.tracking.coarse_term, older.tracking.filter_by) == ("noise", False, "depth")


def test_frame_that_was_nowhere_can_be_saved(frames, tmp_path):
    """A camera that could not be compared with anything has no depth error, and the state is saved as any other."""
    slam = run(frames[:2], "tracking.optimizer=gauss_newton")
    slam.forget_pose()
    slam.keyframes.clear()
    result = slam.step(frames[2].rgb, frames[2].depth)
    assert result.status == "LOST" and result.depth_error == np.inf and "no keyframe" in result.message
    slam.save(tmp_path / "map.safetensors")
    assert Slam.load(tmp_path / "map.safetensors", "cpu").trajectory.status == ["OK", "OK", "LOST"]


def test_every_array_is_needed_and_checked(state):
    """Each array left out, of another type, of another shape, or not finite is an error that names it."""
    header, arrays = state
    for name, array in arrays.items():
        damaged = [None, array.astype(np.int8), array[None]]
        if array.dtype.kind == "f" and array.size:
            damaged.append(np.full_like(array, np.nan))
        # (A full load for each of hundreds of decoder tensors would take long; they fail before it.)
        for bad in damaged if not name.startswith("image_") else damaged[:2]:
            others = {**arrays, name: bad} if bad is not None else {n: a for n, a in arrays.items() if n != name}
            with pytest.raises(CheckpointError, match=name.split(":")[-1]):
                state_from_arrays("map", header, others)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("seed", -1), ("seed", "1"), ("config", None), ("config", {"grid": {"margin": -1}}), ("intrinsics", {"fx": 1}),
        ("intrinsics", None), ("timing", {"readout": 9}), ("timing", None),
        ("current", 99), ("mapped", "x"), ("first", None), ("keyframes", [77]),
        ("keyframes", 3), ("seen", [-1]),
    ],
)  # fmt: skip
def test_every_header_field_is_checked(state, name, value):
    """A header field that can't be is named."""
    header, arrays = state
    with pytest.raises(CheckpointError, match=name):
        state_from_arrays("map", {**header, name: value}, arrays)
    if value is None:
        with pytest.raises(CheckpointError, match=name):
            state_from_arrays("map", {n: v for n, v in header.items() if n != name}, arrays)


def test_any_header_is_a_state_or_one_error(state):
    """Hundreds of headers with parts replaced by what does not belong there, or left out; settings have tests of their
    own.
    """
    header, arrays = state
    own = json.loads(json.dumps({name: value for name, value in header.items() if name != "config"}))
    refused = 0
    for seed in range(400):
        changed = mutated_json(own, np.random.default_rng(seed))
        try:
            state_from_arrays("map", {**changed, "config": header["config"]}, arrays)
        except CheckpointError as error:
            assert str(error).startswith("map: field "), f"seed {seed}"
            refused += 1
    assert 200 < refused < 400


def test_a_camera_that_sees_nowhere_is_lost_not_an_error(state, frames):
    """A principal point far outside of the image: no pose can be found, and the joint one need not be finite."""
    header, arrays = state
    camera = {**header["intrinsics"], "cx": 1000 * header["intrinsics"]["cx"]}
    slam = Slam.from_state(state_from_arrays("map", {**header, "intrinsics": camera}, arrays), "cpu")
    for frame in frames[5:7]:
        result = slam.step(frame.rgb, frame.depth, frame.timestamp)
        assert result.status in ("OK", "LOST") and np.isfinite(result.T_world_camera).all()


def test_image_that_does_not_inflate_is_refused(state):
    """Compressed images are looked into at load, not when a mapping call wants one."""
    header, arrays = state
    with pytest.raises(CheckpointError, match="image_1"):
        state_from_arrays("map", header, {**arrays, "image_1_rgb": np.arange(50, dtype=np.uint8)})


@given(data=st.data())
@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_damaged_map_file_is_refused(frames, tmp_path_factory, data):
    """Flipped, cut or foreign bytes anywhere in the file of a real map: `CheckpointError`, and nothing else."""
    path = _map_file(frames, tmp_path_factory)
    content = bytearray(path.read_bytes())
    place = data.draw(st.integers(0, len(content) - 1))
    if data.draw(st.booleans()):
        content[place] ^= 1 << data.draw(st.integers(0, 7))
    else:
        content = content[:place] + data.draw(st.binary(max_size=20))
    damaged = path.with_name("damaged.safetensors")
    damaged.write_bytes(content)
    if content != path.read_bytes():
        with pytest.raises(CheckpointError, match="damaged.safetensors"):
            Slam.load(damaged, "cpu")


_files: list = []


def _map_file(frames, factory):
    if not _files:
        path = factory.mktemp("map") / "map.safetensors"
        run(frames[:1], "grid.margin=0.1").save(path)
        _files.append(path)
    return _files[0]


def test_settings_of_a_loaded_map_can_change(frames, tmp_path):
    """Tracking and mapping settings may; the spacing of the grids may not. The caller's settings stay as they are."""
    run(frames[:1]).save(tmp_path / "map.safetensors")
    config = Config.from_preset("default", [*SETTINGS, "mapping.iterations=7"])
    slam = Slam.load(tmp_path / "map.safetensors", "cpu", config=config, localize_only=True)
    assert slam.config.mapping.iterations == 7 and not slam.config.mapping.enabled and config.mapping.enabled
    other = config.updated(["grid.fine_spacing=0.2"])
    with pytest.raises(ConfigError, match="grid.fine_spacing = 0.2 does not fit"):
        Slam.load(tmp_path / "map.safetensors", "cpu", config=other)
    with pytest.raises(InputError, match="load a map"):
        run(frames[:1], "mapping.enabled=false", "tracking.optimizer=gauss_newton")


def test_saving_copies_no_grid(frames, tmp_path):
    """What saving allocates is small beside the grids."""
    slam = run(frames[:1], "grid.margin=3", "grid.layout=dense")
    size = sum(grid.features.capacity for grid in slam.scene.grids.values())
    tracemalloc.start()
    slam.save(tmp_path / "map.safetensors")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert size > 8e6 and peak < 0.2 * size
    assert (tmp_path / "map.safetensors").stat().st_size > size


def test_image_budget_changes_no_result(frames):
    """With room for just the images of a call, the same poses and features come out as with room for all."""
    wide, tight = run(frames), run(frames, f"keyframes.max_gigabytes={8.5 * IMAGE_GIGABYTES}")
    wide.finish(), tight.finish()
    assert len(tight.keyframes) > 8 == tight.images.rgb.shape[0]
    np.testing.assert_array_equal(tight.trajectory.poses, wide.trajectory.poses)
    for level, grid in wide.scene.grids.items():
        np.testing.assert_array_equal(tight.scene.grids[level].state().features, grid.state().features)


def test_image_budget_below_a_window_is_refused_at_once():
    """What mapping needs at a time, what there is room for, and which settings to change."""
    with pytest.raises(MapSizeError, match="needs 8 images of 48 x 36.*has room for 7.*mapping.window"):
        run([], f"keyframes.max_gigabytes={7.5 * IMAGE_GIGABYTES}")


def test_memory_report_adds_up(frames):
    """Bytes by part, and the observed volume: that of the cone before a wall."""
    config = Config.from_preset("default", [*SETTINGS, "grid.layout=dense"])
    slam = Slam(CAMERA, config, "cpu", decoders=load_decoders())
    slam.step(frames[0].rgb, np.full((36, 48), 3.0, np.float32))
    inventory = slam.inventory()
    report, observed = inventory["memory"], inventory["observed_volume_m3"]
    assert report["grid_bytes"] == sum(grid.features.capacity for grid in slam.scene.grids.values())
    parts = report["grid_bytes"] + report["keyframe_bytes"] + report["seen_bytes"]
    assert report["state_bytes"] == parts and report["seen_bytes"] == 2 * 9 * 12
    cone = 3.0**3 / 3 * (48 / 40) * (36 / 40)
    # Cells at the border count whole; a hundred rays leave some between them at the far end.
    assert 0.6 * cone < observed < 1.6 * cone
    assert report["state_bytes_per_observed_m3"] == pytest.approx(parts / observed)


@pytest.mark.slow
def test_memory_stays_flat_over_a_thousand_frames():
    """A camera that walks the same way to and fro, tracked and mapped at its true poses: after the first round neither
    the map nor the process grows, but for a few small keyframes.
    """
    import resource

    count = 40
    sequence = SyntheticSequence(0, count, intrinsics=CAMERA)
    frames = [*(sequence[n] for n in range(count)), *(sequence[n] for n in reversed(range(count)))]
    config = Config.from_preset("default", [*SETTINGS, "keyframes.every=20", "tracking.use_given_poses=true"])
    config.mapping.bundle_adjustment = False
    slam = Slam(CAMERA, config, "cpu", decoders=load_decoders())
    used = []
    for n in range(1000):
        frame = frames[n % len(frames)]
        slam.step(frame.rgb, frame.depth, T_world_camera=frame.T_world_camera)
        slam.tracker.track(slam.scene.arrays(), slam.images, n, frame.T_world_camera)
        if n % 200 == 199:
            used.append((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, slam.inventory()["memory"]["grid_bytes"]))
    process, grids = zip(*used, strict=True)
    assert process[-1] - process[0] < 20 * 1024, f"the process grew: {process} KiB"
    assert grids[-1] == grids[0]
    assert len(slam.keyframes) == 50
