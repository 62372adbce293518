"""Replica as rendered for iMAP and NICE-SLAM: results/frame000000.jpg, results/depth000000.png, traj.txt."""

from __future__ import annotations

from pathlib import Path

from warpslam.sequences.calibration import find_calibration
from warpslam.sequences.files import FileSequence, check_partners
from warpslam.sequences.image_files import list_images
from warpslam.sequences.pose_files import read_matrix_lines


class ReplicaSequence(FileSequence):
    """A Replica folder; traj.txt has one row-major camera-to-world matrix a frame and may be missing.

    The same layout is what `warpslam.synthetic` writes, with the camera in camera.yaml.
    """

    preset = "replica"

    def __init__(self, folder: Path, camera: str | None = None) -> None:
        rgb_files = list_images(folder / "results", "frame*")
        depth_files = list_images(folder / "results", "depth*", (".png",))
        if len(rgb_files) == len(depth_files):
            check_partners(rgb_files, depth_files)
        trajectory = folder / "traj.txt"
        super().__init__(
            folder,
            find_calibration(folder, camera, "replica"),
            rgb_files,
            depth_files,
            poses=read_matrix_lines(trajectory) if trajectory.is_file() else None,
        )
