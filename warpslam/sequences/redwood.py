"""Redwood and augmented ICL-NUIM: image/, depth/ and, where there is one, a trajectory in Redwood's .log format."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from warpslam.errors import DatasetError
from warpslam.reading import TEXT_LIMIT, read_bytes
from warpslam.sequences.base import Remark
from warpslam.sequences.files import FileSequence
from warpslam.sequences.image_files import DEPTH_SUFFIXES, list_images, natural_key
from warpslam.sequences.pairing import pair
from warpslam.sequences.pose_files import read_redwood_log
from warpslam.sequences.recorder_files import find_recorded


class RedwoodSequence(FileSequence):
    """Folders image/ and depth/ (millimetres). Poses: the optimised trajectory of Open3D, else any .log."""

    preset = "icl"

    def __init__(self, folder: Path, camera: str | None = None) -> None:
        candidates = [folder / name for name in ("image", "color", "rgb")]
        rgb_files = list_images(next((child for child in candidates if child.is_dir()), candidates[0]))
        pairs = pair(folder, rgb_files, list_images(folder / "depth", suffixes=DEPTH_SUFFIXES))
        patterns = ("test_slac/*/optimized_trajectory_slac.log", "trajectory.log", "*/trajectory.log", "*.log")
        poses, remarks = find_log_poses(folder, patterns, pairs.rgb_count)
        super().__init__(
            folder,
            find_recorded(folder, camera, "icl", pairs.rgb_files, pairs.depth_files),
            pairs.rgb_files,
            pairs.depth_files,
            poses=pairs.poses(poses),
            remarks=(*pairs.remarks, *remarks),
        )


def find_log_poses(
    folder: Path, patterns: Sequence[str], frame_count: int
) -> tuple[np.ndarray | None, tuple[Remark, ...]]:
    """Poses (frame_count, 4, 4) of the first .log file that one of the ``patterns`` finds, None without one.

    Programs write their own .log files, too: one that is named for no trajectory and does not begin like one is left
    aside, and named.
    """
    aside: list[Path] = []
    for pattern in patterns:
        for file in sorted(folder.glob(pattern), key=natural_key):
            if "trajectory" in file.name or _begins_like_a_trajectory(file):
                return read_redwood_log(file, frame_count), _aside(aside)
            aside.append(file)
    return None, _aside(aside)


def _begins_like_a_trajectory(path: Path) -> bool:
    try:
        lines = read_bytes(path, TEXT_LIMIT).splitlines()
    except OSError as error:
        raise DatasetError(f"{path}: can't be read as text ({error}); fetch the file again") from error
    words = next((line for line in lines if line.strip() and not line.startswith(b"#")), b"").split()
    return bool(words) and all(word.lstrip(b"-").replace(b".", b"").isdigit() for word in words)


def _aside(files: list[Path]) -> tuple[Remark, ...]:
    if not files:
        return ()
    names = ", ".join(dict.fromkeys(file.name for file in files))
    return (Remark("stray files", f"no trajectory, left aside: {names}", is_fine=True),)
