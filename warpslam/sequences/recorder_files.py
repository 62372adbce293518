"""Cameras that recorders and exporters leave beside the images, in files of their own."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from warpslam.errors import DatasetError, brief
from warpslam.reading import YAML_LIMIT, read_text
from warpslam.sequences.calibration import Calibration, find_calibration, has_own_camera
from warpslam.sequences.image_files import read_depth, read_rgb
from warpslam.sequences.video import Video
from warpslam.storage.text_lines import read_numbers

_JSON_FILES = ("intrinsic.json", "camera_intrinsic.json", "camera_intrinsics.json", "intrinsics.json")
_MATRIX_FILES = ("camera-intrinsics.txt", "intrinsics.txt", "intrinsic.txt", "K.txt", "camera_matrix.csv")
_MILLIMETRES = 1000.0


def find_recorded(
    folder: Path,
    camera: str | None,
    default: str | None,
    rgb_files: Sequence[Path] | Video,
    depth_files: Sequence[Path],
    remedy: str = "",
) -> Calibration:
    """Camera of the sequence in ``folder``: the argument, else camera.yaml, else a recorder's file, else ``default``.

    Raises:
        DatasetError: As `find_calibration` does, or the recorder's file can't be used.
    """
    if camera is None and not has_own_camera(folder):
        found = recorded(folder, rgb_files, depth_files)
        if found is not None:
            return found
    return find_calibration(folder, camera, default, remedy)


def recorded(folder: Path, rgb_files: Sequence[Path] | Video, depth_files: Sequence[Path]) -> Calibration | None:
    """Camera of the first file of a recorder that the folder holds; None without one."""
    for name in _JSON_FILES:
        if (folder / name).is_file():
            return from_open3d_json(folder / name)
    for name in _MATRIX_FILES:
        path = folder / name
        if path.is_file():
            size = image_size(rgb_files) if path.suffix == ".csv" else image_size(depth_files, is_depth=True)
            return from_matrix(read_matrix(path), size, str(path))
    return None


def from_open3d_json(path: Path) -> Calibration:
    """Camera of a file by Open3D: width, height, the column-major 3x3 intrinsic_matrix, and depth_scale where it is
    not 1000.
    """
    try:
        fields = json.loads(read_text(path, YAML_LIMIT))
        fx, _, _, _, fy, _, cx, cy, _ = fields["intrinsic_matrix"]
        size = {"width": fields["width"], "height": fields["height"]}
        scale = fields.get("depth_scale") or _MILLIMETRES
    except (OSError, ValueError, KeyError, TypeError, RecursionError, AttributeError) as error:
        raise DatasetError(
            f"{path}: no camera of Open3D (width, height, intrinsic_matrix with 9 numbers): {brief(repr(error))}; "
            "correct it or write a camera.yaml"
        ) from error
    if isinstance(scale, (int, float)) and 0 < scale < 1:  # metres a unit, as librealsense has it
        scale = 1 / scale
    return Calibration.from_fields({"fx": fx, "fy": fy, "cx": cx, "cy": cy, **size, "depth_scale": scale}, str(path))


def from_matrix(
    K: np.ndarray, size: tuple[int, int], source: str, depth_scale: float = _MILLIMETRES, **fields: Any
) -> Calibration:
    """Camera of a matrix K (3, 3) and the size (width, height) of its images."""
    named = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "width": size[0], "height": size[1]}
    numbers = {name: float(value) for name, value in named.items()}
    return Calibration.from_fields({**numbers, "depth_scale": depth_scale, **fields}, source)


def read_matrix(path: Path) -> np.ndarray:
    """The camera matrix (3, 3) in a text file with the rows of a 3x3 or 4x4 matrix.

    Raises:
        DatasetError: It holds something else.
    """
    for width in (3, 4):
        try:
            rows = read_numbers(path, width, "a row of the camera matrix")
        except DatasetError:
            if width == 4:
                raise
            continue
        if len(rows) >= 3:
            return np.stack([values for _, values in rows[:3]])[:, :3]
    raise DatasetError(f"{path}: no camera matrix of 3 or 4 rows; correct it or write a camera.yaml")


def image_size(files: Sequence[Path] | Video, is_depth: bool = False) -> tuple[int, int]:
    """Width and height of the first image that can be read, or of a video.

    Raises:
        DatasetError: None of the first few can.
    """
    if isinstance(files, Video):
        return files[0].shape[1], files[0].shape[0]
    error = DatasetError("no images")
    for file in files[:10]:
        try:
            image = read_depth(file) if is_depth else read_rgb(file)
            return image.shape[1], image.shape[0]
        except DatasetError as found:
            error = found
    raise error
