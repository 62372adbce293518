"""Microsoft 7-Scenes: frame-000000.color.png, frame-000000.depth.png, frame-000000.pose.txt in one folder."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from warpslam.errors import DatasetError
from warpslam.sequences.calibration import find_calibration
from warpslam.sequences.files import FileSequence, check_partners
from warpslam.sequences.image_files import list_images, read_depth
from warpslam.sequences.pose_files import read_matrix_file

_INVALID_DEPTH = 65535


class SevenScenesSequence(FileSequence):
    """A folder seq-NN of 7-Scenes; depth is in millimetres, 0 and 65535 are missing."""

    preset = "seven_scenes"

    def __init__(self, folder: Path, camera: str | None = None) -> None:
        rgb_files = list_images(folder, "frame-*.color.png")
        depth_files = list_images(folder, "frame-*.depth.png")
        if len(rgb_files) == len(depth_files):
            check_partners(rgb_files, depth_files)
        super().__init__(
            folder,
            find_calibration(folder, camera, "seven_scenes"),
            rgb_files,
            depth_files,
            poses=_read_poses(rgb_files),
        )

    def read_depth_metres(self, path: Path) -> np.ndarray:
        """Stored depth image in metres, float32, shape (H, W), 0 = missing."""
        stored = read_depth(path, self._check_depth_size)
        stored[stored == _INVALID_DEPTH] = 0
        return stored.astype(np.float32) / np.float32(self.calibration.depth_scale)


def _read_poses(rgb_files: list[Path]) -> np.ndarray | None:
    files = [file.with_name(file.name.replace(".color.png", ".pose.txt")) for file in rgb_files]
    missing = [file for file in files if not file.is_file()]
    if len(missing) == len(files):
        return None
    if missing:
        raise DatasetError(f"{missing[0]}: missing, while other frames have a pose; complete or remove the pose files")
    return np.stack([read_matrix_file(file) for file in files])
