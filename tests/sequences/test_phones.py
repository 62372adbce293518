"""What apps of phones write, and ScanNet's file: written here as they do, and read back."""

from __future__ import annotations

import json
import struct
import zipfile
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.sequences.recordings import CAMERA, FLIP, Room, enlarged, room, stored
from tests.sequences.test_cases import find, same_frames
from tests.sequences.writers import write_image
from warpslam.errors import DatasetError
from warpslam.poses import vector_from_pose
from warpslam.sequences import guess_dataset, open_sequence
from warpslam.sequences.checking import OK, WARNING, check_folder

FACTOR = 5.0
LARGE = CAMERA.scaled(int(CAMERA.width * FACTOR), int(CAMERA.height * FACTOR))


def doubtful() -> np.ndarray:
    """Confidence of a depth image: none in the first columns."""
    confidence = np.full((CAMERA.height, CAMERA.width), 2, np.uint8)
    confidence[:, :5] = 0
    return confidence


# -- Record3D --------------------------------------------------------------------------------------------------------


def write_record3d(folder: Path, source: Room) -> Path:
    """An unpacked .r3d."""
    lzfse = pytest.importorskip("lzfse", reason="the package lzfse is not installed")
    (folder / "rgbd").mkdir(parents=True)
    for i, image in enumerate(enlarged(source, FACTOR)):
        write_image(folder / f"rgbd/{i}.jpg", image)
        (folder / f"rgbd/{i}.depth").write_bytes(lzfse.compress(source.depth[i].astype("<f4").tobytes()))
        (folder / f"rgbd/{i}.conf").write_bytes(lzfse.compress(doubtful().tobytes()))
    rows = [vector_from_pose(T @ FLIP) for T in source.poses]
    fields = {
        "w": LARGE.width, "h": LARGE.height, "dw": CAMERA.width, "dh": CAMERA.height, "fps": 60,
        "K": LARGE.matrix.T.ravel().tolist(), "poses": [[*row[1:4], row[0], *row[4:]] for row in rows],
    }  # fmt: skip
    (folder / "metadata").write_text(json.dumps(fields))
    return folder


@pytest.mark.parametrize("is_packed", [False, True])
def test_record3d(tmp_path, is_packed):
    """A file and a folder: float depth, confidence, camera of the larger colour, axes, rate."""
    source = room()
    path = write_record3d(tmp_path / "scan", source)
    if is_packed:
        with zipfile.ZipFile(tmp_path / "scan.r3d", "w") as archive:
            for file in path.rglob("*"):
                archive.write(file, file.relative_to(path).as_posix())
        path = tmp_path / "scan.r3d"
    assert guess_dataset(path) == "record3d"
    sequence = open_sequence(path)
    assert sequence.name == "scan" and sequence.intrinsics == CAMERA
    same_frames(sequence, source)
    assert (sequence[2].depth[:, :5] == 0).all() and sequence[2].timestamp == pytest.approx(2 / 60)
    np.testing.assert_array_equal(sequence[2].depth[:, 5:], source.depth[2][:, 5:])
    find(check_folder(path), "poses", OK, "OpenGL axes, as 9.% of the depth confirms")


def test_damaged_record3d(tmp_path):
    """No archive, and a depth image that was cut off."""
    (tmp_path / "a.r3d").write_bytes(b"PK\x03\x04nothing")
    with pytest.raises(DatasetError, match=r"a\.r3d: can't be read as \.r3d"):
        open_sequence(tmp_path / "a.r3d")
    folder = write_record3d(tmp_path / "b", room())
    sequence = open_sequence(folder)
    file = folder / "rgbd/3.depth"
    file.write_bytes(file.read_bytes()[:50])
    with pytest.raises(DatasetError, match=r"rgbd/3\.depth is damaged"):
        sequence[3]


# -- Polycam, 3D Scanner App -----------------------------------------------------------------------------------------


def write_polycam(folder: Path, source: Room, prefix: str) -> Path:
    """Raw data of Polycam, named by time."""
    for i, image in enumerate(enlarged(source, FACTOR)):
        name, keyframes = str(1_650_000_000_000 + 100 * i), folder / "keyframes"
        write_image(keyframes / f"{prefix}images/{name}.jpg", image)
        write_image(keyframes / f"depth/{name}.png", stored(source.depth[i]))
        write_image(keyframes / f"confidence/{name}.png", doubtful() * 127)
        T = source.poses[i] @ FLIP
        fields = {f"t_{row}{column}": T[row, column] for row in range(3) for column in range(4)}
        fields |= {name: value + (i % 3 - 1) * (name == "fx") for name, value in vars(LARGE).items()}
        (keyframes / f"{prefix}cameras").mkdir(parents=True, exist_ok=True)
        (keyframes / f"{prefix}cameras/{name}.json").write_text(json.dumps(fields))
    return folder


@pytest.mark.parametrize("prefix", ["", "corrected_"])
def test_polycam(tmp_path, prefix):
    """Cameras in files of their own, confidence, axes; times from names."""
    source = room()
    write_polycam(tmp_path, source, prefix)
    assert guess_dataset(tmp_path) == "polycam"
    sequence = open_sequence(tmp_path)
    assert sequence.intrinsics.fx == pytest.approx(60) and sequence.intrinsics.width == 80
    same_frames(sequence, source)
    assert (sequence[2].depth[:, :5] == 0).all()
    np.testing.assert_allclose(np.diff(sequence.timestamps), 0.1, atol=1e-6)


def test_scanner_app(tmp_path):
    """Colour for every second depth image only, a camera and a pose with each."""
    source = room()
    for i, image in enumerate(enlarged(source, FACTOR)):
        write_image(tmp_path / f"depth_{i:05d}.png", stored(source.depth[i]))
        write_image(tmp_path / f"conf_{i:05d}.png", doubtful())
        if i % 2 == 0:
            write_image(tmp_path / f"frame_{i:05d}.jpg", image)
            pose = (source.poses[i] @ FLIP).ravel().tolist()
            fields = {"intrinsics": LARGE.matrix.ravel().tolist(), "cameraPoseARFrame": pose, "time": 5 + i / 60}
            (tmp_path / f"frame_{i:05d}.json").write_text(json.dumps(fields))
    assert guess_dataset(tmp_path) == "scanner_app"
    sequence = open_sequence(tmp_path)
    assert sequence.intrinsics == CAMERA
    same_frames(sequence, Room(source.rgb[::2], source.depth[::2], source.poses[::2]))
    assert (sequence[2].depth[:, :5] == 0).all() and sequence[2].timestamp == pytest.approx(5 + 4 / 60)
    assert not check_folder(tmp_path).errors


@pytest.mark.parametrize("kind", ["polycam", "scanner"])
def test_a_camera_file_that_is_damaged(tmp_path, kind):
    """The file is named."""
    source = room()
    if kind == "polycam":
        write_polycam(tmp_path, source, "")
        victim = next((tmp_path / "keyframes/cameras").iterdir())
    else:
        write_image(tmp_path / "frame_00000.jpg", source.rgb[0])
        write_image(tmp_path / "depth_00000.png", stored(source.depth[0]))
        victim = tmp_path / "frame_00000.json"
    victim.write_text('{"fx": 1')
    with pytest.raises(DatasetError, match=rf"{victim.name}: can't be read as a "):
        open_sequence(tmp_path)


# -- .sens -----------------------------------------------------------------------------------------------------------


def write_sens(path: Path, source: Room, *, color_kind: int = 2, depth_kind: int = 1, factor: float = 2.0) -> Path:
    """Version 4, as the SensReader of ScanNet has it."""
    images = enlarged(source, factor)
    height, width = images.shape[1:3]
    name = b"StructureSensor"
    matrices = []
    for sx, sy in ((width / 80, height / 60), (1, 1)):
        K = np.eye(4, dtype="<f4")
        K[:3, :3] = np.diag([sx, sy, 1]) @ CAMERA.matrix
        matrices += [K.tobytes(), np.eye(4, dtype="<f4").tobytes()]
    header = struct.pack("<IQ", 4, len(name)) + name + b"".join(matrices)
    header += struct.pack("<ii4IfQ", color_kind, depth_kind, width, height, 80, 60, 1000.0, len(source))
    body = b""
    for i in range(len(source)):
        pose = np.full((4, 4), -np.inf) if i == 3 else source.poses[i]
        bgr = np.ascontiguousarray(images[i][..., ::-1])
        color = (
            images[i].tobytes()
            if color_kind == 0
            else cv2.imencode({1: ".png", 2: ".jpg"}[color_kind], bgr)[1].tobytes()
        )
        depth = stored(source.depth[i]).tobytes()
        depth = zlib.compress(depth) if depth_kind == 1 else depth
        times = (1_000_000 + 33_333 * i, 1_002_000 + 33_333 * i)
        body += pose.astype("<f4").tobytes() + struct.pack("<4Q", *times, len(color), len(depth)) + color + depth
    path.write_bytes(header + body)
    return path


@pytest.mark.parametrize(("color_kind", "depth_kind"), [(2, 1), (1, 0), (0, 0)])
def test_sens(tmp_path, color_kind, depth_kind):
    """All compressions but Occipital's own; colour through its own camera, times in microseconds, -inf unknown."""
    source = room()
    path = write_sens(tmp_path / "scene.sens", source, color_kind=color_kind, depth_kind=depth_kind)
    assert guess_dataset(path) == "sens"
    sequence = open_sequence(path)
    assert sequence.intrinsics == CAMERA.cropped(1) and len(sequence) == len(source) and sequence.name == "scene"
    frame = sequence[7]
    inner = slice(1, -1), slice(1, -1)
    np.testing.assert_allclose(frame.depth, source.depth[7][inner], atol=6e-4)
    assert np.abs(frame.rgb.astype(int) - source.rgb[7][inner]).mean() < 8
    np.testing.assert_allclose(frame.T_world_camera, source.poses[7], atol=1e-5)
    assert sequence[3].T_world_camera is None
    assert frame.timestamp == pytest.approx(1 + 7 * 0.033333) and frame.depth_timestamp == pytest.approx(
        frame.timestamp + 0.002
    )
    find(check_folder(path), "pose convention", OK, "9.% of the depth agrees")


def test_sens_that_is_cut_off_or_is_none(tmp_path):
    """The frames that are whole are read, a half one is named; garbage and Occipital's compression are refused."""
    path = write_sens(tmp_path / "a.sens", room())
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 3 // 4])
    sequence = open_sequence(path)
    assert 12 < len(sequence) < 24
    with pytest.raises(DatasetError, match=r"a\.sens: ends before its frames do"):
        sequence[len(sequence) - 1]
    find(check_folder(path, sample_count=None), "frames", WARNING, "ends before")
    for content in (b"", b"\x04\x00", b"<html>" * 100, data[:200]):
        path.write_bytes(content)
        with pytest.raises(DatasetError, match=r"a\.sens: can't be read (as \.sens|\(is empty)"):
            open_sequence(path)
    with pytest.raises(DatasetError, match="compression 2, 2 is not read"):
        write_sens(path, room(), depth_kind=2)
        open_sequence(path)


# -- files that are no sequences -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "pattern"),
    [
        ("a.mkv", r"azure_kinect_mkv_reader\.py --input .*a\.mkv"),
        ("a.mp4", "put it into a folder beside depth/"),
        ("a.zip", "unpack it"),
        ("a.xyz", r"is a file; pass the folder .* or one of \.bag, .*\.sens"),
    ],
)
def test_a_file_is_named_for_what_it_is(tmp_path, name, pattern):
    """And what reads it."""
    (tmp_path / name).write_bytes(b"x")
    with pytest.raises(DatasetError, match=pattern):
        open_sequence(tmp_path / name)
