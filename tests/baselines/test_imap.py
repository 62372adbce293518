"""iMAP* as a method: it learns a small scene, tracks in it, repeats bit by bit, and comes back from a file."""

from __future__ import annotations

import numpy as np
import pytest

from tests.fakes import run_sequence
from warpslam.baselines.imap import Imap
from warpslam.camera import Intrinsics
from warpslam.config import PRESETS, Config
from warpslam.errors import CheckpointError, ConfigError, InputError
from warpslam.evaluation import psnr
from warpslam.pipeline.finished import extract_mesh
from warpslam.pipeline.setup import load_slam
from warpslam.runs.folder import RunFolder
from warpslam.slam_state import saved_config
from warpslam.storage.state_file import read_state, write_state
from warpslam.trajectory import FrameHistory, Located

CAMERA = Intrinsics(40.0, 40.0, 31.5, 23.5, 64, 48)
SMALL = [
    "tracking.ignore_edge_u=2", "tracking.ignore_edge_v=2", "sampling.stratified=16", "imap.importance=8",
    "imap.empty_samples=4", "imap.mapping_pixels=48", "imap.tracking_pixels=48", "imap.first_iterations=60",
    "imap.mapping_rate=2e-3", "imap.iterations=4", "imap.tracking_iterations=4", "imap.refinement_rounds=1",
    "keyframes.every=3",
]  # fmt: skip


def corner(index: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Colour, depth and pose of a camera moving along x in front of a wall that recedes to one side."""
    x0 = 0.01 * index
    u, _ = np.meshgrid(np.arange(64), np.arange(48))
    ray = (u - CAMERA.cx) / CAMERA.fx
    # The wall is z = 2 + 0.5 x in the world.
    depth = (2.0 + 0.5 * x0) / (1.0 - 0.5 * ray)
    x = x0 + ray * depth
    rgb = np.stack([0.3 + 0.4 * (x > 0), 0.5 + 0 * x, 0.7 - 0.2 * np.tanh(x)], axis=-1)
    pose = np.eye(4)
    pose[0, 3] = x0
    return (255 * rgb).astype(np.uint8), depth.astype(np.float32), pose


def run(frames: int, *overrides: str, seed: int = 0) -> Imap:
    method = Imap(CAMERA, Config.from_preset(overrides=[*SMALL, *overrides]), "cpu", seed)
    for index in range(frames):
        rgb, depth, pose = corner(index)
        method.step(rgb, depth, T_world_camera=pose if index == 0 else None)
    return method


@pytest.fixture(scope="module")
def trained() -> Imap:
    """One frame, well learnt, with two slices on any machine."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("warpslam.runtime.cores._core_count", lambda: 2)
        return run(1, "imap.first_iterations=200")


def test_it_learns_a_frame(trained):
    """Guided and unguided views show depth and colour of what was seen, in metres."""
    rgb, depth, pose = corner()
    for guide in (None, depth):
        view = trained.render(pose, stride=2, depth=guide)
        assert view.depth.shape == (24, 32) and view.rgb.shape == (24, 32, 3)
        assert np.median(np.abs(view.depth - depth[::2, ::2])) < 0.15
        assert psnr(view.rgb, rgb[::2, ::2]) > 18
    assert trained.map_bytes == 4 * 222_747 and trained.flops_per_point == 443_908


def test_density_lies_at_the_surface(trained):
    """Half way to the wall there is less density than on it."""
    _, depth, _ = corner()
    rays = np.column_stack([(np.arange(8, 56, 4) - CAMERA.cx) / CAMERA.fx, np.zeros(12), np.ones(12)])
    z = depth[24, 8:56:4][:, None]
    free, wall = trained.query_occupancy(0.5 * z * rays), trained.query_occupancy(1.03 * z * rays)
    assert np.median(wall) > 5.0 and np.median(free) < 0.5 * np.median(wall)
    assert trained.query_color(z * rays).shape == (12, 3) and len(trained.query_occupancy(np.zeros((0, 3)))) == 0


def test_tracking_follows_a_moved_camera(trained):
    """From 4 cm aside, tracking brings the loss and the error down; the map is not changed by it."""
    rgb, depth, pose = corner(0)
    before = trained.network.weights.numpy().copy()
    start = trained._scaled(np.array([1.0, 0, 0, 0, 0.0, 0.0, 0.08]))
    trained._images.set(0, rgb, depth * np.float32(trained._settings.scale))
    before_it, loss_before = trained._judge(1, start)
    history, trained.history = trained.history, FrameHistory()
    aside = np.eye(4)
    aside[2, 3] = 0.08
    trained.history.add(0.0, Located(aside))
    try:
        located, loss = trained._track(1)
    finally:
        trained.history = history
    assert loss < loss_before and located.depth_error < before_it.depth_error and located.inliers > 0.9
    assert abs(located.T_world_camera[2, 3]) < 0.078
    np.testing.assert_array_equal(trained.network.weights.numpy(), before)


def test_runs_repeat():
    """Same input and seed, same bytes of network and trajectory; another seed, another network."""
    short = ("imap.first_iterations=8", "imap.rounds=2", "keyframes.every=3")
    runs = [run(7, *short), run(7, *short), run(7, *short, seed=1)]
    for method in runs:
        assert method.finish().keys() == {"mapping", "refinement"}
    a, b, other = (method.network.weights.numpy() for method in runs)
    np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(runs[0].trajectory.poses, runs[1].trajectory.poses)
    assert not np.array_equal(a, other)
    assert [keyframe.index for keyframe in runs[0].keyframes] == [0, 3, 6]
    assert np.isfinite(runs[0].trajectory.poses).all() and runs[0].trajectory.status == ["OK"] * 7


def test_mapping_changes_the_network_on_every_fifth_frame():
    """Frames in between are tracked only."""
    method = run(5, "imap.first_iterations=8")
    before = method.network.weights.numpy().copy()
    rgb, depth, _ = corner(5)
    result = method.step(rgb, depth)
    assert set(result.losses) == {"tracking", "mapping"} and set(result.timings) == {"tracking", "mapping"}
    assert not np.array_equal(method.network.weights.numpy(), before)
    after = method.network.weights.numpy().copy()
    rgb, depth, _ = corner(6)
    assert set(method.step(rgb, depth).losses) == {"tracking"}
    np.testing.assert_array_equal(method.network.weights.numpy(), after)


def test_given_poses_are_taken(trained):
    """With given poses nothing is tracked, and a missing one is an error."""
    method = run(0, "tracking.use_given_poses=true", "imap.first_iterations=2")
    rgb, depth, pose = corner(4)
    assert method.step(rgb, depth, T_world_camera=pose).T_world_camera[0, 3] == pytest.approx(0.04)
    with pytest.raises(InputError, match="use_given_poses"):
        method.step(rgb, depth)


def test_save_and_load(trained, tmp_path):
    """A map read back renders the same view; a damaged or foreign file is refused."""
    trained.save(tmp_path / "map.safetensors")
    again = Imap.load(tmp_path / "map.safetensors", "cpu")
    _, _, pose = corner()
    a, b = trained.render(pose, stride=4), again.render(pose, stride=4)
    np.testing.assert_array_equal(a.depth, b.depth)
    np.testing.assert_array_equal(a.rgb, b.rgb)
    assert again.config.imap.mapping_pixels == 48
    (tmp_path / "bad.safetensors").write_bytes((tmp_path / "map.safetensors").read_bytes()[:500])
    np.savez(tmp_path / "other.npz", header=np.frombuffer(b'{"format": "x"}', np.uint8))
    for name in ("bad.safetensors", "none.safetensors", "other.npz"):
        with pytest.raises(CheckpointError, match=name):
            Imap.load(tmp_path / name)
    header, arrays = read_state(tmp_path / "map.safetensors", Imap.form)
    for name, array in arrays.items():
        write_state(tmp_path / "bad.safetensors", Imap.form, header, {**arrays, name: array[None]})
        with pytest.raises(CheckpointError, match=name):
            Imap.load(tmp_path / "bad.safetensors", "cpu")


def test_a_network_that_saw_nothing_can_be_saved(tmp_path):
    """Without a frame there is no bound; what comes back takes its first frame."""
    run(0).save(tmp_path / "map.safetensors")
    again = Imap.load(tmp_path / "map.safetensors", "cpu")
    assert not np.isfinite(again.bounds).any() and len(again.trajectory.poses) == 0
    rgb, depth, pose = corner()
    assert again.step(rgb, depth, T_world_camera=pose).status == "OK"


def test_nothing_is_rendered_before_the_first_frame():
    """An empty map says so, and frames without depth are skipped."""
    method = run(0)
    with pytest.raises(InputError, match="empty"):
        method.render(np.eye(4))
    assert method.finish() == {}
    assert method.step(np.zeros((48, 64, 3), np.uint8), np.zeros((48, 64))).status == "SKIPPED"


def test_a_run_writes_its_folder(tmp_path):
    """The same pipeline: trajectory, map, metrics; the map is found again by its method."""
    from warpslam.synthetic import SyntheticSequence

    sequence = SyntheticSequence(0, 2, intrinsics=CAMERA.strided(2))
    config = Config.from_preset(overrides=[*SMALL, "imap.first_iterations=5", "imap.rounds=1", "meshing.voxel=0.2"])
    result = run_sequence(sequence, config, tmp_path, method="imap", device="cpu")
    assert result.status == "finished" and result.metrics.method == "imap"
    assert result.metrics.to_dict()["map"] == {"bytes": 890_988, "flops_per_point": 443_908}
    assert result.ate is not None and result.metrics.rendering.depth_l1_m > 0
    folder = RunFolder.open(tmp_path)
    loaded = load_slam(folder)
    assert isinstance(loaded, Imap) and len(loaded.trajectory.poses) == 2
    with pytest.raises(ConfigError, match="method imap has no refinement"):
        extract_mesh(folder, refinement_rounds=1)
    with pytest.raises(ConfigError, match="method imap forecasts nothing"):
        extract_mesh(folder, forecast=True)
    with pytest.raises(CheckpointError, match="'warpslam-imap'.*--method nice-slam"):
        saved_config(folder.map)
    assert not folder.forecast_mesh.exists()


def test_the_released_settings_are_a_preset():
    """Ray and iteration counts of the released code, by name."""
    config = Config.from_preset("paper_imap")
    assert "paper_imap" in PRESETS
    assert (config.imap.mapping_pixels, config.imap.first_iterations, config.imap.iterations) == (5000, 1500, 100)
    assert (config.imap.tracking_pixels, config.imap.tracking_iterations) == (5000, 50)
    assert (config.imap.mapping_rate, config.imap.tracking_rate, config.imap.color_weight) == (2e-4, 5e-4, 0.05)
