"""The whole engine on a few small frames of a synthetic room."""

import dataclasses
import re

import numpy as np
import pytest
import torch
import warp as wp

from warpslam.camera import Intrinsics
from warpslam.config import Config
from warpslam.errors import CheckpointError, ConfigError, InputError
from warpslam.field.decoder_files import load_decoders
from warpslam.frames import read_images
from warpslam.slam import Slam
from warpslam.synthetic import SyntheticSequence

CAMERA = Intrinsics(60.0, 60.0, 39.5, 29.5, 80, 60)
DECODERS = load_decoders()
BY_RENDERING = "tracking.optimizer=gauss_newton"
TRACKERS = pytest.mark.parametrize("optimizer", ["direct", "gauss_newton"])
DEVICES = ["cpu", *(str(d) for d in wp.get_cuda_devices())]
SMALL = [
    "tracking.pixels=64",
    "tracking.iterations=3",
    "tracking.ignore_edge_u=4",
    "tracking.ignore_edge_v=4",
    "tracking.lost_depth_error=10",
    "tracking.lost_inliers=0",
    "tracking.max_step=10",
    "tracking.max_turn=180",
    "mapping.pixels=100",
    "mapping.every=2",
    "mapping.first_iterations=20",
    "mapping.iterations=10",
    "mapping.coarse_iterations=2",
    "mapping.refinement_rounds=1",
    "keyframes.every=2",
]


@pytest.fixture(scope="module")
def frames():
    """Eight frames of a furnished room."""
    sequence = SyntheticSequence(1, 8, intrinsics=CAMERA)
    return [sequence[n] for n in range(8)]


def new_slam(*overrides: str, preset: str = "default", device: str = "cpu", seed: int = 0) -> Slam:
    return Slam(CAMERA, Config.from_preset(preset, [*SMALL, *overrides]), device, seed, decoders=DECODERS)


def run(frames, *overrides: str, device: str = "cpu", seed: int = 0) -> Slam:
    slam = new_slam(*overrides, device=device, seed=seed)
    for frame in frames:
        slam.step(frame.rgb, frame.depth, frame.timestamp, frame.T_world_camera)
    return slam


@TRACKERS
def test_two_runs_are_bit_identical(frames, optimizer):
    """Same input and seed: the same poses and features to the last bit; another seed: other features, and other poses
    where they come from renders of the map.
    """
    tracked = f"tracking.optimizer={optimizer}"
    a, b, c = run(frames[:4], tracked), run(frames[:4], tracked), run(frames[:4], tracked, seed=1)
    for slam in (a, b, c):
        slam.finish()
    np.testing.assert_array_equal(a.trajectory.poses, b.trajectory.poses)
    for level in a.scene.grids:
        np.testing.assert_array_equal(a.scene.grids[level].state().features, b.scene.grids[level].state().features)
        assert not np.array_equal(a.scene.grids[level].state().features, c.scene.grids[level].state().features)
    assert np.array_equal(a.trajectory.poses[1:4], c.trajectory.poses[1:4]) == (optimizer == "direct")


@pytest.mark.parametrize("optimizer", ["adam", "gauss_newton"])
@pytest.mark.parametrize("device", DEVICES)
def test_tracking_recovers_a_small_motion(frames, device, optimizer):
    """Against a map made at the true pose, a start 2 cm and 1 degree off ends at less than half of that."""
    settings = ["mapping.first_iterations=200", "mapping.pixels=400", "mapping.coarse=false", "tracking.pixels=300"]
    steps = (
        ["tracking.iterations=30", "tracking.learning_rate=3e-3"] if optimizer == "adam" else ["tracking.iterations=8"]
    )
    slam = run(frames[:1], *settings, *steps, f"tracking.optimizer={optimizer}", device=device)
    truth = frames[0].T_world_camera
    a = np.radians(1.0)
    offset = np.eye(4)
    offset[:3, :3] = [[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]]
    offset[:3, 3] = [0.015, 0.01, -0.01]
    result = slam.tracker.track(slam.scene.arrays(), slam.images, 1, truth @ offset)
    error = np.linalg.inv(truth) @ result.T_world_camera
    assert np.linalg.norm(error[:3, 3]) < 0.01
    assert np.degrees(np.arccos(np.clip((np.trace(error[:3, :3]) - 1) / 2, -1, 1))) < 0.5
    assert result.inliers > 0.6


def test_mapping_lowers_the_depth_error(frames):
    """After the first frame the map renders its depth; a map that was not optimised does not."""
    errors = []
    for iterations in (1, 100):
        slam = run(frames[:1], f"mapping.first_iterations={iterations}", "mapping.pixels=400", "mapping.coarse=false")
        rendered = slam.render(frames[0].T_world_camera, depth=frames[0].depth, stride=4)
        valid = frames[0].depth[::4, ::4] > 0
        errors.append(np.abs(rendered.depth - frames[0].depth[::4, ::4])[valid].mean())
    assert errors[1] < 0.15 < errors[0]


def test_bundle_adjustment_writes_poses_back(frames):
    """With enough keyframes, keyframe poses change and the trajectory holds the refined ones; the oldest stays."""
    by_rendering = BY_RENDERING, "mapping.loss=rendering"
    slam = run(frames, *by_rendering, "mapping.bundle_adjustment_keyframes=2", "mapping.bundle_adjustment_rate=1e-3")
    first, second = slam.keyframes[:2]
    trajectory = slam.trajectory.poses
    np.testing.assert_allclose(trajectory[first.index], frames[0].T_world_camera, atol=1e-6)
    off = run(frames, *by_rendering, "mapping.bundle_adjustment=false")
    assert not np.allclose(second.pose, off.keyframes[1].pose)
    for keyframe in slam.keyframes:
        np.testing.assert_array_equal(slam.history.pose(keyframe.index), keyframe.pose)


def test_keyframes_by_interval_and_by_information_gain(frames):
    """Every second frame; or when too little of the view is explained, which an impossible threshold makes every
    frame.
    """
    assert [k.index for k in run(frames[:5], BY_RENDERING).keyframes] == [0, 2, 4]
    gain = [BY_RENDERING, "keyframes.policy=information_gain"]
    assert [k.index for k in run(frames[:3], *gain, "keyframes.known_error=1e-9").keyframes] == [0, 1, 2]
    assert [k.index for k in run(frames[:3], *gain, "keyframes.known_error=1e9").keyframes] == [0]


def test_given_poses_are_taken(frames):
    """With use_given_poses trajectory and keyframes have the truth, whatever bundle adjustment would say, and a frame
    without a pose is refused.
    """
    adjusted = ("mapping.every=1", "keyframes.every=1", "mapping.bundle_adjustment_keyframes=2")
    slam = run(frames[:3], "tracking.use_given_poses=true", *adjusted)
    truth = [f.T_world_camera for f in frames[:3]]
    np.testing.assert_allclose(slam.trajectory.poses, truth, atol=1e-6)
    np.testing.assert_allclose([k.pose for k in slam.keyframes], truth, atol=1e-6)
    with pytest.raises(InputError, match="frame 3"):
        slam.step(frames[3].rgb, frames[3].depth)


def test_bundle_adjustment_is_no_motion(frames, monkeypatch):
    """A correction of the last pose moves the start of the next frame by as much, and not by twice as much."""
    slam = run(frames[:4], BY_RENDERING)
    track, starts = slam.tracker.track, []
    monkeypatch.setattr(slam.tracker, "track", lambda *a, **k: starts.append(a[3]) or track(*a, **k))
    before, last = (slam.history.pose(n) for n in (2, 3))
    corrected = last.copy()
    corrected[0, 3] += 0.05
    slam.history.correct(3, corrected)
    slam.step(frames[4].rgb, frames[4].depth)
    expected = corrected @ np.linalg.inv(before) @ last
    np.testing.assert_allclose(starts[0], expected, atol=1e-6)


def test_tracking_goes_by_what_was_seen(frames):
    """Forgetting one half of what was seen leaves the rays into the other half; the share of inliers is theirs, until
    next to nothing is left. With the setting off all rays count.
    """
    settings = (BY_RENDERING, "tracking.lost_inliers=0.2", "tracking.relocalization=false")
    slam, paper = run(frames[:1], *settings), run(frames[:1], *settings, "tracking.seen_only=false")

    def next_result(slam: Slam, share: float) -> tuple[int, float, str]:
        """Forget all but a share of the seen vertices; rays that count, share of inliers and status of a frame."""
        seen = slam.scene.grids["color"].seen
        flags = seen.numpy()
        flags[int(share * len(flags)) :] = 0
        seen.assign(flags)
        result = slam.step(frames[1].rgb, frames[1].depth)
        return int(slam.tracker._batch.keep.numpy().sum()), result.inliers, result.status

    whole, half, nothing = (next_result(slam, share) for share in (1.0, 0.5, 0.0))
    assert 0 < half[0] < 0.8 * whole[0]
    assert whole[1] > 0.9 and half[1] > 0.9
    assert nothing[1:] == (0.0, "LOST")
    assert next_result(paper, 0.0)[2] == "OK"


def test_coarse_term_where_nothing_was_seen(frames):
    """Half of what was seen forgotten: the rays into the other half join the loss of tracking by the coarse level, in
    its descent and in its judgement; with everything seen, none do and the pose is the same to the bit.
    """

    def next_pose(share: float, *overrides: str) -> tuple[np.ndarray, Slam]:
        slam = run(frames[:1], "tracking.optimizer=adam", "mapping.loss=rendering", "grid.layout=dense", *overrides)
        seen = slam.scene.grids["color"].seen
        flags = np.ones_like(seen.numpy())
        flags[int(share * len(flags)) :] = 0
        seen.assign(flags)
        slam.step(frames[1].rgb, frames[1].depth)
        return slam.history.pose(1), slam

    on = "tracking.coarse_term=true"
    whole, _ = next_pose(1.0)
    forecast, slam = next_pose(1.0, on)
    np.testing.assert_array_equal(forecast, whole)
    assert not slam.tracker._forecast.inlier.numpy().any()
    half, _ = next_pose(0.5)
    forecast, slam = next_pose(0.5, on)
    assert np.abs(forecast - half).max() > 1e-5
    rays, others = (batch.inlier.numpy() != 0 for batch in (slam.tracker._forecast, slam.tracker._batch))
    assert rays.any() and others.any() and not (rays & others).any()
    np.testing.assert_array_equal(
        slam.tracker._forecast.measured_depth.numpy(), slam.tracker._batch.measured_depth.numpy()
    )
    assert slam.tracker._judged.numpy()[0, -1, 1] > 0


def test_settings_of_the_papers_tracking_loss_need_it():
    """What the coarse term and the filter by Eq. 12 can't do without is named, with the remedy; given poses ask for
    nothing.
    """
    on, by_loss = "tracking.coarse_term=true", "tracking.filter_by=loss"
    for overrides, message in (
        ([on], "optimizer=adam"),
        ([on, BY_RENDERING], "optimizer=adam"),
        ([on, "tracking.optimizer=adam"], "mapping.loss=rendering"),
        ([on, "tracking.optimizer=adam", "mapping.loss=rendering", "mapping.coarse=false"], "mapping.coarse=true"),
        ([by_loss], "gauss_newton"),
    ):
        with pytest.raises(ConfigError, match=message):
            new_slam(*overrides)
    new_slam(on, by_loss, "tracking.use_given_poses=true")
    new_slam(by_loss, BY_RENDERING)


def test_filter_by_the_whole_loss(frames):
    """With the filter of Eq. 12 what was inlier by depth alone is not, where colour is wrong."""

    def inliers(*overrides: str) -> int:
        slam = run(frames[:1], BY_RENDERING, "tracking.dynamic_filter=1.5", "tracking.color_weight=5", *overrides)
        rgb = frames[1].rgb.copy()
        rgb[:, :40] = 255 - rgb[:, :40]
        slam.step(rgb, frames[1].depth)
        return int(slam.tracker._batch.inlier.numpy().sum())

    assert inliers("tracking.filter_by=loss") != inliers()


def test_given_poses_start_the_map_from_depth(frames):
    """Under the rendering loss: where poses are given, vertices start from the depth unless the settings say no; where
    they are not, only if the settings say so.
    """

    def has_started(*overrides: str) -> bool:
        return bool(run(frames[:1], "mapping.loss=rendering", *overrides).scene.grids["middle"].seen.numpy().any())

    given, off, on = "tracking.use_given_poses=true", "mapping.depth_start=false", "mapping.depth_start=true"
    assert has_started(given) and has_started(on)
    assert not has_started() and not has_started(given, off)


def test_only_vertices_in_the_frustum_change(frames):
    """A mapping call leaves every vertex behind the camera as it was, to the bit."""
    slam = run(frames[:1], "mapping.coarse=false", "grid.layout=dense")
    grid = slam.scene.grids["middle"]
    before = grid.state().features.copy()
    slam.mapper.start_frame(slam.images, 1, slam.history.pose(0), slam.keyframes)()
    index = np.stack(np.meshgrid(*(np.arange(n) for n in grid.shape), indexing="ij"), -1).reshape(-1, 3)
    camera = (grid.spacing * (grid.first + index) - frames[0].T_world_camera[:3, 3]) @ frames[0].T_world_camera[:3, :3]
    behind = (camera[:, 2] < 0) & (np.linalg.norm(camera, axis=1) > 0.5)
    changed = (grid.state().features != before).any(axis=1)
    assert changed.any() and behind.any()
    assert not changed[behind].any()


def test_frame_without_depth_is_skipped_and_the_run_goes_on(frames):
    """Status SKIPPED with a reason; the map is untouched; the next frame is tracked."""
    slam = run(frames[:2])
    features = slam.scene.grids["middle"].state().features.copy()
    result = slam.step(frames[2].rgb, np.zeros_like(frames[2].depth))
    assert result.status == "SKIPPED" and "depth" in result.message
    np.testing.assert_array_equal(slam.scene.grids["middle"].state().features, features)
    assert slam.step(frames[3].rgb, frames[3].depth).status == "OK"
    assert slam.trajectory.status == ["OK", "OK", "SKIPPED", "OK"]


def test_lost_frame_freezes_the_map(frames):
    """Depth that disagrees with the map gives LOST, says why, and changes no feature."""
    slam = run(frames[:1], "tracking.lost_depth_error=0.15", "mapping.every=1", "mapping.first_iterations=150")
    features = slam.scene.grids["middle"].state().features.copy()
    noise = np.random.default_rng(0).uniform(0.3, 5.0, frames[1].depth.shape).astype(np.float32)
    result = slam.step(frames[1].rgb, noise)
    assert result.status == "LOST" and result.message
    np.testing.assert_array_equal(slam.scene.grids["middle"].state().features, features)


def test_bad_depth_values_never_enter_the_map(frames):
    """NaN, infinity and negative depth count as missing: all features stay finite."""
    depth = frames[0].depth.copy()
    depth[::7], depth[1::7], depth[2::7] = np.nan, np.inf, -1.0
    slam = new_slam()
    slam.step(frames[0].rgb, depth, T_world_camera=frames[0].T_world_camera)
    for grid in slam.scene.grids.values():
        assert np.isfinite(grid.state().features).all()


def test_arrays_of_any_kind_give_the_same_result(frames):
    """NumPy, torch and Warp arrays; uint8 or float colour; float or uint16 depth."""
    frame = frames[0]
    units = np.rint(frame.depth * 5000).astype(np.uint16)
    metres = units / np.float32(5000)
    floats = (frame.rgb / 255.0).astype(np.float32)
    inputs = [
        (frame.rgb, metres, None),
        (floats, metres, None),
        (torch.tensor(frame.rgb), torch.tensor(metres), None),
        (wp.array(frame.rgb, dtype=wp.uint8), wp.array(metres, dtype=float), None),
        (frame.rgb, units, 5000.0),
    ]
    images = [read_images(rgb, depth, CAMERA, 10.0, scale) for rgb, depth, scale in inputs]
    for rgb, depth in images:
        np.testing.assert_array_equal(rgb, images[0][0])
        np.testing.assert_array_equal(depth, images[0][1])


def test_misuse_is_refused(frames):
    """What no other frame would mend: no array, integer depth without a scale, a pose that is none."""
    slam, frame = new_slam(), frames[0]
    units = (frame.depth * 1000).astype(np.uint16)
    for arguments, match in [
        ({"depth": units}, "pass depth_scale"),
        ({"depth": units, "depth_scale": -1.0}, "depth_scale = -1.0"),
        ({"depth": units, "depth_scale": "mm"}, "depth_scale = 'mm'"),
        ({"rgb": frame.rgb.tolist()}, "rgb: expected .* list"),
        ({"depth": None}, "depth: expected .* NoneType"),
        ({"timestamp": "now"}, "timestamp = 'now'"),
        ({"timestamp": 0.0, "depth_timestamp": "now"}, "depth_timestamp = 'now'"),
        ({"depth_timestamp": 0.0}, "needs the timestamp"),
        ({"T_world_camera": np.zeros((4, 4))}, "rotation"),
        ({"T_world_camera": np.eye(3)}, r"shape \(3, 3\)"),
        ({"depth": np.full((60, 80, 1), 2.0, np.float32)}, r"depth has shape \(60, 80, 1\): pass \(H, W\)"),
        ({"rgb": frame.rgb.astype(np.float32)}, r"pass uint8, or float in \[0, 1\] \(rgb / 255\)"),
        ({"rgb": np.full((3, 60, 80), 90, np.uint8)}, r"which is \(3, H, W\): pass \(H, W, 3\)"),
        ({"T_world_camera": [["a"]]}, "no matrix of numbers"),
    ]:
        with pytest.raises(InputError, match=match):
            slam.step(**{"rgb": frame.rgb, "depth": frame.depth, **arguments})
    assert len(slam.trajectory.poses) == 0
    with pytest.raises(InputError, match="empty"):
        slam.render(np.eye(4))


def test_settings_that_can_not_work_are_refused(frames):
    """Edges wider than the image, and information gain without tracking, before any frame."""
    with pytest.raises(InputError, match="ignore_edge"):
        Slam(dataclasses.replace(CAMERA, width=8), Config())
    with pytest.raises(ConfigError, match="keyframes.policy"):
        new_slam("tracking.use_given_poses=true", "keyframes.policy=information_gain")


def bad_frames(frame):
    """Name of a fault, the frame that has it, and what the message says."""
    rgb, depth = frame.rgb, frame.depth
    few = np.zeros_like(depth)
    few.flat[:99] = 1.0
    return {
        "size_of_rgb": ({"rgb": rgb[:10]}, "rgb has shape"),
        "size_of_depth": ({"depth": depth[:10]}, "depth has shape"),
        "gray": ({"rgb": rgb[..., 0]}, "rgb has shape"),
        "integer_rgb": ({"rgb": rgb.astype(np.int32)}, "rgb has dtype int32"),
        "object_rgb": ({"rgb": rgb.astype(object)}, "rgb has dtype object"),
        "object_depth": ({"depth": depth.astype(object)}, "depth has dtype object"),
        "text_depth": ({"depth": np.full(depth.shape, "far")}, "depth has dtype <U3"),
        "complex_depth": ({"depth": depth.astype(complex)}, "depth has dtype complex"),
        "empty": ({"rgb": np.zeros((0, 0, 3), np.uint8)}, "rgb has shape"),
        "no_depth": ({"depth": np.zeros_like(depth)}, "fewer than 100"),
        "nan_depth": ({"depth": np.full_like(depth, np.nan)}, "fewer than 100"),
        "infinite_depth": ({"depth": np.full_like(depth, np.inf)}, "fewer than 100"),
        "negative_depth": ({"depth": -depth}, "fewer than 100"),
        "far_depth": ({"depth": np.full(depth.shape, 1e300)}, "within 10 m"),
        "little_depth": ({"depth": few}, "only 99"),
        "black": ({"rgb": np.zeros_like(rgb)}, "black"),
        "nan_rgb": ({"rgb": np.full(rgb.shape, np.nan)}, "black"),
        "over_exposed": ({"rgb": np.full_like(rgb, 255)}, "over-exposed"),
        "rgb_of_another_range": ({"rgb": 4.0 * rgb.astype(np.float32)}, r"expected \[0, 1\]"),
        "torch_type_without_numpy": ({"depth": torch.tensor(depth).bfloat16()}, "no counterpart in NumPy"),
        "sparse": ({"depth": torch.tensor(depth).to_sparse()}, "no counterpart in NumPy"),
        "time": ({"timestamp": np.nan}, "timestamp is nan"),
        "depth_time": ({"timestamp": 0.05, "depth_timestamp": 0.7}, "depth is 0.65"),
        "unknown_depth_time": ({"timestamp": 0.05, "depth_timestamp": np.nan}, "depth is nan"),
    }


@TRACKERS
def test_bad_frames_are_skipped_and_nothing_is_lost(frames, optimizer):
    """Each fault gives SKIPPED with its reason and leaves the map alone; the camera is known after them. (There are so
    many that direct tracking wants three frames more to believe where it is.)
    """
    loss = {"direct": "direct", "gauss_newton": "rendering"}[optimizer]
    tracked = f"tracking.optimizer={optimizer}", f"mapping.loss={loss}"
    good, slam = run(frames[:2], *tracked), run(frames[:2], *tracked)
    features = slam.scene.grids["middle"].state().features.copy()
    faults = bad_frames(frames[2])
    for name, (arguments, message) in faults.items():
        result = slam.step(**{"rgb": frames[2].rgb, "depth": frames[2].depth, "timestamp": 0.05, **arguments})
        assert result.status == "SKIPPED" and re.search(message, result.message), f"{name}: {result}"
        assert np.isfinite(result.timestamp)
    np.testing.assert_array_equal(slam.scene.grids["middle"].state().features, features)
    assert slam.trajectory.status == ["OK", "OK"] + ["SKIPPED"] * len(faults)
    np.testing.assert_array_equal(slam.trajectory.poses[:2], good.trajectory.poses[:2])
    if optimizer == "direct":
        for n in range(2, 5):
            result = slam.step(frames[n].rgb, frames[n].depth, frames[n].timestamp)
            assert (
                result.status == "LOST" and f"to be confirmed by the frames that follow ({n - 1} of" in result.message
            )
    last = frames[5 if optimizer == "direct" else 2]
    result = slam.step(last.rgb, last.depth, last.timestamp)
    assert result.status == "OK"
    assert np.linalg.norm(result.T_world_camera[:3, 3] - last.T_world_camera[:3, 3]) < 0.05


def test_bad_frames_before_the_first_good_one(frames):
    """The map starts with the first frame that can be used, at the pose given with it."""
    slam = new_slam()
    for arguments, _ in bad_frames(frames[0]).values():
        slam.step(**{"rgb": frames[0].rgb, "depth": frames[0].depth, **arguments})
    assert slam.scene.is_empty
    result = slam.step(frames[1].rgb, frames[1].depth, T_world_camera=frames[1].T_world_camera)
    assert result.status == "OK"
    np.testing.assert_allclose(result.T_world_camera, frames[1].T_world_camera, atol=1e-6)


def test_unknown_pose_where_one_is_needed(frames):
    """A pose of NaN skips the frame with use_given_poses, and counts as none otherwise."""
    unknown = np.full((4, 4), np.nan)
    slam = run(frames[:1], "tracking.use_given_poses=true")
    result = slam.step(frames[1].rgb, frames[1].depth, T_world_camera=unknown)
    assert result.status == "SKIPPED" and "use_given_poses" in result.message
    result = new_slam().step(frames[0].rgb, frames[0].depth, T_world_camera=unknown)
    assert result.status == "OK" and np.allclose(result.T_world_camera, np.eye(4))


def test_black_images_are_fine_where_colour_does_not_count(frames):
    """With both colour weights at zero, depth alone is tracked and mapped; direct registration needs grey values."""
    black, depth = np.zeros_like(frames[0].rgb), frames[0].depth
    weights = ("tracking.color_weight=0", "mapping.color_weight=0")
    assert new_slam(BY_RENDERING, *weights).step(black, depth).status == "OK"
    result = new_slam(*weights).step(black, depth)
    assert result.status == "SKIPPED" and "black" in result.message


@TRACKERS
def test_saved_state_goes_on_exactly(frames, tmp_path, optimizer):
    """A run that is saved, loaded and continued equals one that was never interrupted."""
    settings = (f"tracking.optimizer={optimizer}", "direct.keyframe_overlap=0.999")
    whole = run(frames[:6], *settings)
    half = run(frames[:3], *settings)
    assert len(whole.keyframes) > len(half.keyframes) > 1
    half.save(tmp_path / "map.safetensors")
    loaded = Slam.load(tmp_path / "map.safetensors", "cpu")
    for frame in frames[3:6]:
        loaded.step(frame.rgb, frame.depth, frame.timestamp)
    np.testing.assert_array_equal(loaded.trajectory.poses, whole.trajectory.poses)
    assert loaded.trajectory.status == whole.trajectory.status
    for level, grid in whole.scene.grids.items():
        np.testing.assert_array_equal(loaded.scene.grids[level].state().features, grid.state().features)


def test_unusable_map_file(frames, tmp_path):
    """Missing, truncated, or foreign: CheckpointError with the path."""
    with pytest.raises(CheckpointError, match="nothing.safetensors"):
        Slam.load(tmp_path / "nothing.safetensors")
    path = tmp_path / "map.safetensors"
    run(frames[:1]).save(path)
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(CheckpointError, match="map.safetensors"):
        Slam.load(path)
    np.savez(path, something=np.zeros(3))
    with pytest.raises(CheckpointError, match="map.safetensors"):
        Slam.load(path)


def test_a_pose_far_away_costs_one_frame():
    """A given pose 500 km away, or one from where the map has no room for what is seen, skips its frame: the map is as
    it was, and the frames after it are OK.
    """
    sequence = SyntheticSequence(1, 4, intrinsics=CAMERA)
    slam = new_slam("tracking.use_given_poses=true", "grid.max_gigabytes=1")
    frame = sequence[0]
    slam.step(frame.rgb, frame.depth, 0.0, frame.T_world_camera)
    bounds, features = slam.scene.bounds, slam.scene.grids["fine"].state().features.copy()
    for n, metres in enumerate((5e5, 1e38, 9e3)):
        frame = sequence[2]
        far = frame.T_world_camera.copy()
        far[:3, 3] += metres
        result = slam.step(frame.rgb, frame.depth, 1.0 + n, far)
        assert result.status == "SKIPPED" and "T_world_camera" in result.message
        np.testing.assert_array_equal(slam.scene.bounds, bounds)
        np.testing.assert_array_equal(slam.scene.grids["fine"].state().features, features)
    frame = sequence[2]
    assert slam.step(frame.rgb, frame.depth, 9.0, frame.T_world_camera).status == "OK"


@pytest.mark.parametrize("device", ["cuda:7", "gpu", 3, "cuda" if not wp.get_cuda_devices() else "cuda:9"])
def test_a_device_that_is_not_there_is_a_config_error(device):
    """By whatever name."""
    with pytest.raises(ConfigError, match="this machine has"):
        Slam(CAMERA, device=device)
