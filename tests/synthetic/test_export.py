"""``warpslam render-room`` and the folders it writes."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from PIL import Image

from warpslam import cli, open_sequence
from warpslam.errors import ConfigError
from warpslam.synthetic import MovingObjectSequence, altered, make_sequence


def written(tmp_path, *arguments: str):
    """Folder of a sequence written by the command, in small."""
    folder = tmp_path / "out"
    assert cli.main(["render-room", "sequence", "--out", str(folder), "--size", "64x48", *arguments]) == 0
    return folder


def test_moving_sequence_with_truth(tmp_path, capsys):
    """Frames open as a dataset; masks, the object, its poses and the room's surface lie beside them."""
    folder = written(tmp_path, "--kind", "moving", "--frames", "10", "--seed", "3")
    read = open_sequence(folder)
    made = MovingObjectSequence(3, 10, intrinsics=read.intrinsics, path_seed=3, object_seed=3)
    assert len(read) == 10
    np.testing.assert_array_equal(read[4].rgb, made[4].rgb)
    mask = np.asarray(Image.open(folder / "masks/mask000004.png"))
    np.testing.assert_array_equal(mask == 255, made.object_mask(4))
    np.testing.assert_allclose(np.loadtxt(folder / "object_poses.txt").reshape(-1, 4, 4), made.object_poses)
    assert len(trimesh.load(folder / "object.ply").faces) == len(made.object_mesh.faces)
    assert len(trimesh.load(folder / "mesh.ply").faces) == len(made.mesh.faces)
    assert f"warpslam run {folder} --preset default" in capsys.readouterr().out


@pytest.mark.parametrize(("gap", "count"), [("black", 20), ("absent", 10)])
def test_gap_sequence_with_truth(tmp_path, gap, count):
    """The middle half is black or absent, times say so, and lost.txt marks the black frames."""
    folder = written(tmp_path, "--kind", "gap", "--frames", "20", "--gap", gap)
    read = open_sequence(folder)
    times, lost = np.loadtxt(folder / "timestamps.txt"), np.loadtxt(folder / "lost.txt")
    assert len(read) == len(times) == len(lost) == count
    assert np.diff(times).max() == pytest.approx(1 / 30 if gap == "black" else 11 / 30)
    assert lost.sum() == (10 if gap == "black" else 0)
    assert [not read[index].depth.any() for index in range(count)] == lost.astype(bool).tolist()


def test_room_sequence(tmp_path):
    """The plain kind is the room walked through."""
    folder = written(tmp_path, "--frames", "3")
    assert len(open_sequence(folder)) == 3 and not (folder / "masks").exists()


def test_hard_scene_with_something_wrong(tmp_path):
    """A named scene with changes is written as it is made, with its surface and its times."""
    folder = written(tmp_path, "--kind", "posters", "--frames", "24", "--with", "hand", "exposure")
    read = open_sequence(folder)
    made = altered(make_sequence("posters", 0, 24, intrinsics=read.intrinsics), ["hand", "exposure"])
    np.testing.assert_array_equal(read[13].rgb, made[13].rgb)
    assert len(trimesh.load(folder / "mesh.ply").faces) == len(made.mesh.faces)
    assert len(np.loadtxt(folder / "timestamps.txt")) == 24


def test_sheet(tmp_path):
    """A picture of the rooms that are asked for."""
    assert cli.main(["render-room", "sheet", "--seeds", "0", "--views", "1", "--out", str(tmp_path / "rooms.png")]) == 0
    assert Image.open(tmp_path / "rooms.png").width > 100


def test_errors(tmp_path, capsys):
    """What can be put right is one line and exit code 2; an unknown kind names the known ones."""
    assert cli.main(["render-room", "sequence", "--kind", "gap", "--frames", "2", "--out", str(tmp_path / "a")]) == 2
    assert capsys.readouterr().err.startswith("warpslam: a gap of")
    with pytest.raises(ConfigError, match="room, moving, gap, corridor, cabinet, posters"):
        make_sequence("flying")
