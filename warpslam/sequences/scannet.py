"""ScanNet, exported with its SensReader: color/0.jpg, depth/0.png, pose/0.txt, intrinsic/, with or without frames/."""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from warpslam.sequences.base import Remark
from warpslam.sequences.calibration import Calibration, find_calibration, has_own_camera
from warpslam.sequences.files import FileSequence
from warpslam.sequences.image_files import DEPTH_SUFFIXES, list_images
from warpslam.sequences.pairing import pair
from warpslam.sequences.pose_files import read_matrix_file
from warpslam.sequences.recorder_files import from_matrix, image_size, read_matrix
from warpslam.sequences.registration import ColorCamera

_REMEDY = "There is no intrinsic/intrinsic_depth.txt, and the name is none of ScanNet's (scene0000_00). "
_COLOR = ("color", "colour", "rgb", "image")
_POSE = ("pose", "poses")
_INTRINSIC = ("intrinsic", "intrinsics")


class ScanNetSequence(FileSequence):
    """A ScanNet folder; colour is brought into the pixels of depth. Poses that ScanNet writes as -inf are unknown.

    The camera is that of intrinsic/intrinsic_depth.txt, which differs from scene to scene; the paper's code takes one
    for all, and so does `as_published`.
    """

    preset = "scannet"

    def __init__(self, folder: Path, camera: str | None = None) -> None:
        base = folder / "frames" if (folder / "frames").is_dir() else folder
        rgb_files = list_images(_first(base, _COLOR))
        pairs = pair(folder, rgb_files, list_images(base / "depth", suffixes=DEPTH_SUFFIXES))
        calibration = None
        self._is_given = camera is not None or has_own_camera(folder)
        if not self._is_given:
            calibration = _exported(_first(base, _INTRINSIC), pairs.rgb_files, pairs.depth_files)
        pose_folder = _first(base, _POSE)
        poses, remarks = (None, ()) if not pose_folder.is_dir() else _read_poses(pose_folder, pairs.rgb_files)
        super().__init__(
            folder,
            calibration or find_calibration(folder, camera, _default_camera(folder), _REMEDY),
            pairs.rgb_files,
            pairs.depth_files,
            poses=poses,
            remarks=(*pairs.remarks, *remarks),
            same_view=True,
        )

    def as_published(self) -> ScanNetSequence:
        """The sequence with the camera of the paper's code, unless another was given or images have another size."""
        published, builtin = super().as_published(), Calibration.of_dataset("scannet").as_published()
        stored = self.calibration.stored
        if not self._is_given and (stored.width, stored.height) == (builtin.stored.width, builtin.stored.height):
            published._set_calibration(builtin)
        return published


def _default_camera(folder: Path) -> str | None:
    """The built-in camera, for the layout of the paper's code and folders named as ScanNet names them: others use the
    same four folders.
    """
    path = Path(os.path.abspath(folder))
    is_scannet = (folder / "frames").is_dir() or re.search(
        r"scene\d{4}_\d\d|scannet", f"{path.parent.name}/{path.name}"
    )
    return "scannet" if is_scannet else None


def _first(base: Path, names: tuple[str, ...]) -> Path:
    return next((base / name for name in names if (base / name).is_dir()), base / names[0])


def _exported(folder: Path, rgb_files: list[Path], depth_files: list[Path]) -> Calibration | None:
    """The camera of intrinsic_depth.txt, with that of intrinsic_color.txt beside it; None without."""
    depth_file, color_file = folder / "intrinsic_depth.txt", folder / "intrinsic_color.txt"
    if not depth_file.is_file():
        return None
    # As with the built-in camera: registration leaves a border without colour or depth.
    size = image_size(depth_files, is_depth=True)
    crop = Calibration.of_dataset("scannet").crop * size[0] // 640
    calibration = from_matrix(read_matrix(depth_file), size, str(depth_file), crop=crop)
    color_size = image_size(rgb_files)
    if not color_file.is_file() or color_size == size:
        return calibration
    color = from_matrix(read_matrix(color_file), color_size, str(color_file))
    return replace(calibration, color=ColorCamera(color.stored))


def _read_poses(pose_folder: Path, rgb_files: list[Path]) -> tuple[np.ndarray, tuple[Remark, ...]]:
    poses, missing = np.full((len(rgb_files), 4, 4), np.nan), []
    for index, rgb_file in enumerate(rgb_files):
        pose_file = pose_folder / f"{rgb_file.stem}.txt"
        if pose_file.is_file():
            poses[index] = read_matrix_file(pose_file)
        else:
            missing.append(pose_file.name)
    if not missing:
        return poses, ()
    named = ", ".join(missing[:3]) + (", ..." if len(missing) > 3 else "")
    text = f"{len(missing)} of {len(rgb_files)} frames have no file in {pose_folder}: {named}"
    return poses, (Remark("poses", text, "these frames have no ground truth"),)
