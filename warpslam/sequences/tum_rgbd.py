"""TUM RGB-D benchmark: rgb.txt, depth.txt and groundtruth.txt (or pose.txt), each line starting with a time."""

from __future__ import annotations

import copy
import os
import re
from pathlib import Path

import numpy as np

from warpslam.errors import DatasetError
from warpslam.sequences.base import Remark
from warpslam.sequences.files import FileSequence
from warpslam.sequences.pairing import COMPLETE
from warpslam.sequences.pose_files import read_tum_poses
from warpslam.sequences.recorder_files import find_recorded
from warpslam.sequences.time_lists import ImageList, Unit, read_association, read_image_list, unit_of, unit_that_fits
from warpslam.storage.tum import nearest

MAX_TIME_DIFFERENCE = 0.08
"""Colour, depth and pose of a frame lie within this time [s] of each other."""
MIN_SPACING = 1.0 / 32.0
"""Frames closer [s] than this to the last kept one are dropped by the paper's code."""
_SHARED = 0.2  # of the frames, with the depth image of another: more is said


class TumRgbdSequence(FileSequence):
    """A TUM RGB-D folder; poses stay in the world frame of the motion capture system.

    Every colour image with a depth image near in time is a frame, with or without a pose; `as_published` leaves out
    those without one, and those closer together than the paper's code allows.
    """

    preset = "tum_rgbd"

    def __init__(self, folder: Path, camera: str | None = None) -> None:
        rgb, depth = _lists(folder)
        unit = unit_of(rgb.times)
        remarks = list(unit.remarks(rgb.path, rgb.times))
        rgb = rgb.present(remarks)
        depth = depth.present(remarks)
        times = rgb.times * unit.seconds
        depth_times = depth.times * unit_that_fits(depth.times, times, unit)
        index, gap = nearest(times, depth_times)
        keep = gap < MAX_TIME_DIFFERENCE
        if not keep.any():
            raise DatasetError(
                f"{folder}: no colour image of {rgb.path.name} has depth within {MAX_TIME_DIFFERENCE} s "
                f"(colour from {times[0]:.6f}, depth from {depth_times[0]:.6f} s); check that the lists belong to one "
                "recording and give times in seconds"
            )
        if not keep.all():
            text = f"{np.count_nonzero(~keep)} of {len(keep)} colour images of {rgb.path.name} have no depth image "
            text += f"within {MAX_TIME_DIFFERENCE} s, the first at {times[~keep][0]:.6f} s"
            remarks.append(Remark("association", text, COMPLETE))
        kept = np.flatnonzero(keep)
        remarks += _shared_depth(index[kept], gap[kept])
        pose_file = next((file for file in (folder / "groundtruth.txt", folder / "pose.txt") if file.is_file()), None)
        poses = None if pose_file is None else _poses_at(times[kept], pose_file, unit)
        rgb_files, depth_files = [rgb.files[i] for i in kept], [depth.files[index[i]] for i in kept]
        calibration = find_recorded(
            folder,
            camera,
            _camera_of(folder),
            rgb_files,
            depth_files,
            "The name of a TUM folder tells its camera (freiburg1, fr2, ...), and this one does not. ",
        )
        super().__init__(
            folder,
            calibration,
            rgb_files,
            depth_files,
            poses=poses,
            timestamps=times[kept],
            depth_timestamps=depth_times[index[kept]],
            remarks=remarks,
        )

    def as_published(self) -> TumRgbdSequence:
        """The sequence with the frames that the paper's code takes, resized and cropped as it does it."""
        published = super().as_published()
        known = np.ones(len(self), bool) if self._poses is None else np.isfinite(self._poses).all(axis=(1, 2))
        return published._subset(_thin_out(self.timestamps, np.flatnonzero(known)))

    def _subset(self, indices: np.ndarray) -> TumRgbdSequence:
        """The same sequence with some of its frames only, as if there were no others."""
        subset = copy.copy(self)
        subset._rgb_files = [self._rgb_files[i] for i in indices]
        subset._depth_files = [self._depth_files[i] for i in indices]
        subset.timestamps = self.timestamps[indices]
        subset.depth_timestamps = None if self.depth_timestamps is None else self.depth_timestamps[indices]
        subset._poses = None if self._poses is None else self._poses[indices]
        return subset


def _lists(folder: Path) -> tuple[ImageList, ImageList]:
    """Colour and depth images; from a file of associations where there is no rgb.txt."""
    if not (folder / "rgb.txt").is_file():
        for name in ("associations.txt", "association.txt", "associate.txt", "associated.txt"):
            if (folder / name).is_file():
                return read_association(folder / name)
    return read_image_list(folder / "rgb.txt"), read_image_list(folder / "depth.txt")


def _shared_depth(index: np.ndarray, gap: np.ndarray) -> list[Remark]:
    """What is to be said where depth comes more slowly than colour."""
    shared = len(index) - len(np.unique(index))
    if shared <= _SHARED * len(index):
        return []
    text = (
        f"{shared} of {len(index)} frames share their depth image with another frame, up to {1000 * gap.max():.0f} ms "
    )
    text += "from their colour: depth comes more slowly"
    step = max(2, round(len(index) / (len(index) - shared)))
    return [Remark("depth rate", text, f"--frames ::{step} takes one frame a depth image, if the camera moves fast")]


def _poses_at(times: np.ndarray, pose_file: Path, unit: Unit) -> np.ndarray:
    """Poses (N, 4, 4) at the times [s], NaN where none is near."""
    pose_times, all_poses = read_tum_poses(pose_file)
    if not len(pose_times):
        raise DatasetError(f"{pose_file}: holds no pose; fetch it again or remove it")
    pose_times = pose_times * unit_that_fits(pose_times, times, unit)
    index, gap = nearest(times, pose_times)
    poses = all_poses[index]
    poses[gap >= MAX_TIME_DIFFERENCE] = np.nan
    return poses


def _camera_of(folder: Path) -> str | None:
    """The built-in camera that the name tells, as it was typed; else the name of the folder behind a link."""
    typed = Path(os.path.abspath(folder))
    for path in (typed, folder.resolve()):
        for name in (path.name, path.parent.name):
            match = re.search(r"(?:^|[^a-z])(?:fr|freiburg)[_-]?([123])(?:$|[^0-9])", name.lower())
            if match:
                return f"tum_fr{match.group(1)}"
    return None


def _thin_out(times: np.ndarray, candidates: np.ndarray) -> np.ndarray:
    kept: list[int] = []
    for index in candidates:
        if not kept or times[index] - times[kept[-1]] > MIN_SPACING:
            kept.append(int(index))
    return np.array(kept, dtype=int)
