"""TSDF fusion: a wall comes out where it is, in its colour; memory, saving, and what is missing."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from tests.fakes import run_sequence
from warpslam.baselines.tsdf import BLOCK_VOXELS, Tsdf, import_open3d
from warpslam.camera import Intrinsics
from warpslam.config import Config
from warpslam.errors import CheckpointError, ConfigError, InputError, MeshError, MissingDependencyError
from warpslam.pipeline.finished import extract_mesh
from warpslam.pipeline.setup import load_slam
from warpslam.poses import pose_from_vector
from warpslam.runs.folder import RunFolder
from warpslam.storage.json_files import read_json
from warpslam.storage.state_file import read_state, write_state

CAMERA = Intrinsics(80.0, 80.0, 63.5, 47.5, 128, 96)
RGB = (200, 100, 50)


@pytest.fixture(autouse=True)
def _open3d(request) -> None:
    """Skips where Open3D can't be loaded, unless the test is about that."""
    if "without_open3d" in request.keywords:
        return
    try:
        import_open3d()
    except MissingDependencyError as error:
        pytest.skip(str(error))


def wall_images(distance: float = 2.0) -> tuple[np.ndarray, np.ndarray]:
    """Colour and depth of a wall straight ahead."""
    rgb = np.tile(np.array(RGB, np.uint8), (CAMERA.height, CAMERA.width, 1))
    return rgb, np.full((CAMERA.height, CAMERA.width), distance, np.float32)


@pytest.fixture
def wall() -> Tsdf:
    """A wall at z = 2 m, seen from three places along x."""
    tsdf = Tsdf(CAMERA)
    for x in (0.0, 0.1, 0.2):
        pose = np.eye(4)
        pose[0, 3] = x
        assert tsdf.step(*wall_images(), T_world_camera=pose).status == "OK"
    return tsdf


def test_the_mesh_is_the_wall(wall):
    """Vertices lie on the wall, its front faces the camera, and it has the wall's colour."""
    mesh = wall.mesh()
    np.testing.assert_allclose(mesh.vertices[:, 2], 2.0, atol=2e-3)
    assert mesh.face_normals[:, 2].mean() < -0.99
    assert np.abs(np.median(mesh.visual.vertex_colors[:, :3], axis=0) - RGB).max() <= 2
    assert np.ptp(mesh.vertices[:, 0]) > 2.9


def test_a_view_has_the_depth_along_z(wall):
    """Rendered depth is z-depth, at any stride, also from a turned camera; nothing is hit beside the wall."""
    view = wall.render(np.eye(4), stride=2)
    assert view.depth.shape == (48, 64) and view.rgb.shape == (48, 64, 3)
    np.testing.assert_allclose(view.depth[4:-4, 4:-4], 2.0, atol=2e-3)
    np.testing.assert_allclose(view.rgb[24, 32] * 255, RGB, atol=2)
    # Turned by 0.4 rad about y, the ray of the middle column meets the wall at z-depth 2 / cos(0.4).
    turned = wall.render(pose_from_vector(np.array([np.cos(0.2), 0, np.sin(0.2), 0, 0, 0, 0])))
    assert turned.depth[48, 63] == pytest.approx(2.0 / np.cos(0.4), abs=0.01)
    behind = wall.render(pose_from_vector(np.array([0.0, 0, 1, 0, 0, 0, 0])))
    assert not behind.depth.any() and not behind.rgb.any()


def test_memory_is_that_of_the_allocated_blocks(wall):
    """12 bytes a voxel of the blocks along the wall, and more once more is seen."""
    block = BLOCK_VOXELS * wall.config.tsdf.voxel
    width, height = (CAMERA.width / CAMERA.fx * 2 + 0.2) / block, CAMERA.height / CAMERA.fy * 2 / block
    assert width * height <= wall.block_count <= 3 * (width + 2) * (height + 2)
    assert wall.map_bytes == wall.block_count * 16**3 * 12
    attributes = (wall._grid.attribute(name) for name in ("tsdf", "weight", "color"))
    assert sum(int(np.prod(tuple(a.shape)[1:])) * a.dtype.byte_size() for a in attributes) == 16**3 * 12
    before = wall.map_bytes
    wall.step(*wall_images(3.0), T_world_camera=np.eye(4))
    assert wall.map_bytes > 1.5 * before


def test_frames_without_a_pose_are_skipped():
    """Fusion can't track: such frames change nothing and say why."""
    tsdf = Tsdf(CAMERA)
    result = tsdf.step(*wall_images())
    assert result.status == "SKIPPED" and "no pose" in result.message and tsdf.block_count == 0
    assert tsdf.trajectory.status == ["SKIPPED"]
    with pytest.raises(MeshError, match="empty"):
        tsdf.mesh()
    with pytest.raises(InputError, match="empty"):
        tsdf.render(np.eye(4))


def test_save_and_load(wall, tmp_path):
    """What was saved is read back: same mesh, same trajectory, and fusion goes on."""
    wall.save(tmp_path / "map.safetensors")
    again = Tsdf.load(tmp_path / "map.safetensors")
    assert again.map_bytes == wall.map_bytes and again.config == wall.config
    np.testing.assert_array_equal(again.trajectory.poses, wall.trajectory.poses)
    a, b = wall.mesh(), again.mesh()
    assert len(a.faces) == len(b.faces)
    np.testing.assert_allclose(np.sort(a.vertices[:, 0]), np.sort(b.vertices[:, 0]), atol=1e-6)
    assert again.step(*wall_images(), T_world_camera=np.eye(4)).index == 3
    (tmp_path / "bad.safetensors").write_bytes((tmp_path / "map.safetensors").read_bytes()[:300])
    for name in ("bad.safetensors", "none.safetensors"):
        with pytest.raises(CheckpointError, match=name):
            Tsdf.load(tmp_path / name)
    header, arrays = read_state(tmp_path / "map.safetensors", Tsdf.form)
    for name, array in arrays.items():
        write_state(tmp_path / "bad.safetensors", Tsdf.form, header, {**arrays, name: array[None]})
        with pytest.raises(CheckpointError, match=name):
            Tsdf.load(tmp_path / "bad.safetensors")


def test_settings_reach_the_volume():
    """The voxel size is that of the settings, and a mesh has no other."""
    tsdf = Tsdf(CAMERA, Config.from_preset(overrides=["tsdf.voxel=0.05", "tsdf.min_weight=2"]))
    tsdf.step(*wall_images(), T_world_camera=np.eye(4))
    with pytest.raises(MeshError, match="tsdf.min_weight"):
        tsdf.mesh()
    tsdf.step(*wall_images(), T_world_camera=np.eye(4))
    edges = tsdf.mesh().edges_unique_length
    assert 0.04 < np.median(edges) < 0.08
    with pytest.raises(InputError, match="tsdf.voxel"):
        tsdf.mesh(voxel=0.01)


@pytest.mark.without_open3d
def test_a_missing_package_is_named_with_what_to_type(monkeypatch):
    """Without Open3D the error says how to get it, and which libraries it wants."""
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(MissingDependencyError, match=r"pip install open3d.*libusb-1.0-0 libgl1 libegl1"):
        Tsdf(CAMERA)


def test_a_run_with_the_poses_of_an_earlier_one(tmp_path):
    """The same pipeline, metrics and folder; poses come from a file, and errors are against the sequence's truth."""
    from warpslam.storage.tum import read_tum, write_tum
    from warpslam.synthetic import SyntheticSequence

    sequence = SyntheticSequence(0, 6, intrinsics=Intrinsics(62.5, 62.5, 39.5, 29.5, 80, 60))
    config = Config.from_preset(overrides=["tracking.ignore_edge_u=2", "tracking.ignore_edge_v=2"])
    result = run_sequence(sequence, config, tmp_path / "a", method="tsdf", truth_mesh=sequence.mesh)
    assert result.status == "finished" and result.metrics.method == "tsdf"
    assert result.ate.rmse < 1e-9 and result.reconstruction.accuracy < 0.05
    assert result.metrics.map.bytes > 1e6 and result.metrics.map.flops_per_point is None
    assert result.metrics.rendering.psnr_db > 15
    # The second run gets poses 10 cm off, and none for the last two frames.
    times, poses = read_tum(result.folder.trajectory)
    poses[:, 0, 3] += 0.1
    write_tum(tmp_path / "given.tum", times[:4], poses[:4])
    shifted = run_sequence(sequence, config, tmp_path / "b", method="tsdf", poses=str(tmp_path / "given.tum"))
    assert shifted.metrics.frames.processed == 4 and shifted.metrics.frames.unreadable == 2
    assert read_json(shifted.folder.metrics)["ate_m"]["unaligned"]["rmse"] == pytest.approx(0.1, abs=1e-6)
    folder = RunFolder.open(tmp_path / "b")
    loaded = load_slam(folder)
    assert isinstance(loaded, Tsdf) and len(loaded.trajectory.poses) == 4
    with pytest.raises(ConfigError, match="method tsdf has no refinement"):
        extract_mesh(folder, refinement_rounds=1)
    with pytest.raises(ConfigError, match="method tsdf forecasts nothing"):
        extract_mesh(folder, forecast=True)
