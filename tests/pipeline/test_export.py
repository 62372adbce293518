"""What a finished run gives to other tools: trajectories, images, films."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from tests.sequences.recordings import CAMERA, room, write_own
from warpslam import cli
from warpslam.camera import Intrinsics
from warpslam.config import Config
from warpslam.errors import ConfigError, InputError
from warpslam.frames import FrameStatus
from warpslam.pipeline.film import orbit
from warpslam.poses import pose_from_vector
from warpslam.runs.folder import RunFolder
from warpslam.runs.given_poses import GivenPoses
from warpslam.runs.metrics import RunMetrics
from warpslam.runs.request import Source
from warpslam.sequences import open_sequence
from warpslam.storage.trajectory_files import Views, write_trajectory
from warpslam.storage.tum import write_tum
from warpslam.synthetic import SyntheticSequence
from warpslam.trajectory import Trajectory

USED = [0, 2, 4, 6, 8]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run folder over every second of the first frames of a room, as a run leaves it."""
    base, source = tmp_path_factory.mktemp("export"), room()
    sequence = write_own(base / "room", source, scale=5000)
    folder = RunFolder.create(base / "run", "room")
    folder.write_source(Source(str(sequence)))
    Config().save(folder.config)
    RunMetrics().write(folder.metrics)
    write_tum(folder.trajectory, np.array(USED) / 30, source.poses[USED])
    folder.timing.write_text(json.dumps({"frames": [{"index": index} for index in USED]}))
    SyntheticSequence(1, 2, intrinsics=CAMERA, device="cpu").mesh.export(folder.mesh)
    return folder


def test_text_formats(tmp_path):
    """KITTI and EuRoC say what was written, to the nanosecond and the nanometre."""
    poses, times = room().poses[:3].copy(), 1_403_636_579.763555527 + np.arange(3) / 20
    poses[1] = np.nan
    rows = np.loadtxt(write_trajectory(tmp_path / "k.txt", Views(times, poses), "kitti"))
    np.testing.assert_allclose(rows.reshape(3, 3, 4), poses[:, :3], atol=1e-8)
    rows = np.loadtxt(write_trajectory(tmp_path / "e.csv", Views(times, poses), "euroc"), delimiter=",")
    assert rows.shape == (2, 8)
    np.testing.assert_allclose(rows[:, 0] * 1e-9, times[[0, 2]], atol=1e-6)
    for row, pose in zip(rows, poses[[0, 2]], strict=True):
        np.testing.assert_allclose(pose_from_vector(row[[4, 5, 6, 7, 1, 2, 3]]), pose, atol=1e-7)
    with pytest.raises(ConfigError, match="colmap holds the camera"):
        write_trajectory(tmp_path / "c", Views(times, poses), "colmap")
    with pytest.raises(ConfigError, match="'bvh' is unknown; choose one of tum, kitti"):
        write_trajectory(tmp_path / "c", Views(times, poses), "bvh")


def test_a_trajectory_saves_itself(tmp_path):
    """Frames that are not OK are left out, but of KITTI, which counts lines."""
    poses = room().poses[:3]
    trajectory = Trajectory(np.arange(3) / 30, poses, [FrameStatus.OK, FrameStatus.LOST, FrameStatus.OK])
    given = GivenPoses.read(trajectory.save(tmp_path / "a.tum"))
    np.testing.assert_allclose(given.poses, poses[[0, 2]], atol=1e-8)
    np.testing.assert_allclose(GivenPoses.read(trajectory.save(tmp_path / "a.txt", "kitti")).poses, poses, atol=1e-8)
    assert len(json.loads(trajectory.save(tmp_path / "t.json", "transforms", CAMERA).read_text())["frames"]) == 2


def test_transforms_come_back(run, tmp_path):
    """What is written for nerfstudio is read by our own reader: frames, depth, poses, camera, times."""
    assert cli.main(["export", str(run.path), "transforms", "-o", str(tmp_path / "t")]) == 0
    sequence, source = open_sequence(tmp_path / "t"), room()
    assert sequence.intrinsics == CAMERA and len(sequence) == len(USED)
    for frame, index in zip(sequence, USED, strict=True):
        np.testing.assert_array_equal(frame.rgb, source.rgb[index])
        np.testing.assert_allclose(frame.depth, source.depth[index], atol=6e-4)
        np.testing.assert_allclose(frame.T_world_camera, source.poses[index], atol=1e-6)
        assert frame.timestamp == pytest.approx(index / 30)


def test_colmap(run, tmp_path):
    """World to camera, w first, and a camera whose origin is the corner of a pixel."""
    assert cli.main(["export", str(run.path), "colmap", "-o", str(tmp_path / "c")]) == 0
    model = tmp_path / "c/sparse/0"
    camera = (model / "cameras.txt").read_text().split()
    assert camera[:4] == ["1", "PINHOLE", "80", "60"] and [float(x) for x in camera[4:]] == [60, 60, 40, 30]
    lines = [line.split() for line in (model / "images.txt").read_text().splitlines() if not line.startswith("#")]
    first = lines[2]
    assert first[9] == "images/000002.png" and (tmp_path / "c" / first[9]).is_file()
    T_camera_world = pose_from_vector(np.array([float(x) for x in first[1:8]]))
    np.testing.assert_allclose(np.linalg.inv(T_camera_world), room().poses[2], atol=1e-6)


def test_text_formats_by_command(run, tmp_path, capsys):
    """The default place is the run folder."""
    for kind in ("tum", "kitti", "euroc"):
        assert cli.main(["export", str(run.path), kind]) == 0
        path = capsys.readouterr().out.strip()
        assert path.startswith(str(run.path)) and len(open(path).read()) > 100
    with pytest.raises(SystemExit):
        cli.main(["export", str(run.path), "bvh"])
    assert "transforms" in capsys.readouterr().err


def test_orbit_looks_at_the_scene():
    """All views look at the middle, are upright, and none is nearer than the scene is large."""
    mesh = SyntheticSequence(1, 2, intrinsics=CAMERA, device="cpu").mesh
    up = np.array([0.0, 0.0, 1.0])
    poses = orbit(mesh, up, CAMERA, 12)
    low, high = np.quantile(mesh.vertices, (0.02, 0.98), axis=0)
    centre = (low + high) / 2
    for T in poses:
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(T[:3, :3]) == pytest.approx(1)
        along = np.linalg.inv(T) @ [*centre, 1]
        np.testing.assert_allclose(along[:2], 0, atol=1e-9)
        assert along[2] > np.linalg.norm(high - low) / 2 and T[:3, 1] @ up < -0.5
    angles = np.degrees(
        np.arccos(np.clip(np.einsum("ni,ni->n", poses[:, :3, 2], np.roll(poses[:, :3, 2], 1, 0)), -1, 1))
    )
    np.testing.assert_allclose(angles, angles[0], atol=1e-6)


def test_film_of_an_orbit(run, tmp_path):
    """A film of the size and length asked for, in which something moves."""
    film = tmp_path / "film.avi"
    command = ["render", str(run.path), "--path", "orbit", "--size", "96x64", "--views", "5", "--device", "cpu"]
    assert cli.main([*command, "-o", str(film)]) == 0
    video = cv2.VideoCapture(str(film))
    frames = [video.read()[1] for _ in range(5)]
    assert not video.read()[0] and frames[0].shape == (64, 96, 3)
    assert np.abs(frames[0].astype(int) - frames[2]).mean() > 2


def test_views_along_the_own_path(run, tmp_path):
    """Arrays and images of the mesh at the run's poses agree with what the camera measured; the mask says where."""
    command = ["render", str(run.path), "--path", "trajectory", "--size", "80x60", "--device", "cpu"]
    across = str(np.degrees(2 * np.arctan(80 / (2 * 60.0))))
    for output in ("views.npz", "views"):
        assert cli.main([*command, "--fov", across, "-o", str(tmp_path / output)]) == 0
    arrays = np.load(tmp_path / "views.npz")
    assert arrays["rgb"].shape == (5, 60, 80, 3) and arrays["camera"][0, 0] == pytest.approx(60)
    assert np.median(np.abs(arrays["depth"] - room().depth[USED])) < 0.01
    np.testing.assert_array_equal(arrays["mask"] > 0, arrays["depth"] > 0)
    depth = cv2.imread(str(tmp_path / "views/000003_depth.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_allclose(depth / 1000, arrays["depth"][3], atol=6e-4)
    assert (cv2.imread(str(tmp_path / "views/000003_mask.png"), 0) == arrays["mask"][3]).all()


def test_views_along_a_file(run, tmp_path):
    """Another path, past the end of the scene: there the mask is empty and the picture grey."""
    T = room().poses[0].copy()
    T[:3, 3] += 1000
    np.savetxt(tmp_path / "far.txt", T.reshape(1, 16))
    output = tmp_path / "far.npz"
    command = ["render", str(run.path), "--path", str(tmp_path / "far.txt"), "--size", "32x32", "-o", str(output)]
    assert cli.main([*command, "--device", "cpu"]) == 0
    arrays = np.load(output)
    assert not arrays["mask"].any() and (arrays["rgb"] == 235).all()
    assert cli.main(["render", str(run.path), "--path", "orbit", "--size", "4x4", "--device", "cpu"]) == 2


def test_intrinsics_from_a_matrix():
    """What is no pinhole matrix is refused, with the reason."""
    assert Intrinsics.from_matrix(CAMERA.matrix, 80, 60) == CAMERA
    assert Intrinsics.from_matrix(2 * CAMERA.matrix, 80, 60) == CAMERA
    for K, pattern in (
        (CAMERA.matrix.T, "transposed"), (np.eye(4), r"shape \(4, 4\)"), (CAMERA.matrix + np.eye(3, k=1) * 5, "skew"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=pattern):
            Intrinsics.from_matrix(K, 80, 60)
