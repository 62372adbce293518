"""Which colour, depth and pose belong together: told by the numbers in file names, not by rank alone."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from warpslam.errors import DatasetError
from warpslam.sequences.base import Remark
from warpslam.sequences.image_files import without_strays

COMPLETE = "complete the download, or go on with the frames that are left"
_NAMED = 3  # files named in a message
_ENOUGH = 0.5  # of the shorter list must find a partner, or the numbers mean something else

Key = Callable[[Path], object]


@dataclass(frozen=True)
class Pairs:
    """Colour and depth files that belong together."""

    rgb_files: list[Path]
    """Of N frames."""
    depth_files: list[Path]
    """Of the same frames."""
    rgb_ranks: np.ndarray
    """Position of each frame among all colour images, int (N,)."""
    rgb_count: int
    """Colour images before any was left out."""
    remarks: tuple[Remark, ...] = ()
    """What was left out."""

    def poses(self, poses: np.ndarray | None, path: Path | None = None) -> np.ndarray | None:
        """Poses (N, 4, 4) of the frames, from a list that has one for each colour image, or, where it is longer, one
        for each frame number from 0.

        Raises:
            DatasetError: It is of another length.
        """
        if poses is None or len(poses) == len(self.rgb_files) == self.rgb_count:
            return poses
        if len(poses) == self.rgb_count:
            return poses[self.rgb_ranks]
        numbers = [frame_number(file) for file in self.rgb_files]
        if all(number is not None and number < len(poses) for number in numbers):
            if len(set(numbers)) == len(numbers) and len(poses) > self.rgb_count:
                return poses[np.array(numbers)]
        name = "the pose file" if path is None else str(path)
        raise DatasetError(
            f"{name}: {len(poses)} poses but {self.rgb_count} frames; use the pose file that belongs to these images, "
            "or remove it to run without ground truth"
        )


def pair(folder: Path, rgb_files: Sequence[Path], depth_files: Sequence[Path]) -> Pairs:
    """Colour and depth images with the same number in their names; files of both that have no partner, and files whose
    names are not like those of the others, are left out and named.

    Where numbers say nothing, as many images of both kinds are pairs in their order.

    Raises:
        DatasetError: Numbers say nothing, and the counts differ.
    """
    (rgb, stray_rgb), (depth, stray_depth) = without_strays(list(rgb_files)), without_strays(list(depth_files))
    remarks = []
    strays = stray_rgb + stray_depth
    if strays:
        text = f"{len(strays)} files are named unlike the frames and left out: {_named(strays)}"
        remarks.append(Remark("stray files", text, "move them elsewhere, or rename them if they are frames"))
    of_depth, ranks = _partners(rgb, depth)
    if of_depth is None:
        if len(rgb) != len(depth):
            raise DatasetError(
                f"{folder}: {len(rgb)} colour images but {len(depth)} depth images, and the numbers in their names do "
                "not tell which belong together; remove those without a partner or complete the download"
            )
        return Pairs(rgb, depth, np.arange(len(rgb)), len(rgb), tuple(remarks))
    lonely = [rgb[i] for i in sorted(set(range(len(rgb))) - set(ranks))]
    lonely += [depth[i] for i in sorted(set(range(len(depth))) - set(of_depth))]
    if lonely:
        text = f"{len(lonely)} images have no partner of the same number and are left out: {_named(lonely)}"
        remarks.append(Remark("association", text, COMPLETE))
    kept, partners = [rgb[i] for i in ranks], [depth[i] for i in of_depth]
    return Pairs(kept, partners, np.array(ranks, dtype=int), len(rgb), tuple(remarks))


def frame_number(path: Path) -> int | None:
    """First whole number in the file name, None if there is none."""
    match = re.search(r"\d+", path.name)
    return int(match.group()) if match else None


def _partners(rgb: list[Path], depth: list[Path]) -> tuple[list[int] | None, list[int]]:
    """Positions of depth images, and of the colour images that they belong to; None where names do not tell."""
    for key in (_all_numbers, frame_number, _last_number):
        by_number, of_rgb = {key(file): i for i, file in enumerate(depth)}, [key(file) for file in rgb]
        if len(by_number) < len(depth) or len(set(of_rgb)) < len(rgb) or None in by_number or None in of_rgb:
            continue
        ranks = [i for i, number in enumerate(of_rgb) if number in by_number]
        if ranks and len(ranks) >= _ENOUGH * min(len(rgb), len(depth)):
            return [by_number[of_rgb[i]] for i in ranks], ranks
    return None, []


def _all_numbers(path: Path) -> tuple[int, ...] | None:
    return tuple(int(number) for number in re.findall(r"\d+", path.stem)) or None


def _last_number(path: Path) -> int | None:
    numbers = _all_numbers(path)
    return None if numbers is None else numbers[-1]


def _named(files: Sequence[Path]) -> str:
    return ", ".join(f"{file.parent.name}/{file.name}" for file in files[:_NAMED]) + (
        ", ..." if len(files) > _NAMED else ""
    )
