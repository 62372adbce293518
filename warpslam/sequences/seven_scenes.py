"""Microsoft 7-Scenes, BundleFusion, 3DMatch: frame-000000.color.png (or .jpg), .depth.png, .pose.txt in one folder."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from warpslam.sequences.base import Remark
from warpslam.sequences.files import FileSequence
from warpslam.sequences.image_files import IMAGE_SUFFIXES, list_images, read_depth
from warpslam.sequences.pairing import pair
from warpslam.sequences.pose_files import read_matrix_file
from warpslam.sequences.recorder_files import find_recorded

_INVALID_DEPTH = 65535


class SevenScenesSequence(FileSequence):
    """A folder seq-NN of 7-Scenes; depth is in millimetres, 0 and 65535 are missing.

    BundleFusion's exporter and tsdf-fusion write the same names with JPEG colour and camera-intrinsics.txt.
    """

    preset = "seven_scenes"

    def __init__(self, folder: Path, camera: str | None = None) -> None:
        rgb_files = list_images(folder, "frame-*.color.*", IMAGE_SUFFIXES)
        pairs = pair(folder, rgb_files, list_images(folder, "frame-*.depth.png"))
        poses, remarks = _read_poses(pairs.rgb_files)
        super().__init__(
            folder,
            find_recorded(folder, camera, "seven_scenes", pairs.rgb_files, pairs.depth_files),
            pairs.rgb_files,
            pairs.depth_files,
            poses=poses,
            remarks=(*pairs.remarks, *remarks),
        )

    def read_depth_metres(self, path: Path) -> np.ndarray:
        """Stored depth image in metres, float32, shape (H, W), 0 = missing."""
        stored = read_depth(path, self._check_depth_size)
        stored[stored == _INVALID_DEPTH] = 0
        return self.metres(stored)


def _read_poses(rgb_files: list[Path]) -> tuple[np.ndarray | None, tuple[Remark, ...]]:
    files = [file.with_name(file.name.split(".color.")[0] + ".pose.txt") for file in rgb_files]
    missing = [file for file in files if not file.is_file()]
    if len(missing) == len(files):
        return None, ()
    unknown = np.full((4, 4), np.nan)
    poses = np.stack([read_matrix_file(file) if file.is_file() else unknown for file in files])
    if not missing:
        return poses, ()
    named = ", ".join(file.name for file in missing[:3]) + (", ..." if len(missing) > 3 else "")
    text = f"{len(missing)} of {len(files)} frames have no pose file: {named}"
    return poses, (Remark("poses", text, "these frames have no ground truth"),)
