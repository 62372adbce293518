"""Redwood and augmented ICL-NUIM: image/, depth/ and, where there is one, a trajectory in Redwood's .log format."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from warpslam.sequences.calibration import find_calibration
from warpslam.sequences.files import FileSequence
from warpslam.sequences.image_files import list_images, natural_key
from warpslam.sequences.pose_files import read_redwood_log


class RedwoodSequence(FileSequence):
    """Folders image/ and depth/ (millimetres). Poses: the optimised trajectory of Open3D, else any .log."""

    preset = "icl"

    def __init__(self, folder: Path, camera: str | None = None) -> None:
        candidates = [folder / name for name in ("image", "color", "rgb")]
        rgb_files = list_images(next((child for child in candidates if child.is_dir()), candidates[0]))
        patterns = ("test_slac/*/optimized_trajectory_slac.log", "trajectory.log", "*/trajectory.log", "*.log")
        super().__init__(
            folder,
            find_calibration(folder, camera, "icl"),
            rgb_files,
            list_images(folder / "depth", suffixes=(".png",)),
            poses=find_log_poses(folder, patterns, len(rgb_files)),
        )


def find_log_poses(folder: Path, patterns: Sequence[str], frame_count: int) -> np.ndarray | None:
    """Poses (frame_count, 4, 4) of the first .log file that one of the ``patterns`` finds, None without one."""
    for pattern in patterns:
        files = sorted(folder.glob(pattern), key=natural_key)
        if files:
            return read_redwood_log(files[0], frame_count)
    return None
