"""Poses that are none: all the same, or the same from some frame on, while the images are not."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from warpslam.errors import DatasetError
from warpslam.sequences.base import Remark

_MIN_RUN = 10  # frames in a row with the very same pose; a pose found by time may serve a few at the end
_CHANGED = 4.0  # mean difference of grey values between two images of a camera that has moved


def without_placeholders(
    poses: np.ndarray, read_rgb: Callable[[int], np.ndarray]
) -> tuple[np.ndarray | None, tuple[Remark, ...]]:
    """Poses with placeholders made unknown, and what is to be said of it.

    A motion capture never gives the same digits twice; where a file does, for all frames or from some frame on, and the
    images show that the camera moved, the poses were filled in to please a reader.

    Args:
        poses: T_world_camera, float64 (N, 4, 4), NaN where unknown.
        read_rgb: Colour image of a frame, uint8 (H, W, 3).

    Returns:
        The poses, NaN where they are placeholders, None if none is left.
    """
    known = np.flatnonzero(np.isfinite(poses).all(axis=(1, 2)))
    if len(known) < 2:
        return poses, ()
    last = poses[known[-1]]
    differs = np.flatnonzero((poses[known] != last).any(axis=(1, 2)))
    first = known[differs[-1] + 1] if len(differs) else known[0]
    count = int(np.count_nonzero(known >= first))
    if (len(differs) and count < _MIN_RUN) or not _images_differ(read_rgb, int(first), int(known[-1])):
        return poses, ()
    if not len(differs):
        text = (
            f"all {len(known)} poses are the same, though the images are not: they are placeholders, not ground truth"
        )
        return None, (Remark("poses", text, "no trajectory error is given; remove the pose file to be rid of this"),)
    kept = poses.copy()
    kept[first + 1 :] = np.nan
    text = f"the poses stop at frame {first}: the {count - 1} after it repeat it, though the images change"
    return kept, (Remark("poses", text, "the repeated poses count as unknown"),)


def _images_differ(read_rgb: Callable[[int], np.ndarray], first: int, last: int) -> bool:
    try:
        views = [read_rgb(index)[::4, ::4].astype(np.float32) for index in {first, (first + last) // 2, last}]
    except DatasetError:
        return False
    views = [view for view in views if view.shape == views[0].shape]
    return max(float(np.abs(view - views[0]).mean()) for view in views) > _CHANGED
