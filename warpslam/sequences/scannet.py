"""ScanNet, exported with its SensReader: frames/color/0.jpg, frames/depth/0.png, frames/pose/0.txt."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from warpslam.errors import DatasetError
from warpslam.sequences.calibration import find_calibration
from warpslam.sequences.files import FileSequence, check_partners
from warpslam.sequences.image_files import list_images
from warpslam.sequences.pose_files import read_matrix_file


class ScanNetSequence(FileSequence):
    """A ScanNet folder; colour is resized to the size of depth. Poses that ScanNet writes as -inf are unknown."""

    preset = "scannet"

    def __init__(self, folder: Path, camera: str | None = None) -> None:
        rgb_files = list_images(folder / "frames" / "color")
        depth_files = list_images(folder / "frames" / "depth", suffixes=(".png",))
        if len(rgb_files) == len(depth_files):
            check_partners(rgb_files, depth_files)
        pose_folder = folder / "frames" / "pose"
        super().__init__(
            folder,
            find_calibration(folder, camera, "scannet"),
            rgb_files,
            depth_files,
            poses=_read_poses(pose_folder, rgb_files) if pose_folder.is_dir() else None,
            color_size_may_differ=True,
        )


def _read_poses(pose_folder: Path, rgb_files: list[Path]) -> np.ndarray:
    poses = []
    for rgb_file in rgb_files:
        pose_file = pose_folder / f"{rgb_file.stem}.txt"
        if not pose_file.is_file():
            raise DatasetError(f"{pose_file}: no pose of {rgb_file.name}; add it or remove {pose_folder}")
        poses.append(read_matrix_file(pose_file))
    return np.stack(poses)
