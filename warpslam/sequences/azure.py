"""NICE-SLAM's Apartment, and recordings of one's own: color/, depth/ and, where there is one, scene/trajectory.log."""

from __future__ import annotations

import os
from pathlib import Path

from warpslam.sequences.files import FileSequence
from warpslam.sequences.image_files import DEPTH_SUFFIXES, list_images
from warpslam.sequences.pairing import pair
from warpslam.sequences.recorder_files import find_recorded
from warpslam.sequences.redwood import find_log_poses


class AzureSequence(FileSequence):
    """Folders color/ and depth/ (millimetres), as Open3D's recorder writes them.

    The camera is the argument, else camera.yaml, else the recorder's intrinsic.json. Only a folder named Apartment has
    a built-in one: a camera guessed for a recording of one's own would bend the map without a word.
    """

    preset = "apartment"

    def __init__(self, folder: Path, camera: str | None = None) -> None:
        pairs = pair(folder, list_images(folder / "color"), list_images(folder / "depth", suffixes=DEPTH_SUFFIXES))
        path = Path(os.path.abspath(folder))
        is_apartment = "apartment" in f"{path.parent.name}/{path.name}".lower()
        remedy = "Only a folder named Apartment has a built-in camera. "
        calibration = find_recorded(
            folder, camera, "azure" if is_apartment else None, pairs.rgb_files, pairs.depth_files, remedy
        )
        patterns = ("scene/trajectory.log", "trajectory.log", "*.log")
        poses, remarks = find_log_poses(folder, patterns, pairs.rgb_count)
        super().__init__(
            folder,
            calibration,
            pairs.rgb_files,
            pairs.depth_files,
            poses=pairs.poses(poses),
            remarks=(*pairs.remarks, *remarks),
        )
