"""A colour video beside a folder of depth images, one a frame of the video."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from warpslam.errors import DatasetError
from warpslam.sequences.base import Remark
from warpslam.sequences.files import FileSequence
from warpslam.sequences.image_files import DEPTH_SUFFIXES, list_images
from warpslam.sequences.pairing import COMPLETE, frame_number
from warpslam.sequences.recorder_files import find_recorded
from warpslam.sequences.redwood import find_log_poses
from warpslam.sequences.video import Video

SUFFIXES = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v")


class VideoFolderSequence(FileSequence):
    """A video of any name and depth/, whose numbers count the frames of the video from the lowest (0 or 1)."""

    def __init__(self, folder: Path, camera: str | None = None) -> None:
        videos = sorted(file for file in folder.iterdir() if file.suffix.lower() in SUFFIXES)
        if len(videos) != 1:
            names = ", ".join(file.name for file in videos) or "none"
            raise DatasetError(
                f"{folder}: no images: expected one video ({', '.join(SUFFIXES)}), found {names}; keep that of colour"
            )
        video = Video(videos[0])
        depth_files = list_images(folder / "depth", suffixes=DEPTH_SUFFIXES)
        numbers = np.array([-1 if (n := frame_number(file)) is None else n for file in depth_files])
        if (np.diff(numbers) <= 0).any() or numbers[0] > 1:
            numbers = np.arange(len(depth_files))
        numbers = numbers - numbers[0]
        there = numbers < video.frame_count
        remarks = []
        if not there.all() or len(numbers) < video.frame_count:
            text = f"{videos[0].name} has {video.frame_count} frames, depth/ {len(numbers)}: those of both are used"
            remarks.append(Remark("association", text, COMPLETE))
        depth_files = [file for file, has_color in zip(depth_files, there, strict=True) if has_color]
        numbers = numbers[there]
        poses, found = find_log_poses(folder, ("trajectory.log", "*.log"), len(depth_files))
        super().__init__(
            folder,
            find_recorded(folder, camera, None, video, depth_files),
            video,
            depth_files,
            poses=poses,
            timestamps=numbers / video.rate,
            remarks=(*remarks, *found),
            video_frames=numbers,
        )
