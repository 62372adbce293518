"""Camera paths, sequences and their export."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml
from PIL import Image

from warpslam.camera import Intrinsics
from warpslam.errors import DatasetError, InputError
from warpslam.sequences import Frame, RgbdSequence, open_sequence
from warpslam.synthetic import (
    MeshRenderer,
    SyntheticSequence,
    contact_sheet,
    hand_held,
    load_mesh,
    look_at,
    make_room,
    orbit,
    room_trajectory,
    walk,
    write_replica,
)

CAMERA = Intrinsics(50.0, 50.0, 31.5, 23.5, 64, 48)


def steps(poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance [m] and angle [deg] between successive poses."""
    moved = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    relative = poses[:-1, :3, :3].transpose(0, 2, 1) @ poses[1:, :3, :3]
    cosine = (np.trace(relative, axis1=1, axis2=2) - 1) / 2
    return moved, np.degrees(np.arccos(np.clip(cosine, -1, 1)))


@pytest.fixture(scope="module")
def sequence() -> SyntheticSequence:
    return SyntheticSequence(3, 20, intrinsics=CAMERA)


@pytest.mark.parametrize("seed", range(8))
def test_room_trajectory_is_slow_and_free(seed):
    """The eye stays 1.4-1.6 m high, clear of solids, moves about 1-2 cm and turns less than a degree per frame."""
    room = make_room(seed)
    poses = room_trajectory(room, 600, seed)
    moved, turned = steps(poses)
    assert 0.008 < moved.mean() < 0.02 and moved.max() < 0.02
    assert turned.max() < 1.0
    assert room.free_space(poses[:, :3, 3], 0.2).all()
    assert (np.abs(poses[:, 2, 3] - 1.5) <= 0.1).all()
    np.testing.assert_allclose(
        poses[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1), np.tile(np.eye(3), (600, 1, 1)), atol=1e-9
    )


def test_room_trajectory_is_smooth_and_seeded():
    """Accelerations stay far below velocities; the seed decides, and a longer path starts like a shorter one."""
    room = make_room(0)
    poses = room_trajectory(room, 200, 1)
    velocity = np.diff(poses[:, :3, 3], axis=0)
    assert np.linalg.norm(np.diff(velocity, axis=0), axis=1).max() < 0.1 * np.linalg.norm(velocity, axis=1).min()
    np.testing.assert_array_equal(poses, room_trajectory(room, 200, 1))
    np.testing.assert_allclose(poses[:50], room_trajectory(room, 50, 1))
    assert not np.allclose(poses, room_trajectory(room, 200, 2))


def test_orbit_refuses_no_frames():
    """A path needs a frame."""
    with pytest.raises(InputError, match="frame_count"):
        orbit(np.zeros(3), (1.0, 1.0), 0, turn=0.1)


def test_frames(sequence):
    """Frames have the documented types and shapes, and the exact pose."""
    frame = sequence[4]
    assert len(sequence) == 20 and frame.index == 4
    assert frame.timestamp == pytest.approx(4 / 30)
    assert frame.rgb.shape == (48, 64, 3) and frame.rgb.dtype == np.uint8
    assert frame.depth.shape == (48, 64) and frame.depth.dtype == np.float32
    assert (frame.depth > 0.2).mean() > 0.999
    np.testing.assert_array_equal(frame.T_world_camera, sequence.ground_truth()[4])
    assert sequence[-1].index == 19
    with pytest.raises(IndexError):
        sequence[20]


def test_sequences_repeat(sequence):
    """The same arguments give the same pixels, in whatever order frames are read."""
    again = SyntheticSequence(3, 20, intrinsics=CAMERA)
    again[7]
    np.testing.assert_array_equal(again[2].rgb, sequence[2].rgb)
    np.testing.assert_array_equal(again[2].depth, sequence[2].depth)


def test_noise_depends_on_the_frame_only(sequence):
    """Noise changes depth slightly, differently in each frame, and equally on every read."""
    noisy = SyntheticSequence(3, 20, intrinsics=CAMERA, noise=True)
    difference = noisy[3].depth - sequence[3].depth
    kept = noisy[3].depth > 0
    assert 0 < np.abs(difference[kept]).mean() < 0.1
    np.testing.assert_array_equal(noisy[3].depth, noisy[3].depth)
    np.testing.assert_array_equal(noisy[3].rgb, sequence[3].rgb)


def test_write_replica_round_trip(sequence, tmp_path):
    """Images, depth and poses read back from the files equal the frames, depth to half a step of 1 / 6553.5 m."""
    written: list[int] = []
    write_replica(sequence, tmp_path / "room", progress=written.append)
    folder = tmp_path / "room"
    assert written == list(range(20))
    assert len(list((folder / "results").iterdir())) == 40
    frame = sequence[6]
    np.testing.assert_array_equal(np.asarray(Image.open(folder / "results/frame000006.png")), frame.rgb)
    depth = np.asarray(Image.open(folder / "results/depth000006.png"))
    assert depth.dtype == np.uint16
    np.testing.assert_allclose(depth / 6553.5, frame.depth, atol=0.51 / 6553.5)
    poses = np.loadtxt(folder / "traj.txt").reshape(-1, 4, 4)
    np.testing.assert_array_equal(poses, sequence.ground_truth())
    camera = yaml.safe_load((folder / "camera.yaml").read_text())
    assert camera == {
        "fx": 50.0, "fy": 50.0, "cx": 31.5, "cy": 23.5, "width": 64, "height": 48, "depth_scale": 6553.5
    }  # fmt: skip
    with pytest.raises(DatasetError, match="already holds"):
        write_replica(sequence, folder)


def test_reader_reads_what_was_written(sequence, tmp_path):
    """`open_sequence` recognises the folder and returns the same frames."""
    sequences = pytest.importorskip("warpslam.sequences")
    if not hasattr(sequences, "open_sequence"):
        pytest.skip("the readers are not there")
    write_replica(sequence, tmp_path / "room")
    read = sequences.open_sequence(tmp_path / "room")
    assert len(read) == 20 and read.intrinsics == CAMERA
    np.testing.assert_array_equal(read[5].rgb, sequence[5].rgb)
    np.testing.assert_allclose(read[5].depth, sequence[5].depth, atol=1e-4)
    np.testing.assert_allclose(read[5].T_world_camera, sequence[5].T_world_camera, atol=1e-9)


class OneFrame(RgbdSequence):
    """A frame with a given depth and pose."""

    def __init__(self, depth: float, pose: np.ndarray | None) -> None:
        self.name, self.intrinsics = "one", Intrinsics(1.0, 1.0, 0.0, 0.0, 2, 2)
        self._depth, self._pose = depth, pose

    def __len__(self) -> int:
        return 1

    def __getitem__(self, index: int) -> Frame:
        depth = np.full((2, 2), self._depth, dtype=np.float32)
        return Frame(0, 0.0, np.zeros((2, 2, 3), np.uint8), depth, self._pose)


def test_write_replica_drops_far_depth_and_needs_poses(tmp_path):
    """Depth that does not fit into 16 bits becomes 0, and a frame without pose is refused."""
    write_replica(OneFrame(10.5, np.eye(4)), tmp_path / "far")
    assert (np.asarray(Image.open(tmp_path / "far/results/depth000000.png")) == 0).all()
    with pytest.raises(InputError, match="no pose"):
        write_replica(OneFrame(1.0, None), tmp_path / "lost")


def test_contact_sheet():
    """One row per room with the views and a depth image; no seed is an error."""
    sheet = contact_sheet([0, 1], views=2, intrinsics=CAMERA)
    assert sheet.shape == (2 * 48, 3 * 64, 3) and sheet.dtype == np.uint8
    assert sheet.std() > 10
    with pytest.raises(InputError, match="seed"):
        contact_sheet([])


def test_mesh_tool(tmp_path):
    """The tool renders any mesh file along the asked path, and reports a missing one."""
    tool = Path(__file__).resolve().parents[2] / "tools" / "render_mesh_sequence.py"
    mesh = tmp_path / "box.ply"
    trimesh.creation.box(extents=(6.0, 6.0, 3.0)).export(mesh)
    command = [sys.executable, str(tool), "--frames", "3", "--size", "32x24", "--room", "0.5,0", "--radius", "1.5"]
    command += ["--eye-height", "0.2", "--target-height", "0", "--out", str(tmp_path / "out")]
    done = subprocess.run([*command, "--mesh", str(mesh)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    poses = np.loadtxt(tmp_path / "out/traj.txt").reshape(-1, 4, 4)
    assert steps(poses)[0] == pytest.approx(0.013, abs=0.003)
    np.testing.assert_allclose(np.linalg.norm(poses[:, :2, 3] - [0.5, 0], axis=1), 1.5)
    command[-1] = str(tmp_path / "walk")
    through = ["--through=-1,0 1,0", "--max-depth", "2.5", "--mesh", str(mesh)]
    done = subprocess.run([*command, *through], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    poses = np.loadtxt(tmp_path / "walk/traj.txt").reshape(-1, 4, 4)
    np.testing.assert_allclose(poses[:, :3, 3], [[-1, 0, 0.2], [0, 0, 0.2], [1, 0, 0.2]], atol=1e-6)
    # The wall straight ahead is 4, 3 and 2 m away.
    centre = [np.asarray(Image.open(tmp_path / f"walk/results/depth{n:06d}.png"))[8, 16] / 6553.5 for n in range(3)]
    assert centre[:2] == [0.0, 0.0] and centre[2] == pytest.approx(2.0, abs=0.1)
    failed = subprocess.run([*command, "--mesh", str(tmp_path / "none.obj")], capture_output=True, text=True)
    assert failed.returncode == 1 and "none.obj" in failed.stderr


def test_mesh_tool_with_a_hand_held_camera(tmp_path, capsys):
    """To the end of the way at the pace of a hand; depth is a Kinect's and ends at its range, colour does not."""
    from tools import render_mesh_sequence as tool

    mesh = tmp_path / "box.ply"
    trimesh.creation.box(extents=(8.0, 8.0, 3.0)).export(mesh)
    command = ["--mesh", str(mesh), "--size", "32x24", "--eye-height", "0.2", "--through=-2,0 1,0.5 2,2"]
    assert tool.main([*command, "--out", str(tmp_path / "out"), "--hand-held", "--noise", "--depth-range", "4"]) == 0
    read = open_sequence(tmp_path / "out")
    truth = read.ground_truth()
    np.testing.assert_allclose(truth, hand_held(np.array([[-2, 0], [1, 0.5], [2, 2]]), eye_height=0.2), atol=1e-9)
    options = tool.parse_arguments([*command, "--out", "", "--hand-held"])
    exact = tool.make_sequence(options)
    assert (read[0].depth > 4.5).sum() == 0 < (exact[0].depth > 4.5).sum()
    np.testing.assert_array_equal(read[0].rgb, exact[0].rgb)
    both = (read[0].depth > 0) & (exact[0].depth < 3.5)
    assert 1e-3 < np.abs(read[0].depth - exact[0].depth)[both].mean() < 0.3
    assert tool.main(["--mesh", str(mesh), "--out", str(tmp_path / "no"), "--hand-held"]) == 1
    assert "--through" in capsys.readouterr().err


def test_house_mesh_renders(data_dir):
    """The textured house shows a dining table within 1-4 m, in many colours and without misses."""
    path = data_dir / "house_mesh" / "scene.obj"
    if not path.is_file():
        pytest.skip(f"{path} is not there")
    rgb, depth = MeshRenderer(load_mesh(path), CAMERA).render(look_at([5.1, -0.7, 1.4], [6.6, 1.1, 0.65]))
    assert (depth > 0).mean() > 0.999
    assert 1 < np.median(depth) < 4
    assert len(np.unique(rgb.reshape(-1, 3), axis=0)) > 300


def test_walk_goes_through_its_points():
    """Steady steps at the given height, close by every waypoint, looking ahead and a little down."""
    waypoints = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 3.0], [5.0, 3.5]])
    poses = walk(waypoints, 200, eye_height=1.4)
    moved, turned = steps(poses)
    np.testing.assert_allclose(moved, moved.mean(), rtol=0.03)
    assert turned.max() < 4.0
    np.testing.assert_allclose(poses[:, 2, 3], 1.4)
    for point in waypoints:
        assert np.linalg.norm(poses[:, :2, 3] - point, axis=1).min() < 0.05
    np.testing.assert_allclose(poses[[0, -1], :2, 3], waypoints[[0, -1]], atol=1e-9)
    forward = poses[:-10, :3, 2]
    ahead = np.diff(poses[:, :3, 3], axis=0)[:190]
    cosine = np.sum(forward * ahead, axis=1) / np.linalg.norm(ahead, axis=1)
    # Into a bend it looks before it goes.
    assert cosine.min() > 0.4 and np.median(cosine) > 0.9
    assert (forward[:, 2] < 0).all() and forward[:, 2].min() > -0.3


@pytest.mark.parametrize(("waypoints", "frames"), [([[0, 0]], 5), ([[0, 0], [0, 0]], 5), ([[0, 0], [1, 0]], 0)])
def test_a_walk_needs_a_way(waypoints, frames):
    """One point, no distance, or no frame."""
    with pytest.raises(InputError, match="waypoints"):
        walk(np.array(waypoints), frames)
