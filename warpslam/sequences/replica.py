"""Replica as rendered for iMAP and NICE-SLAM: results/frame000000.jpg, results/depth000000.png, traj.txt."""

from __future__ import annotations

from pathlib import Path

from warpslam.sequences.files import FileSequence
from warpslam.sequences.image_files import DEPTH_SUFFIXES, list_images
from warpslam.sequences.pairing import pair
from warpslam.sequences.pose_files import read_matrix_lines
from warpslam.sequences.recorder_files import find_recorded


class ReplicaSequence(FileSequence):
    """A Replica folder; traj.txt has one row-major camera-to-world matrix a frame and may be missing.

    The same layout is what `warpslam.synthetic` writes, with the camera in camera.yaml.
    """

    preset = "replica"

    def __init__(self, folder: Path, camera: str | None = None) -> None:
        results, trajectory = folder / "results", folder / "traj.txt"
        pairs = pair(folder, list_images(results, "frame*"), list_images(results, "depth*", DEPTH_SUFFIXES))
        poses = read_matrix_lines(trajectory) if trajectory.is_file() else None
        super().__init__(
            folder,
            find_recorded(folder, camera, "replica", pairs.rgb_files, pairs.depth_files),
            pairs.rgb_files,
            pairs.depth_files,
            poses=pairs.poses(poses, trajectory),
            remarks=pairs.remarks,
        )
