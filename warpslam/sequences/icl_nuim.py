"""ICL-NUIM as published ("TUM RGB-D compatible PNGs"): rgb/0.png, depth/0.png, associations.txt, *.gt.freiburg."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from warpslam.sequences.base import Remark
from warpslam.sequences.files import FileSequence
from warpslam.sequences.pose_files import read_tum_poses
from warpslam.sequences.recorder_files import find_recorded
from warpslam.sequences.time_lists import read_association

MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
"""Takes a world and a camera whose y axis points up, which makes them left-handed, into right-handed ones."""


class IclNuimSequence(FileSequence):
    """An ICL-NUIM folder: camera 481.2, 480 (published with fy < 0), 5000 units a metre, times that count frames.

    Published poses belong to a camera and a world with y up; both are mirrored, T -> M T M.
    """

    preset = "icl"

    def __init__(self, folder: Path, camera: str | None = None) -> None:
        lists = sorted(folder.glob("associat*.txt"))
        rgb, depth = read_association(lists[0] if lists else folder / "associations.txt")
        remarks: list[Remark] = []
        rgb, depth = rgb.present(remarks), depth.present(remarks)
        numbers, of_rgb, of_depth = np.intersect1d(rgb.times, depth.times, return_indices=True)
        poses = None
        truth = sorted(folder.glob("*.freiburg"))
        if truth:
            times, given = read_tum_poses(truth[0])
            poses = np.full((len(numbers), 4, 4), np.nan)
            _, at, of = np.intersect1d(numbers, times, return_indices=True)
            poses[at] = MIRROR @ given[of] @ MIRROR
            text = f"{truth[0].name} is of a mirrored world (y up); poses and world are mirrored to y down"
            remarks.append(Remark("poses", text, is_fine=True))
        rgb_files, depth_files = [rgb.files[i] for i in of_rgb], [depth.files[i] for i in of_depth]
        super().__init__(
            folder,
            find_recorded(folder, camera, "icl_nuim", rgb_files, depth_files),
            rgb_files,
            depth_files,
            poses=poses,
            remarks=remarks,
        )
