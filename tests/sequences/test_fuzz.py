"""Readers against damaged folders: no crash, no hang, and nothing wrong that passes for right."""

from __future__ import annotations

import json
import shutil
import zlib

import cv2
import numpy as np
import pytest

from tests.sequences import writers
from tests.sequences.mutations import damage
from warpslam.errors import DatasetError, WarpSlamError
from warpslam.poses import check_transform
from warpslam.sequences import open_sequence
from warpslam.sequences.checking import check_folder

ROUNDS = 90
"""Damaged folders of each of the seven formats."""
TIMES = [1.0, 1.1, 1.2]


def write_azure(folder):
    writers.write_color_depth(folder, "color")
    writers.write_log(folder / "scene" / "trajectory.log", {i: writers.make_pose(i) for i in range(3)})
    camera = {"width": writers.WIDTH, "height": writers.HEIGHT, "intrinsic_matrix": [20, 0, 0, 0, 21, 0, 11.5, 7.5, 1]}
    (folder / "intrinsic.json").write_text(json.dumps(camera))


def write_icl(folder):
    writers.write_color_depth(folder, "image")
    writers.write_log(folder / "trajectory.log", {i: writers.make_pose(i) for i in range(3)})
    (folder / "camera.yaml").write_text(writers.CAMERA_YAML)


FORMATS = {
    "replica": writers.write_replica,
    "tum_rgbd": lambda folder: writers.write_tum(folder, TIMES, TIMES, TIMES),
    "scannet": writers.write_scannet,
    "cofusion": writers.write_cofusion,
    "seven_scenes": writers.write_seven_scenes,
    "icl": write_icl,
    "azure": write_azure,
}
OWN_CAMERA = ("replica", "icl", "azure")


def check_frame(frame, sequence, dataset, is_exact):
    """What a frame promises; and, where no image was exchanged for another, that colour and depth are partners."""
    height, width = sequence.intrinsics.height, sequence.intrinsics.width
    assert frame.rgb.shape == (height, width, 3) and frame.rgb.dtype == np.uint8
    assert frame.depth.shape == (height, width) and frame.depth.dtype == np.float32
    assert np.isfinite(frame.depth).all() or dataset == "cofusion"
    assert (frame.depth >= 0).all() and np.isfinite(frame.timestamp)
    if frame.T_world_camera is not None:
        check_transform(frame.T_world_camera)
    if not is_exact or dataset in ("scannet", "cofusion"):  # JPEG and uncompressed EXR have no checksums
        return
    number = int(frame.rgb[0, 0, 1]) // 10
    np.testing.assert_array_equal(frame.rgb, writers.make_rgb(number))
    if sequence.calibration.depth_scale == 1000:
        depth = writers.make_depth(number).astype(np.float32) / np.float32(1000)
        wrong = frame.depth != depth
        # 7-Scenes: pixel (0, 1) was written as missing.
        assert np.count_nonzero(wrong) <= (dataset == "seven_scenes"), f"frame {number}"


@pytest.mark.parametrize("dataset", FORMATS)
def test_damaged_folders(dataset, tmp_path):
    """Reading a damaged folder gives what was written, or a typed error; `check_folder` never raises."""
    if dataset == "cofusion":
        pytest.importorskip("OpenEXR", reason="the package openexr is not installed")
    FORMATS[dataset](tmp_path / "whole")
    camera = None if dataset in OWN_CAMERA else writers.CAMERA
    refused = read = 0
    for seed in range(ROUNDS):
        folder = tmp_path / "damaged"
        shutil.copytree(tmp_path / "whole", folder)
        done = damage(folder, np.random.default_rng((seed, zlib.crc32(dataset.encode()))))
        exchanged = any(name == "take_another_files_place" for name, _ in done)
        # Depths that are not of these images would be a wrong answer of the fuzzer, not of the reader.
        lists_changed = dataset == "tum_rgbd" and any(file.suffix == ".txt" for _, file in done)
        try:
            try:
                sequence = open_sequence(folder, dataset, camera)
                sequence.ground_truth()
            except WarpSlamError:
                refused += 1
            else:
                for index in range(len(sequence)):
                    try:
                        frame = sequence[index]
                    except DatasetError:
                        refused += 1
                    else:
                        check_frame(frame, sequence, dataset, not exchanged and not lists_changed)
                        read += 1
            report = check_folder(folder, dataset, camera)
            assert report.findings and (report.frames > 0 or report.errors)
        except BaseException:
            print(f"seed {seed}: {done}")
            raise
        shutil.rmtree(folder)
    assert refused > ROUNDS / 8 and read > ROUNDS / 8


def test_every_flipped_byte_of_a_png_is_noticed(tmp_path):
    """Any single byte that changes in a depth image is an error: PNG has checksums, and they are looked at."""
    file = writers.write_replica(tmp_path) / "results" / "depth000001.png"
    sequence = open_sequence(tmp_path)
    data = file.read_bytes()
    for position in range(8, len(data)):
        changed = bytearray(data)
        changed[position] ^= 0x10
        file.write_bytes(changed)
        with pytest.raises(DatasetError, match=r"depth000001\.png"):
            sequence[1]


def test_png_with_many_chunks_is_read(tmp_path):
    """Text chunks and several data chunks, as other writers make them, are no damage."""
    from PIL import Image, PngImagePlugin

    file = writers.write_replica(tmp_path) / "results" / "depth000001.png"
    text = PngImagePlugin.PngInfo()
    text.add_text("camera", "left")
    Image.fromarray(writers.make_depth(1)).save(file, pnginfo=text)
    depth = open_sequence(tmp_path)[1].depth
    np.testing.assert_array_equal(depth, writers.make_depth(1).astype(np.float32) / 1000)
    assert cv2.imread(str(file), cv2.IMREAD_UNCHANGED).dtype == np.uint16
