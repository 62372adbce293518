"""Stray Scanner (iPhone): rgb.mp4, depth/000000.png, confidence/, camera_matrix.csv of colour, odometry.csv."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from warpslam.poses import pose_from_vector
from warpslam.sequences.base import Remark
from warpslam.sequences.files import FileSequence
from warpslam.sequences.image_files import DEPTH_SUFFIXES, list_images
from warpslam.sequences.pairing import frame_number, pair
from warpslam.sequences.pose_convention import OPENCV, OPENGL
from warpslam.sequences.recorder_files import find_recorded
from warpslam.sequences.video import Video
from warpslam.storage.text_lines import parse_numbers, read_lines


class StraySequence(FileSequence):
    """A folder of Stray Scanner, with rgb.mp4 or with its frames unpacked into rgb/ or color/.

    Depth of the lowest confidence is left out. Colour, 7.5 times as large, is brought to the size of depth.
    """

    def __init__(self, folder: Path, camera: str | None = None) -> None:
        depth_files = list_images(folder / "depth", suffixes=DEPTH_SUFFIXES)
        remarks: tuple[Remark, ...] = ()
        unpacked = next((folder / name for name in ("rgb", "color") if (folder / name).is_dir()), None)
        video = None
        if unpacked is not None:
            pairs = pair(folder, list_images(unpacked), depth_files)
            rgb_files, depth_files, remarks = pairs.rgb_files, pairs.depth_files, pairs.remarks
        else:
            video = Video(folder / "rgb.mp4")
            rgb_files = []
        numbers = np.array([frame_number(file) or 0 for file in depth_files])
        if video is not None and len(numbers) and numbers[-1] >= video.frame_count:
            text = f"rgb.mp4 has {video.frame_count} frames, depth goes up to number {numbers[-1]}"
            remarks += (Remark("association", text, "frames without colour are left out"),)
            depth_files = [file for file, n in zip(depth_files, numbers, strict=True) if n < video.frame_count]
            numbers = numbers[numbers < video.frame_count]
        times, poses = _odometry(folder / "odometry.csv", numbers)
        confidence = [folder / "confidence" / file.with_suffix(".png").name for file in depth_files]
        super().__init__(
            folder,
            find_recorded(folder, camera, None, video or rgb_files, depth_files),
            video or rgb_files,
            depth_files,
            poses=poses,
            timestamps=times,
            remarks=remarks,
            same_view=True,
            conventions=(OPENGL, OPENCV),
            confidence_files=confidence if all(file.is_file() for file in confidence) else None,
            video_frames=numbers,
        )


def _odometry(path: Path, numbers: np.ndarray) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Times [s] (N,) and poses (N, 4, 4), as stored, of frames by number; None where there is no file, or not all."""
    if not path.is_file():
        return None, None
    rows = {}
    for number, words in read_lines(path):
        if words[0].lower().startswith("timestamp"):
            continue
        values = parse_numbers(path, number, words[:9], 9, "timestamp, frame, x, y, z, qx, qy, qz, qw")
        rows[int(values[1])] = values
    poses, times = np.full((len(numbers), 4, 4), np.nan), np.full(len(numbers), np.nan)
    for i, frame in enumerate(numbers):
        if frame in rows:
            time, _, x, y, z, qx, qy, qz, qw = rows[frame]
            times[i] = time
            if np.linalg.norm((qx, qy, qz, qw)) > 1e-6:
                poses[i] = pose_from_vector(np.array([qw, qx, qy, qz, x, y, z]))
    return times if np.isfinite(times).all() else None, poses
