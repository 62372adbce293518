"""What is wrong with a sequence is said with the file, the field and what to do."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.sequences import writers
from warpslam.errors import DatasetError
from warpslam.sequences import DATASETS, guess_dataset, open_sequence


def refuse(folder: Path, *patterns: str, **arguments) -> str:
    """Open the sequence, expect a DatasetError whose message matches every pattern, return the message."""
    with pytest.raises(DatasetError) as caught:
        open_sequence(folder, **arguments)
    for pattern in patterns:
        assert re.search(pattern, str(caught.value)), f"{pattern!r} not in {caught.value}"
    return str(caught.value)


def test_missing_folder(tmp_path):
    """A path that does not exist, and one that is a file."""
    refuse(tmp_path / "nowhere", "nowhere: no such folder")
    with pytest.raises(DatasetError, match="dataset = None must be the name of a format"):
        open_sequence(tmp_path, None)
    (tmp_path / "file").write_text("what is in it")
    refuse(tmp_path / "file", "is a file; pass the folder")


def test_unknown_dataset(tmp_path):
    """An unknown format name lists the known ones."""
    refuse(tmp_path, "kitti", *DATASETS, dataset="kitti")


@pytest.mark.parametrize("dataset", DATASETS)
def test_empty_folder(tmp_path, dataset):
    """Every reader names what it misses in an empty folder."""
    refuse(tmp_path, re.escape(str(tmp_path)), "no such folder|no images|can't be read", dataset=dataset)


def test_no_images(tmp_path):
    """A results folder without frames."""
    (tmp_path / "results").mkdir()
    refuse(tmp_path, r"results: no images \(frame\*\.png", dataset="replica")


@pytest.mark.parametrize("dataset", ["replica", "scannet", "seven_scenes", "icl", "azure"])
def test_unequal_counts(tmp_path, dataset):
    """A colour image without depth is left out and named; the others keep their partners and poses."""
    if dataset == "replica":
        writers.write_replica(tmp_path)
        victim = tmp_path / "results" / "depth000001.png"
    elif dataset == "scannet":
        writers.write_scannet(tmp_path)
        victim = tmp_path / "frames/depth/2.png"
    elif dataset == "seven_scenes":
        writers.write_seven_scenes(tmp_path)
        victim = tmp_path / "frame-000001.depth.png"
    else:
        writers.write_color_depth(tmp_path, "image" if dataset == "icl" else "color")
        writers.write_log(tmp_path / "trajectory.log", {i: writers.make_pose(i) for i in range(3)})
        victim = tmp_path / "depth/00001.png"
    victim.unlink()
    sequence = open_sequence(tmp_path, dataset=dataset, camera=writers.CAMERA)
    assert len(sequence) == 2
    (remark,) = sequence.remarks
    assert re.search(r"1 images have no partner .*1?\.(png|jpg)|2\.jpg", remark.message) and not remark.is_fine
    for index, source in enumerate((0, 2)):
        frame = sequence[index]
        assert np.median(np.abs(frame.depth - writers.make_depth(source) / 1000)) == pytest.approx(0, abs=1e-6)
        assert abs(int(frame.rgb[8, 8, 1]) - 10 * source) < 8
        np.testing.assert_allclose(frame.T_world_camera, writers.make_pose(source), atol=1e-12)


def test_pairs_by_number_not_by_rank(tmp_path):
    """As many colour as depth images, of different frames: those that both have are the frames."""
    writers.write_replica(tmp_path, 4)
    (tmp_path / "results" / "depth000001.png").rename(tmp_path / "results" / "depth000009.png")
    sequence = open_sequence(tmp_path)
    assert [frame.rgb[0, 0, 1] // 10 for frame in sequence] == [0, 2, 3]
    np.testing.assert_array_equal(sequence[1].depth, writers.make_depth(2).astype(np.float32) / np.float32(1000))
    np.testing.assert_allclose(sequence[1].T_world_camera, writers.make_pose(2), atol=1e-12)
    assert re.search(r"frame000001\.png, results/depth000009\.png", sequence.remarks[0].message)


def test_numbers_that_say_nothing(tmp_path):
    """Names without a common number are pairs in their order where the counts agree, and refused where not."""
    for i in range(3):
        writers.write_image(tmp_path / "color" / f"{i}.png", writers.make_rgb(i))
        writers.write_image(tmp_path / "depth" / f"{i + 700}.png", writers.make_depth(i))
    assert len(open_sequence(tmp_path, camera=writers.CAMERA)) == 3
    (tmp_path / "depth/701.png").unlink()
    refuse(tmp_path, "3 colour images but 2 depth images", camera=writers.CAMERA)


def test_pose_count(tmp_path):
    """More poses than frames are taken by frame number; fewer are refused."""
    writers.write_replica(tmp_path, 4)
    for kind in ("frame", "depth"):
        (tmp_path / "results" / f"{kind}000001.png").unlink()
    truth = open_sequence(tmp_path).ground_truth()
    np.testing.assert_allclose(truth, [writers.make_pose(i) for i in (0, 2, 3)], atol=1e-12)
    lines = (tmp_path / "traj.txt").read_text().splitlines()
    (tmp_path / "traj.txt").write_text("\n".join(lines[:2]))
    refuse(tmp_path, r"traj\.txt: 2 poses but 3 frames")


@pytest.mark.parametrize("keep", [0, 0.5, 0.95])
@pytest.mark.parametrize("name", ["frame000000.png", "depth000000.png"])
def test_truncated_png(tmp_path, name, keep):
    """An image that is empty or cut off, and the only one."""
    file = writers.write_replica(tmp_path, 1) / "results" / name
    data = file.read_bytes()
    file.write_bytes(data[: int(len(data) * keep)])
    refuse(tmp_path, re.escape(name), "empty file|truncated image", "fetch")


def test_truncated_jpeg(tmp_path):
    """A cut-off JPEG is refused, not read with a grey rest."""
    writers.write_replica(tmp_path)
    for i in range(3):
        (tmp_path / "results" / f"frame{i:06d}.png").unlink()
        file = writers.write_image(tmp_path / "results" / f"frame{i:06d}.jpg", writers.make_rgb(i))
    sequence = open_sequence(tmp_path)
    data = file.read_bytes()
    file.write_bytes(data[:-20])
    assert sequence[1].rgb.shape == (writers.HEIGHT, writers.WIDTH, 3)
    with pytest.raises(DatasetError, match=r"frame000002\.jpg: truncated"):
        sequence[2]


def test_first_frame_may_be_bad(tmp_path):
    """A sequence whose first image is cut off opens; the frame is refused when it is asked for."""
    file = writers.write_replica(tmp_path) / "results" / "depth000000.png"
    file.write_bytes(file.read_bytes()[:-20])
    sequence = open_sequence(tmp_path)
    with pytest.raises(DatasetError, match=r"depth000000\.png: truncated"):
        sequence[0]
    assert sequence[1].depth.shape == (writers.HEIGHT, writers.WIDTH)


def test_no_image_at_all(tmp_path):
    """A file that is named as an image and holds text."""
    writers.write_replica(tmp_path, 1)
    (tmp_path / "results" / "depth000000.png").write_text("<html>404</html>" * 10)
    refuse(tmp_path, r"depth000000\.png", "damaged or not an image")


def test_frame_that_vanished(tmp_path):
    """A file that is deleted after opening."""
    sequence = open_sequence(writers.write_replica(tmp_path))
    (tmp_path / "results" / "depth000001.png").unlink()
    with pytest.raises(DatasetError, match=r"depth000001\.png: can't be read"):
        sequence[1]


@pytest.mark.parametrize("image", [np.zeros((16, 24), np.uint8), np.zeros((16, 24, 3), np.uint16)])
def test_depth_of_wrong_kind(tmp_path, image):
    """Depth in 8 bits or in colour."""
    writers.write_replica(tmp_path, 1)
    assert cv2.imwrite(str(tmp_path / "results" / "depth000000.png"), image)
    refuse(tmp_path, r"depth000000\.png", "one-channel 16-bit")


def test_size_does_not_match(tmp_path):
    """Images of another size than the camera's."""
    folder = writers.write_replica(tmp_path, 1)
    refuse(
        folder,
        r"depth000000\.png: depth image is 24 x 16",
        r"built-in|camera = '20",
        "is 48 x 32",
        camera="20,20,1,1,48,32,1000",
    )


@pytest.mark.parametrize(
    ("change", "patterns"),
    [
        ("depth_scale: 0", ("depth_scale = 0", "positive", "1000 for millimetres")),
        ("depth_scale: -5", ("depth_scale = -5",)),
        ("depth_scale: .nan", ("depth_scale = nan",)),
        ("fx: abc", ("fx = 'abc'", "number")),
        ("fx: 0", ("fx = 0", "positive")),
        ("fx: [1]", (r"fx = \[1\]",)),
        ("width: 24.5", ("width = 24.5", "whole")),
        ("fokal: 3", ("unknown field fokal",)),
        ("crop: 8", ("height",)),
        ("crop: -1", ("crop = -1",)),
        ("resize: 3", ("resize = 3",)),
        ("distortion: [1, 2, 3]", ("distortion has 3 numbers",)),
        ("a: b: c", ("not valid YAML",)),
    ],
)
def test_camera_yaml(tmp_path, change, patterns):
    """Wrong fields of camera.yaml are named."""
    key = change.split(":")[0]
    lines = [line for line in writers.CAMERA_YAML.splitlines() if not line.startswith(key + ":")]
    writers.write_replica(tmp_path, camera="\n".join([*lines, change]) + "\n")
    refuse(tmp_path, r"camera\.yaml", *patterns)


def test_camera_yaml_incomplete(tmp_path):
    """Missing fields of camera.yaml are named; an empty file is refused."""
    writers.write_replica(tmp_path, camera="fx: 20\n")
    refuse(tmp_path, r"camera\.yaml: field fy, cx, cy, width, height, depth_scale is missing")
    (tmp_path / "camera.yaml").write_text("")
    refuse(tmp_path, r"camera\.yaml: holds no fields")


@pytest.mark.parametrize(
    ("camera", "pattern"),
    [
        ("1,2,3", "has 3 numbers; give 7: fx,fy"),
        ("1,1,1,1,24,16,0", "depth_scale = 0"),
        ("1,1,x,1,24,16,1", "cx = 'x'"),
    ],
)
def test_camera_argument(tmp_path, camera, pattern):
    """Wrong camera strings."""
    refuse(writers.write_replica(tmp_path), pattern, camera=camera)


@pytest.mark.parametrize(
    ("line", "pattern"),
    [
        ("1 2 3", r"traj\.txt:2: 3 numbers, expected 16"),
        ("1 0 0 0 0 1 0 0 0 0 1 x 0 0 0 1", r"traj\.txt:2: .*'x'"),
        ("1 0 0 0 0 1 0 0 0 0 -1 0 0 0 0 1", r"traj\.txt:2: not a rigid transform"),
        ("2 0 0 0 0 2 0 0 0 0 2 0 0 0 0 1", r"traj\.txt:2: not a rigid transform"),
        ("1 0 0 0 0 1 0 0 0 0 1 0 1 2 3 1", r"traj\.txt:2: not a rigid transform"),
    ],
)
def test_malformed_replica_poses(tmp_path, line, pattern):
    """Pose lines are named by file and line."""
    trajectory = writers.write_replica(tmp_path) / "traj.txt"
    lines = trajectory.read_text().splitlines()
    lines[1] = line
    trajectory.write_text("\n".join(lines))
    refuse(tmp_path, pattern)


def test_malformed_redwood_log(tmp_path):
    """Redwood logs: bad header, cut-off matrix, frame out of range."""
    folder = writers.write_color_depth(tmp_path, "color")
    log = folder / "trajectory.log"
    log.write_text("0 0\n" + writers.matrix_text(np.eye(4)))
    refuse(folder, r"trajectory\.log:1: 2 numbers, expected 3", camera=writers.CAMERA)
    log.write_text("0 0 1\n" + writers.matrix_text(np.eye(4)) + "1 1 2\n1 0 0 0\n")
    refuse(folder, r"trajectory\.log:6: frame 1 has 1 of 4 matrix lines", camera=writers.CAMERA)
    writers.write_log(log, {3: np.eye(4)})
    refuse(folder, r"trajectory\.log:1: frame 3 but the folder holds 3 frames", camera=writers.CAMERA)


def test_malformed_tum_lists(tmp_path):
    """TUM: lines of the lists and of the trajectory, a zero quaternion, a file that is listed and missing."""
    folder = writers.write_tum(tmp_path, [1.0, 2.0], [1.0, 2.0], [1.0, 2.0])
    good = {name: (folder / name).read_text() for name in ("rgb.txt", "groundtruth.txt")}
    (folder / "rgb.txt").write_text("# c\nnow rgb/1.png\n")
    refuse(folder, r"rgb\.txt:2: 'now rgb/1\.png'", camera=writers.CAMERA)
    (folder / "rgb.txt").write_text("# nothing\n")
    refuse(folder, r"rgb\.txt: lists no images", camera=writers.CAMERA)
    (folder / "rgb.txt").write_text("1.0 rgb/gone.png\n")
    refuse(folder, r"gone\.png: listed in rgb\.txt", camera=writers.CAMERA)
    (folder / "rgb.txt").write_text("50.0 rgb/1.000000.png\n")
    refuse(folder, r"within 0\.08 s", camera=writers.CAMERA)
    (folder / "rgb.txt").write_text(good["rgb.txt"])
    (folder / "groundtruth.txt").write_text("# c\n1.0 0 0 0 0 0 0\n")
    refuse(folder, r"groundtruth\.txt:2: 7 numbers, expected 8", camera=writers.CAMERA)
    (folder / "groundtruth.txt").write_text("1.0 0 0 0 0 0 0 0\n")
    refuse(folder, r"groundtruth\.txt:1: quaternion", camera=writers.CAMERA)
    (folder / "groundtruth.txt").write_text("# c\n")
    refuse(folder, r"groundtruth\.txt: holds no pose", camera=writers.CAMERA)


def test_tum_camera_unknown(tmp_path):
    """TUM: a folder whose name tells no camera asks for one."""
    refuse(writers.write_tum(tmp_path, [1.0], [1.0], [1.0]), "camera unknown", "freiburg1", r"camera\.yaml")


def test_own_recording_without_camera(tmp_path):
    """A recording of one's own is not given somebody else's camera."""
    folder = writers.write_color_depth(tmp_path / "kitchen", "color")
    refuse(folder, "camera unknown", "Apartment", r"camera\.yaml")
    (folder / "intrinsic.json").write_text('{"width": 24}')
    refuse(folder, r"intrinsic\.json", "intrinsic_matrix")


def test_malformed_pose_files(tmp_path):
    """ScanNet and 7-Scenes: a matrix of three rows, a missing file."""
    file = writers.write_scannet(tmp_path / "a") / "frames/pose/2.txt"
    file.write_text("1 0 0 0\n0 1 0 0\n0 0 1 0\n")
    refuse(tmp_path / "a", r"2\.txt: 3 lines of numbers, expected the 4 rows", camera=writers.CAMERA)
    file.unlink()
    (writers.write_seven_scenes(tmp_path / "b") / "frame-000001.pose.txt").unlink()
    for name, pattern in (
        ("a", r"1 of 3 frames have no file in .*: 2\.txt"),
        ("b", r"1 of 3 .*frame-000001\.pose\.txt"),
    ):
        sequence = open_sequence(tmp_path / name, camera=writers.CAMERA)
        assert re.search(pattern, sequence.remarks[-1].message) and sequence[1].T_world_camera is None
        assert sequence[0].T_world_camera is not None and sequence[2].T_world_camera is not None


def test_damaged_exr(tmp_path):
    """Co-Fusion: a cut-off EXR, and one without the depth channel."""
    pytest.importorskip("OpenEXR", reason="the package openexr is not installed")
    file = writers.write_cofusion(tmp_path, 1) / "depth_noise/Depth0001.exr"
    data = file.read_bytes()
    file.write_bytes(data[: len(data) // 2])
    refuse(tmp_path, r"Depth0001\.exr", "damaged EXR", camera=writers.CAMERA)
    writers.write_exr(file, np.ones((writers.HEIGHT, writers.WIDTH), np.float32), channel="A")
    refuse(tmp_path, r"Depth0001\.exr", "no channel Y but A", camera=writers.CAMERA)


def test_guess_lists_what_was_looked_for(tmp_path):
    """A folder of no known layout: the message lists the layouts, and the sequence one level down."""
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(DatasetError) as caught:
        guess_dataset(tmp_path)
    message = str(caught.value)
    assert all(name in message for name in DATASETS) and "results/frame*.jpg" in message and "rgb.txt" in message
    writers.write_replica(tmp_path / "room7")
    with pytest.raises(DatasetError, match="room7 looks like replica: pass that one"):
        guess_dataset(tmp_path)
