"""TUM RGB-D benchmark: rgb.txt, depth.txt and groundtruth.txt (or pose.txt), each line starting with a time."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np

from warpslam.errors import DatasetError
from warpslam.sequences.calibration import find_calibration
from warpslam.sequences.files import FileSequence
from warpslam.sequences.pose_files import read_tum_poses
from warpslam.storage.text_lines import read_lines
from warpslam.storage.tum import nearest

MAX_TIME_DIFFERENCE = 0.08
"""Colour, depth and pose of a frame lie within this time [s] of each other."""
MIN_SPACING = 1.0 / 32.0
"""Frames closer [s] than this to the last kept one are dropped."""


class TumRgbdSequence(FileSequence):
    """A TUM RGB-D folder; poses stay in the world frame of the motion capture system."""

    preset = "tum_rgbd"

    def __init__(self, folder: Path, camera: str | None = None) -> None:
        rgb_times, rgb_files = _read_list(folder / "rgb.txt")
        depth_times, depth_files = _read_list(folder / "depth.txt")
        depth_index, depth_gap = nearest(rgb_times, depth_times)
        keep = depth_gap < MAX_TIME_DIFFERENCE
        pose_file = next((file for file in (folder / "groundtruth.txt", folder / "pose.txt") if file.is_file()), None)
        poses = None
        if pose_file is not None:
            pose_times, all_poses = read_tum_poses(pose_file)
            if not len(pose_times):
                raise DatasetError(f"{pose_file}: holds no pose; fetch it again or remove it")
            pose_index, pose_gap = nearest(rgb_times, pose_times)
            keep &= pose_gap < MAX_TIME_DIFFERENCE
        remarks = []
        if not keep.all():
            partner = "depth image" if pose_file is None else "depth image and pose"
            remarks.append(
                f"{np.count_nonzero(~keep)} of {len(keep)} colour images of rgb.txt have no {partner} within "
                f"{MAX_TIME_DIFFERENCE} s, the first at {rgb_times[~keep][0]:.6f} s"
            )
        kept = _thin_out(rgb_times, np.flatnonzero(keep))
        if not len(kept):
            raise DatasetError(
                f"{folder}: no colour image of rgb.txt has depth and pose within {MAX_TIME_DIFFERENCE} s; "
                "check that the lists belong to one recording"
            )
        if pose_file is not None:
            poses = all_poses[pose_index[kept]]
        frames = [(rgb_files[i], depth_files[depth_index[i]]) for i in kept]
        for file in (file for frame in frames for file in frame):
            if not file.is_file():
                raise DatasetError(f"{file}: listed in rgb.txt or depth.txt but missing; complete the download")
        super().__init__(
            folder,
            find_calibration(
                folder,
                camera,
                _camera_of(folder),
                "The name of a TUM folder tells its camera (freiburg1, fr2, ...), and this one does not. ",
            ),
            [rgb for rgb, _ in frames],
            [depth for _, depth in frames],
            poses=poses,
            timestamps=rgb_times[kept],
            depth_timestamps=depth_times[depth_index[kept]],
            remarks=remarks,
        )


def _camera_of(folder: Path) -> str | None:
    resolved = folder.resolve()
    for name in (resolved.name, resolved.parent.name):
        match = re.search(r"(?:^|[^a-z])(?:fr|freiburg)[_-]?([123])(?:$|[^0-9])", name.lower())
        if match:
            return f"tum_fr{match.group(1)}"
    return None


def _read_list(path: Path) -> tuple[np.ndarray, list[Path]]:
    entries = []
    for number, words in read_lines(path):
        try:
            time = float(words[0])
        except ValueError:
            time = math.nan
        if len(words) != 2 or not math.isfinite(time):
            raise DatasetError(f"{path}:{number}: {' '.join(words)!r} is not 'time file'; correct the line")
        entries.append((time, path.parent / words[1]))
    if not entries:
        raise DatasetError(f"{path}: lists no images; fetch the file again")
    entries.sort()
    return np.array([time for time, _ in entries]), [file for _, file in entries]


def _thin_out(times: np.ndarray, candidates: np.ndarray) -> np.ndarray:
    kept: list[int] = []
    for index in candidates:
        if not kept or times[index] - times[kept[-1]] > MIN_SPACING:
            kept.append(int(index))
    return np.array(kept, dtype=int)
