"""SUN3D and SUN RGB-D: image/, depth/ with rotated bits, intrinsics.txt and extrinsics/<time>.txt."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from warpslam.errors import DatasetError
from warpslam.sequences.base import Remark
from warpslam.sequences.files import FileSequence
from warpslam.sequences.image_files import list_images, natural_key, read_depth
from warpslam.sequences.pairing import pair
from warpslam.sequences.pose_files import as_pose
from warpslam.sequences.recorder_files import find_recorded
from warpslam.storage.text_lines import read_numbers


class Sun3dSequence(FileSequence):
    """A SUN3D folder. The 16 bits of depth are rotated left by three; poses are camera to world, three lines each."""

    preset = "icl"

    def __init__(self, folder: Path, camera: str | None = None) -> None:
        pairs = pair(folder, list_images(folder / "image"), list_images(folder / "depth"))
        poses = _read_poses(folder / "extrinsics")
        remarks = pairs.remarks
        if poses is not None and len(poses) != pairs.rgb_count:
            text = f"extrinsics holds {len(poses)} poses of {pairs.rgb_count} frames: they are not used"
            poses, remarks = None, (*remarks, Remark("poses", text, "complete the file"))
        super().__init__(
            folder,
            find_recorded(folder, camera, None, pairs.rgb_files, pairs.depth_files, "intrinsics.txt is missing. "),
            pairs.rgb_files,
            pairs.depth_files,
            poses=pairs.poses(poses),
            remarks=remarks,
        )

    def read_depth_metres(self, path: Path) -> np.ndarray:
        """Stored depth image in metres, float32, shape (H, W), 0 = missing."""
        stored = read_depth(path, self._check_depth_size)
        if stored.dtype != np.uint16:
            raise DatasetError(f"{path}: depth of SUN3D is a 16-bit PNG; name another format with --dataset")
        return self.metres((stored >> 3) | (stored << 13))


def _read_poses(folder: Path) -> np.ndarray | None:
    files = sorted(folder.glob("*.txt"), key=natural_key)
    if not files:
        return None
    path = files[-1]  # named by the time it was made; the last is the best
    rows = [values for _, values in read_numbers(path, 4, "one row of a 3x4 matrix")]
    if len(rows) % 3:
        raise DatasetError(f"{path}: {len(rows)} lines are no whole number of 3x4 matrices; complete the file")
    matrices = np.array(rows, dtype=np.float64).reshape(-1, 3, 4)
    bottom = np.array([[0.0, 0.0, 0.0, 1.0]])
    return np.array([as_pose(path, 3 * i + 1, np.vstack([T, bottom])) for i, T in enumerate(matrices)])
