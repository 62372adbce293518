"""Inputs that people have, each with a trouble of its own: the right result, or the sentence that helps."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from functools import partial

import cv2
import numpy as np
import pytest

from tests.sequences.recordings import (
    CAMERA,
    FLIP,
    Room,
    camera_yaml,
    enlarged,
    room,
    stored,
    write_lists,
    write_own,
    write_tum_poses,
    write_video,
)
from tests.sequences.writers import write_exr, write_image
from warpslam.camera import Intrinsics
from warpslam.cli.check import _given
from warpslam.config import Config
from warpslam.errors import DatasetError, InputError
from warpslam.frames import read_images
from warpslam.sequences import guess_dataset, open_sequence
from warpslam.sequences.checking import ERROR, OK, WARNING, check_folder
from warpslam.sequences.pose_convention import agreement, posed_pairs
from warpslam.synthetic import MeshRenderer, SyntheticSequence

MATRIX = CAMERA.matrix.T.ravel().tolist()  # column-major, as Open3D writes it


def find(report, check: str, severity: str, pattern: str = "") -> str:
    """The text of the finding of that severity that matches; fails without one."""
    texts = [str(f) for f in report.findings if f.check == check and f.severity == severity]
    matching = [text for text in texts if re.search(pattern, text)]
    assert matching, [f"{f.severity}: {f}" for f in report.findings]
    return matching[0]


def no_complaints(report) -> None:
    """Nothing but "ok"."""
    bad = [str(finding) for finding in report.findings if finding.severity != OK]
    assert not bad and report.frames, bad


def same_frames(sequence, source: Room, *, poses: bool = True, tolerance: float = 0.002) -> None:
    """Depth [m], colour and poses are those of the room."""
    assert len(sequence) == len(source)
    for index in (0, len(source) - 1):
        frame = sequence[index]
        assert np.median(np.abs(frame.depth - source.depth[index])) < tolerance
        assert np.abs(frame.rgb.astype(int) - source.rgb[index]).mean() < 8
        if poses:
            np.testing.assert_allclose(frame.T_world_camera, source.poses[index], atol=1e-5)


# -- truth -----------------------------------------------------------------------------------------------------------


def write_room_in_replica(folder, source: Room, poses) -> None:
    for i in range(len(source)):
        write_image(folder / f"results/frame{i:06d}.png", source.rgb[i])
        write_image(folder / f"results/depth{i:06d}.png", stored(source.depth[i]))
    np.savetxt(folder / "traj.txt", np.asarray(poses).reshape(-1, 16))
    camera_yaml(folder)


def test_poses_that_are_all_the_same(tmp_path):
    """Placeholders are no ground truth, and that is said; a camera that does stand still keeps its poses."""
    source = room()
    write_room_in_replica(tmp_path / "moves", source, [np.eye(4)] * len(source))
    sequence = open_sequence(tmp_path / "moves")
    assert sequence.ground_truth() is None and sequence[3].T_world_camera is None
    find(check_folder(tmp_path / "moves"), "poses", WARNING, "all 24 poses are the same.*not ground truth")
    still = Room(source.rgb[[0] * 6], source.depth[[0] * 6], source.poses[[0] * 6])
    write_room_in_replica(tmp_path / "stands", still, still.poses)
    assert open_sequence(tmp_path / "stands").ground_truth() is not None


def test_poses_that_stop(tmp_path):
    """Poses that repeat the last one to the end are unknown from there on."""
    source = room()
    poses = source.poses.copy()
    poses[12:] = poses[11]
    write_room_in_replica(tmp_path, source, poses)
    truth = open_sequence(tmp_path).ground_truth()
    assert np.isfinite(truth[:12]).all() and np.isnan(truth[12:]).all()
    find(check_folder(tmp_path), "poses", WARNING, "stop at frame 11: the 12 after it")


def test_given_poses_with_w_first(tmp_path):
    """Given poses are compared with depth as the dataset's own are; the order is named, and what to type works."""
    source, times = room(), np.arange(24) / 30
    write_own(tmp_path / "room", source)
    right = write_tum_poses(tmp_path / "right.tum", source, times)
    wrong = write_tum_poses(tmp_path / "wrong.tum", source, times, order=(0, 1, 2, 3))
    no_complaints(check_folder(tmp_path / "room", read_poses=partial(_given, right)))
    text = find(check_folder(tmp_path / "room", read_poses=partial(_given, wrong)), "pose convention", ERROR, "w first")
    command = re.search(r"type: (awk .* > xyzw\.tum)", text)[1]
    subprocess.run(command, shell=True, check=True, cwd=tmp_path)
    no_complaints(check_folder(tmp_path / "room", read_poses=partial(_given, tmp_path / "xyzw.tum")))


def test_given_poses_of_another_recording(tmp_path):
    """Given poses that fit in no reading stop the run: they would smear the map."""
    source = room()
    write_own(tmp_path / "room", source)
    other = Room(source.rgb, source.depth, source.poses[np.random.default_rng(0).permutation(24)])
    path = write_tum_poses(tmp_path / "other.tum", other, np.arange(24) / 30)
    find(check_folder(tmp_path / "room", read_poses=partial(_given, path)), "pose convention", ERROR, "no other")


def test_given_poses_by_frame_order_and_by_time(tmp_path):
    """Without times of its own a folder takes a pose for each frame, 3x4 or 4x4 a line; epoch times are told."""
    source = room()
    folder = write_own(tmp_path / "own", source)
    np.savetxt(tmp_path / "kitti.txt", source.poses[:, :3].reshape(-1, 12))
    np.savetxt(tmp_path / "matrices.txt", source.poses.reshape(-1, 16))
    for name in ("kitti.txt", "matrices.txt"):
        no_complaints(check_folder(folder, read_poses=partial(_given, tmp_path / name)))
    epoch = write_tum_poses(tmp_path / "epoch.tum", source, 1305031102.175304 + np.arange(24) / 30)
    report = check_folder(folder, read_poses=partial(_given, epoch))
    find(report, "sequence", ERROR, r"none of its 24 times .*12 numbers a line")
    nanoseconds = tmp_path / "nanoseconds.tum"
    lines = [line.split() for line in epoch.read_text().splitlines()]
    nanoseconds.write_text("".join(f"{int(i * 1e9 / 30)} {' '.join(line[1:])}\n" for i, line in enumerate(lines)))
    no_complaints(check_folder(folder, read_poses=partial(_given, nanoseconds)))


def test_keyframes_only(tmp_path):
    """Poses of every fourth frame, by time: the others have none, and that is counted."""
    source, times = room(), 1305031102.175304 + np.arange(24) / 30
    write_lists(tmp_path / "tum", source, [f"{t:.6f}" for t in times])
    few = Room(source.rgb[::4], source.depth[::4], source.poses[::4])
    path = write_tum_poses(tmp_path / "keyframes.txt", few, times[::4])
    report = check_folder(tmp_path / "tum", read_poses=partial(_given, path))
    find(report, "poses", WARNING, "18 of 24 frames have no pose in .*keyframes.txt")
    assert not report.errors


def test_mirrored_world_is_named(tmp_path):
    """Poses of a world whose y points up are told."""
    source, mirror = room(), np.diag([1.0, -1, 1, 1])
    write_room_in_replica(tmp_path, source, mirror @ source.poses @ mirror)
    text = find(check_folder(tmp_path), "pose convention", ERROR, "mirrored world")
    assert "M @ T @ M" in text


# -- units and kinds of depth ----------------------------------------------------------------------------------------


def test_depth_scale_of_the_recorder(tmp_path):
    """The unit in Open3D's file is used, both ways round that it is written."""
    source = room().scaled(0.6)
    for name, scale in (("intrinsic.json", 3999.999755859375), ("camera_intrinsic.json", 1 / 4000)):
        folder = write_own(tmp_path / name, source, scale=4000, with_camera=False)
        fields = {"width": 80, "height": 60, "intrinsic_matrix": MATRIX, "depth_scale": scale}
        (folder / name).write_text(json.dumps(fields))
        same_frames(open_sequence(folder), source, poses=False)
        no_complaints(check_folder(folder))


def test_recorder_file_without_a_unit(tmp_path):
    """Millimetres where Open3D's file names none."""
    folder = write_own(tmp_path, room(), with_camera=False)
    (folder / "camera_intrinsic.json").write_text(json.dumps({"width": 80, "height": 60, "intrinsic_matrix": MATRIX}))
    sequence = open_sequence(folder)
    assert sequence.intrinsics == CAMERA
    same_frames(sequence, room(), poses=False)


@pytest.mark.parametrize("kind", ["tiff", "npy", "npz", "exr"])
def test_float_depth(tmp_path, kind):
    """Metres as floats; what is no number, infinite or negative is missing."""
    if kind == "exr":
        pytest.importorskip("OpenEXR", reason="the package openexr is not installed")
    source = room()
    camera_yaml(tmp_path, 1)
    (tmp_path / "depth").mkdir()
    for i in range(6):
        depth = source.depth[i].copy()
        depth[0], depth[1], depth[2] = np.nan, np.inf, -1
        write_image(tmp_path / f"color/{i}.jpg", source.rgb[i])
        file = tmp_path / f"depth/{i}.{kind}"
        if kind == "tiff":
            assert cv2.imwrite(str(file), depth)
        elif kind == "npy":
            np.save(file, depth)
        elif kind == "npz":
            np.savez_compressed(file, depth=depth)
        else:
            write_exr(file, depth, channel="R")
    frame = open_sequence(tmp_path)[5]
    assert frame.depth.dtype == np.float32 and (frame.depth[:3] == 0).all()
    np.testing.assert_array_equal(frame.depth[3:], source.depth[5][3:])
    assert not check_folder(tmp_path).errors


def test_depth_of_a_type_that_is_not_read(tmp_path):
    """The type found is named, and what is read."""
    write_own(tmp_path, room())
    for file in (tmp_path / "depth").iterdir():
        file.rename(file.with_suffix(".pfm"))
    with pytest.raises(DatasetError, match=r"no images \(\*\.png.*\.npy.*\), but files of type \.pfm; convert"):
        open_sequence(tmp_path)


def test_depth_along_the_ray(tmp_path):
    """Distances along the rays are told from the poses, or from planes that come out bent; the remedy converts them."""
    camera = Intrinsics(125.0, 125.0, 79.5, 59.5, 160, 120)
    source = room(20, camera, 0)
    v, u = np.mgrid[:120, :160]
    rays = np.linalg.norm(camera.backproject(u, v, 1.0), axis=-1).astype(np.float32)
    long = Room(source.rgb, source.depth * rays, source.poses)
    for with_poses in (True, False):
        folder = write_own(tmp_path / str(with_poses), long, with_poses=with_poses, scale=5000, camera=camera)
        report = check_folder(folder)
        texts = [str(f) for f in report.findings if f.check == "depth along the ray" and f.severity != OK]
        assert texts, [str(f) for f in report.findings]
        command = re.search(r"type: (echo .* > camera\.yaml)", texts[0])[1]
        subprocess.run(command, shell=True, check=True, cwd=folder)
        same_frames(open_sequence(folder), source, poses=with_poses)
        assert not [f for f in check_folder(folder).findings if f.check == "depth along the ray"]


def test_rotated_bits_in_another_layout(tmp_path):
    """Values that are all multiples of 8 are told, and the camera to type gives the right depth."""
    source = room()
    folder = write_own(tmp_path, source)
    for file in (tmp_path / "depth").iterdir():
        depth = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        write_image(file, (depth << 3) | (depth >> 13))
    text = find(check_folder(folder), "depth scale", ERROR, "multiple of 8.*rotated")
    camera = re.search(r"--camera (\S+)", text)[1]
    same_frames(open_sequence(folder, camera=camera), source, poses=False)


# -- size of the scene -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("factor", "with_poses", "severity"), [(6, True, ERROR), (0.05, True, WARNING), (6, False, ERROR)]
)
def test_a_scene_is_as_large_as_it_is(tmp_path, factor, with_poses, severity):
    """A hall and a thing on a table: one setting is named that suits, and with it there is no complaint. Where poses
    confirm the unit, no other unit is advised.
    """
    source = room().scaled(factor)
    folder = write_own(tmp_path, source, scale=1000 if factor > 1 else 40000, with_poses=with_poses)
    text = find(check_folder(folder), "depth scale", severity, "scene_scale")
    assert ("--camera" in text) is not with_poses
    override = re.search(r"--set (scene_scale=\S+)", text)[1]
    scale = float(override.split("=")[1])
    assert factor / 2 < scale < factor * 4
    config = Config.from_preset("default", [override]).resolved()
    assert config.grid.fine_spacing == pytest.approx(0.08 * scale) and config.scene_scale == 1
    no_complaints(check_folder(folder, max_depth=config.grid.max_depth))


def test_a_plain_wall(tmp_path):
    """A wall without features fills the image: that it tells nothing of the motion along it is said."""
    wall = np.full((6, 60, 80, 3), 180, np.uint8) + np.arange(6, dtype=np.uint8)[:, None, None, None]
    u = np.arange(80)[None, None] * np.ones((6, 60, 1))
    tilted = (1 / (0.5 + 0.0005 * u)).astype(np.float32)
    write_own(tmp_path, Room(wall, tilted, np.tile(np.eye(4), (6, 1, 1))))
    find(check_folder(tmp_path), "structure", WARNING, "6 of the 6 .* plain wall.*motion along it")
    assert not [f for f in check_folder(write_own(tmp_path / "room", room())).findings if f.check == "structure"]


# -- colour and depth ------------------------------------------------------------------------------------------------


def test_colour_larger_than_depth(tmp_path):
    """Colour of another size is brought to depth, with the camera of either; that equal views are assumed is said."""
    source = room()
    folder = write_own(tmp_path, source)
    for i, image in enumerate(enlarged(source, 7.5)):
        write_image(folder / f"color/{i:06d}.png", image)
    big = "450,450,296.25,221.25,600,450,1000"
    for camera in (None, big):
        sequence = open_sequence(folder, camera=camera)
        assert sequence.intrinsics.width == 80 and sequence.intrinsics.fx == pytest.approx(60)
        same_frames(sequence, source, poses=False)
        report = check_folder(folder, camera=camera)
        find(report, "image sizes", OK, r"colour is 600 x 450, depth 80 x 60.*same field of view")
        assert not report.errors


def test_colour_of_another_shape(tmp_path):
    """Images that can't have the same field of view are not passed over."""
    folder = write_own(tmp_path, room())
    for file in (folder / "color").iterdir():
        write_image(file, np.full((90, 160, 3), 90, np.uint8))
    find(check_folder(folder), "image sizes", WARNING, "shapes contradict.*T_color_depth")


LARGE = Intrinsics(84.3, 84.3, 79.5, 59.5, 160, 120)


def two_cameras(shift: float):
    """A room seen by a depth camera, and by a colour camera beside it with a longer focal length."""
    sequence = SyntheticSequence(0, 8, intrinsics=LARGE, device="cpu")
    color = Intrinsics(116.4, 116.4, 81.0, 58.0, 160, 120)
    T_color_depth = np.eye(4)
    T_color_depth[0, 3] = -shift
    renderer = MeshRenderer(sequence.mesh, color, device="cpu")
    source = room(8, LARGE, 0)
    views = [renderer.render(T @ np.linalg.inv(T_color_depth)) for T in source.poses]
    return color, T_color_depth, np.stack([rgb for rgb, _ in views]), np.stack([depth for _, depth in views])


def test_depth_that_is_not_registered(tmp_path):
    """Images of two cameras: edges tell, and with both cameras given depth is carried into that of colour."""
    color, T_color_depth, rgb, true_depth = two_cameras(0.03)
    source = room(8, LARGE, 0)
    folder = write_own(tmp_path, Room(rgb, source.depth, source.poses), camera=LARGE)
    text = find(check_folder(folder), "registration", WARNING, "edges of depth do not lie on edges of colour")
    assert 1.3 < 1 / float(re.search(r"scaled by ([\d.]+)", text)[1]) < 1.5
    fields = ", ".join(f"{name}: {value}" for name, value in vars(color).items())
    transform = ", ".join(map(str, T_color_depth.ravel().tolist()))
    camera_yaml(folder, camera=LARGE, more=f"color: {{{fields}}}\nT_color_depth: [{transform}]")
    sequence = open_sequence(folder)
    assert sequence.intrinsics == color
    frame = sequence[7]
    np.testing.assert_array_equal(frame.rgb, rgb[7])
    both = (frame.depth > 0) & (true_depth[7] > 0)
    assert both.mean() > 0.9
    relative = np.abs(frame.depth - true_depth[7])[both] / true_depth[7][both]
    assert np.median(relative) < 0.01 and np.mean(relative > 0.05) < 0.08, (
        np.median(relative),
        np.mean(relative > 0.05),
    )
    no_complaints(check_folder(folder))


def test_colour_camera_in_the_same_place(tmp_path):
    """Without a shift between the cameras colour is sampled at the pixels of depth, which stays as it was measured."""
    color, _, rgb, _ = two_cameras(0.0)
    source = room(8, LARGE, 0)
    folder = write_own(tmp_path, Room(rgb, source.depth, source.poses), camera=LARGE)
    fields = ", ".join(f"{name}: {value}" for name, value in vars(color).items())
    camera_yaml(folder, camera=LARGE, more=f"color: {{{fields}}}")
    frame = open_sequence(folder)[7]
    middle = slice(30, 90), slice(40, 120)
    np.testing.assert_allclose(frame.depth[middle], source.depth[7][middle], atol=6e-4)
    assert (frame.depth[:, :15] == 0).all()  # colour sees less
    assert np.abs(frame.rgb[middle].astype(int) - source.rgb[7][middle]).mean() < 8
    no_complaints(check_folder(folder))


# -- layouts ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("base", ["", "frames"])
def test_scannet_export(tmp_path, base):
    """With and without frames/: camera of depth from its file, colour through its own, -inf poses unknown."""
    source = room()
    for i in range(8):
        write_image(tmp_path / base / f"color/{i}.jpg", cv2.resize(source.rgb[i], (162, 121)))
        write_image(tmp_path / base / f"depth/{i}.png", stored(source.depth[i]))
        pose = np.full((4, 4), -np.inf) if i == 6 else source.poses[i]
        (tmp_path / base / "pose").mkdir(exist_ok=True)
        np.savetxt(tmp_path / base / f"pose/{i}.txt", pose)
    for name, (sx, sy) in (("depth", (1, 1)), ("color", (162 / 80, 121 / 60))):
        K = np.eye(4)
        K[:3, :3] = np.diag([sx, sy, 1]) @ CAMERA.matrix
        (tmp_path / base / "intrinsic").mkdir(exist_ok=True)
        np.savetxt(tmp_path / base / f"intrinsic/intrinsic_{name}.txt", K)
    assert guess_dataset(tmp_path) == "scannet"
    sequence = open_sequence(tmp_path)
    assert sequence.intrinsics == CAMERA.cropped(1)  # 10 pixels of 640
    assert sequence.ground_truth().shape == (8, 4, 4) and sequence[6].T_world_camera is None
    inner = source.rgb[3][1:-1, 1:-1].astype(int)
    assert np.abs(sequence[3].rgb.astype(int) - inner).mean() < 8
    np.testing.assert_allclose(sequence[3].depth, source.depth[3][1:-1, 1:-1], atol=6e-4)
    np.testing.assert_allclose(sequence[3].T_world_camera, source.poses[3], atol=1e-9)


def write_stray(folder, source: Room, unpacked: bool) -> None:
    """Stray Scanner: colour 7.5 times as large as depth, OpenGL axes, confidence 0 to 2."""
    big = enlarged(source, 7.5)
    (folder / "depth").mkdir(parents=True)
    lines = ["timestamp, frame, x, y, z, qx, qy, qz, qw"]
    for i in range(len(source)):
        write_image(folder / f"depth/{i:06d}.png", stored(source.depth[i]))
        confidence = np.full((60, 80), 2, np.uint8)
        confidence[:, :5] = 0
        write_image(folder / f"confidence/{i:06d}.png", confidence)
        if unpacked:
            write_image(folder / f"color/{i:06d}.jpg", big[i])
        lines.append(tum_values(100 + i / 60, i, source.poses[i] @ FLIP))
    (folder / "odometry.csv").write_text("\n".join(lines) + "\n")
    np.savetxt(folder / "camera_matrix.csv", np.diag([7.5, 7.5, 1]) @ CAMERA.matrix, delimiter=",")
    if not unpacked:
        write_video(folder / "rgb.mp4", big, 60)


def tum_values(time: float, frame: int, T: np.ndarray) -> str:
    from warpslam.poses import vector_from_pose

    w, x, y, z, *t = vector_from_pose(T)
    return ", ".join(map(str, (time, f"{frame:06d}", *t, x, y, z, w)))


@pytest.mark.parametrize("unpacked", [False, True])
def test_stray_scanner(tmp_path, unpacked):
    """As the app writes it and with the video unpacked: size, confidence, axes and times."""
    source = room()
    write_stray(tmp_path, source, unpacked)
    sequence = open_sequence(tmp_path)
    assert guess_dataset(tmp_path) == "stray" and sequence.intrinsics == CAMERA
    same_frames(sequence, source)
    assert sequence[4].timestamp == pytest.approx(100 + 4 / 60)
    assert (sequence[4].depth[:, :5] == 0).all()
    find(check_folder(tmp_path), "poses", OK, "OpenGL axes, as 9.% of the depth confirms")
    # Frames asked for in any order are the same.
    again = open_sequence(tmp_path)
    for index in (20, 3, 9):
        np.testing.assert_array_equal(again[index].rgb, sequence[index].rgb)
        assert np.abs(sequence[index].rgb.astype(int) - source.rgb[index]).mean() < 8


def test_stray_scanner_with_other_axes(tmp_path):
    """A version of the app that writes OpenCV's axes: depth tells."""
    source = room()
    write_stray(tmp_path, Room(source.rgb, source.depth, source.poses @ FLIP), unpacked=True)
    same_frames(open_sequence(tmp_path), source)


def test_sun3d(tmp_path):
    """Bits are rotated back, the camera is that of the folder, poses are read."""
    source = room()
    for name in ("image", "depth", "extrinsics"):
        (tmp_path / name).mkdir()
    for i in range(len(source)):
        mm = stored(source.depth[i])
        write_image(tmp_path / f"image/{i + 1:07d}-{i * 33369:012d}.jpg", source.rgb[i])
        write_image(tmp_path / f"depth/{i + 1:07d}-{i * 33371:012d}.png", (mm << 3) | (mm >> 13))
    np.savetxt(tmp_path / "intrinsics.txt", CAMERA.matrix)
    np.savetxt(tmp_path / "extrinsics/20140808220511.txt", source.poses[:, :3].reshape(-1, 4))
    assert guess_dataset(tmp_path) == "sun3d"
    same_frames(open_sequence(tmp_path), source)
    no_complaints(check_folder(tmp_path))


def test_icl_nuim_as_published(tmp_path):
    """Camera 481.2 and 480, 5000 a metre, and poses mirrored back so that depth agrees with them."""
    camera = Intrinsics(481.2, 480.0, 319.5, 239.5, 640, 480)
    small = Intrinsics(camera.fx / 8, camera.fy / 8, camera.cx / 8, camera.cy / 8, 80, 60)
    source, mirror = room(10, small), np.diag([1.0, -1, 1, 1])
    lines, truth = [], []
    from tests.sequences.recordings import tum_line

    for i in range(len(source)):
        write_image(tmp_path / f"rgb/{i}.png", np.repeat(np.repeat(source.rgb[i], 8, 0), 8, 1))
        write_image(tmp_path / f"depth/{i}.png", np.repeat(np.repeat(stored(source.depth[i], 5000), 8, 0), 8, 1))
        lines.append(f"{i} depth/{i}.png {i} rgb/{i}.png\n")
        truth.append(tum_line(i, mirror @ source.poses[i] @ mirror))
    (tmp_path / "associations.txt").write_text("".join(lines))
    (tmp_path / "livingRoom1.gt.freiburg").write_text("".join(truth))
    assert guess_dataset(tmp_path) == "icl_nuim"
    sequence = open_sequence(tmp_path)
    assert sequence.intrinsics == camera and len(sequence) == 10
    assert sequence[9].timestamp == pytest.approx(9 / 30)
    np.testing.assert_allclose(sequence.ground_truth(), source.poses, atol=1e-6)
    assert np.median(np.abs(sequence[5].depth[::8, ::8] - source.depth[5])) < 1e-3


def test_associations_without_lists(tmp_path):
    """A TUM folder that has its associations only."""
    folder = write_lists(tmp_path, room(), [f"{i / 30:.6f}" for i in range(24)])
    rows = (f"{i / 30:.6f} rgb/{i:04d}.png {i / 30 + 0.004:.6f} depth/{i:04d}.png\n" for i in range(24))
    (folder / "associations.txt").write_text("".join(rows))
    (folder / "rgb.txt").unlink()
    (folder / "depth.txt").unlink()
    sequence = open_sequence(folder)
    same_frames(sequence, room(), poses=False)
    assert sequence[3].depth_timestamp - sequence[3].timestamp == pytest.approx(0.004)


def test_bundlefusion_layout(tmp_path):
    """7-Scenes' names with JPEG colour and a camera file; 65535 is missing."""
    source = room()
    for i in range(len(source)):
        depth = stored(source.depth[i])
        depth[:6] = 65535
        write_image(tmp_path / f"frame-{i:06d}.color.jpg", source.rgb[i])
        write_image(tmp_path / f"frame-{i:06d}.depth.png", depth)
        np.savetxt(tmp_path / f"frame-{i:06d}.pose.txt", source.poses[i])
    np.savetxt(tmp_path / "camera-intrinsics.txt", CAMERA.matrix)
    sequence = open_sequence(tmp_path)
    assert guess_dataset(tmp_path) == "seven_scenes" and sequence.intrinsics == CAMERA
    same_frames(sequence, source)
    assert (sequence[3].depth[:6] == 0).all()


@pytest.mark.parametrize("style", ["nerfcapture", "nerfstudio"])
def test_transforms_json(tmp_path, style):
    """Camera, unit, axes and depth of both spellings; frames in any order; one without depth is left out."""
    source, frames = room(), []
    for i in range(len(source)):
        name = f"images/{i}" if style == "nerfcapture" else f"images/frame_{i:05d}.png"
        depth = f"images/{i}.depth.png" if style == "nerfcapture" else f"depth/frame_{i:05d}.png"
        write_image(tmp_path / (name if name.endswith("png") else f"{name}.png"), source.rgb[i])
        write_image(tmp_path / depth, stored(source.depth[i], 6553.5 if style == "nerfcapture" else 1000))
        matrix = (source.poses[i] @ FLIP).tolist()
        frame = {"file_path": name, "transform_matrix": matrix if style == "nerfcapture" else matrix[:3]}
        frames.append(frame | ({"depth_path": depth, "timestamp": i / 30} if style == "nerfcapture" else {}))
    frames = frames[::-1] + [{"file_path": "images/none.png"}]
    fields = {"fl_x": 60.0, "fl_y": 60.0, "cx": 39.5, "cy": 29.5, "w": 80, "h": 60, "frames": frames}
    if style == "nerfcapture":
        fields["integer_depth_scale"] = 1 / 6553.5
    (tmp_path / "transforms.json").write_text(json.dumps(fields))
    assert guess_dataset(tmp_path) == "transforms"
    sequence = open_sequence(tmp_path)
    same_frames(sequence, source)
    find(check_folder(tmp_path), "files", WARNING, "1 of 25 frames")
    assert agreement(posed_pairs(sequence, sequence.ground_truth()), sequence.intrinsics) > 0.9


def test_transforms_json_without_depth(tmp_path):
    """The file is named, and where depth is looked for."""
    fields = {"fl_x": 60.0, "w": 80, "h": 60, "frames": [{"file_path": "a.png"}]}
    (tmp_path / "transforms.json").write_text(json.dumps(fields))
    with pytest.raises(DatasetError, match=r"transforms\.json: none of the 1 frames has colour and depth.*depth_path"):
        open_sequence(tmp_path)


def test_video_and_depth(tmp_path):
    """A video beside depth, numbered from 1."""
    source = room()
    write_video(tmp_path / "color.avi", source.rgb)
    for i in range(len(source) - 2):
        write_image(tmp_path / f"depth/{i + 1}.png", stored(source.depth[i]))
    camera_yaml(tmp_path)
    sequence = open_sequence(tmp_path)
    assert guess_dataset(tmp_path) == "video"
    same_frames(sequence, Room(source.rgb[:22], source.depth[:22], source.poses[:22]), poses=False)
    find(check_folder(tmp_path), "association", WARNING, "24 frames, depth/ 22")


# -- lists and files -------------------------------------------------------------------------------------------------

CLOCKS = {
    "hundredths": [f"{i / 30:.2f}" for i in range(24)],
    "hz60": [f"{i / 60:.6f}" for i in range(24)],
    "nanoseconds": [f"{1403636579763555584 + i * 33333333}" for i in range(24)],
    "microseconds": [f"{1403636579763555 + i * 33333}" for i in range(24)],
    "milliseconds": [f"{1403636579763 + i * 33}" for i in range(24)],
    "frame numbers": [f"{i}" for i in range(24)],
    "comma": [f"{100 + i / 30:.6f}".replace(".", ",") for i in range(24)],
}


@pytest.mark.parametrize("clock", CLOCKS)
def test_clocks(tmp_path, clock):
    """Every frame of every clock is used, and times come out in seconds."""
    write_lists(tmp_path, room(), CLOCKS[clock])
    sequence = open_sequence(tmp_path)
    assert len(sequence) == 24
    assert 1 / 61 < np.median(np.diff(sequence.timestamps)) < 1 / 29
    report = check_folder(tmp_path)
    if clock.endswith("seconds") or clock == "frame numbers":
        find(report, "clock", OK, clock if clock != "frame numbers" else "counts frames")
    assert not report.errors and not report.warnings


def test_nanoseconds_with_truth_in_seconds(tmp_path):
    """Each list may have a unit of its own."""
    source = room()
    write_lists(tmp_path, source, CLOCKS["nanoseconds"], [f"{int(t) + 4_000_000}" for t in CLOCKS["nanoseconds"]])
    write_tum_poses(tmp_path / "groundtruth.txt", source, 1403636579.763555584 + np.arange(24) / 30)
    sequence = open_sequence(tmp_path)
    same_frames(sequence, source)
    assert sequence.depth_timestamps[0] - sequence.timestamps[0] == pytest.approx(0.004, abs=1e-6)


def test_depth_that_comes_slowly(tmp_path):
    """A depth image for every third colour image: every frame is used, and it is said."""
    write_lists(tmp_path, room(), [f"{50 + i / 30:.6f}" for i in range(24)], every=3)
    assert len(open_sequence(tmp_path)) == 24
    find(check_folder(tmp_path), "depth rate", WARNING, r"16 of 24 frames share .*--frames ::3")


def test_names_with_blanks_and_latin_comments(tmp_path):
    """What other programs write into rgb.txt."""
    write_lists(tmp_path, room(), [f"{i / 30:.6f}" for i in range(24)])
    (tmp_path / "rgb").rename(tmp_path / "my images")
    text = (tmp_path / "rgb.txt").read_text().replace("rgb/", "my images/")
    (tmp_path / "rgb.txt").write_bytes("# größe\n".encode("latin-1") + text.encode())
    assert len(open_sequence(tmp_path)) == 24


def test_stray_files(tmp_path):
    """A text log, a preview, and a listed image that is missing are stepped over and named."""
    source = room()
    folder = write_own(tmp_path / "log", source)
    (folder / "rs-convert.log").write_text("24/01 17:58:59,736 WARNING [16332] no matcher\n24/01 17:59:02,112 done\n")
    assert len(open_sequence(folder)) == 24
    find(check_folder(folder), "stray files", OK, "rs-convert.log")
    folder = write_own(tmp_path / "preview", source)
    for kind in ("color", "depth"):
        shutil.copy(folder / kind / "000002.png", folder / kind / "preview.png")
    same_frames(open_sequence(folder), source, poses=False)
    find(check_folder(folder), "stray files", WARNING, "2 files .*color/preview.png, depth/preview.png")
    folder = write_lists(tmp_path / "missing", source, [f"{i / 30:.6f}" for i in range(24)])
    (folder / "rgb/0007.png").unlink()
    sequence = open_sequence(folder)
    assert len(sequence) == 23 and sequence[7].timestamp == pytest.approx(8 / 30, abs=1e-6)
    find(check_folder(folder), "files", WARNING, r"1 of 24 images listed in rgb\.txt are missing: .*0007\.png")


# -- arrays ----------------------------------------------------------------------------------------------------------

RGB, DEPTH = np.full((60, 80, 3), 90, np.uint8), np.full((60, 80), 2.0, np.float32)


@pytest.mark.parametrize(
    ("rgb", "depth", "pattern"),
    [
        (RGB.transpose(2, 0, 1), DEPTH, r"\(3, 60, 80\), which is \(3, H, W\): pass \(H, W, 3\).*transpose\(1, 2, 0\)"),
        (RGB[None], DEPTH, r"\(1, H, W, 3\): pass \(H, W, 3\)"),
        (RGB, DEPTH[None], r"depth has shape \(1, 60, 80\): pass \(H, W\)"),
        (RGB, DEPTH[..., None], r"depth has shape \(60, 80, 1\): pass \(H, W\)"),
        (RGB.transpose(1, 0, 2), DEPTH, r"the first axis is the row"),
        (RGB.astype(np.float32), DEPTH, r"values up to 90: pass uint8, or float in \[0, 1\]"),
    ],
)
def test_layouts_that_no_frame_would_mend(rgb, depth, pattern):
    """Arrays of other packages raise, and the order of the axes is named; it is no run of skipped frames."""
    with pytest.raises(InputError, match=pattern) as caught:
        read_images(rgb, depth, CAMERA, 10.0)
    assert type(caught.value) is InputError


def test_float_depth_in_millimetres_is_told():
    """Not that there is none within ten metres."""
    with pytest.raises(InputError, match="median depth is 2000 m: is it in millimetres"):
        read_images(RGB, DEPTH * 1000, CAMERA, 10.0)
