"""Trajectories in the TUM format: ``t tx ty tz qx qy qz qw``, a pose a line."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from warpslam.errors import DatasetError
from warpslam.poses import pose_from_vector, vector_from_pose
from warpslam.storage.atomic import replacing
from warpslam.storage.text_lines import read_numbers

_NO_QUATERNION = 1e-6  # length of one that says nothing


def nearest(times: np.ndarray, candidates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The candidate nearest in time to each of ``times``, the earlier one of two.

    Args:
        times: Times [s], shape (N,).
        candidates: Times [s], shape (M,), in any order, at least one.

    Returns:
        Its index, int, and how far it is off [s], both of shape (N,).
    """
    order = np.argsort(candidates, kind="stable")
    sorted_times = candidates[order]
    right = np.clip(np.searchsorted(sorted_times, times), 0, len(order) - 1)
    left = np.maximum(right - 1, 0)
    before, after = np.abs(sorted_times[left] - times), np.abs(sorted_times[right] - times)
    return order[np.where(before <= after, left, right)], np.minimum(before, after)


def associate(times: np.ndarray, candidates: np.ndarray, max_difference: float = 0.02) -> np.ndarray:
    """Index of the candidate nearest in time to each of ``times``, int, shape (N,); -1 where none is close enough.

    Args:
        times: Times [s], shape (N,).
        candidates: Times [s], shape (M,), in any order.
        max_difference: Largest accepted difference [s].
    """
    times, candidates = np.asarray(times, dtype=np.float64), np.asarray(candidates, dtype=np.float64)
    if len(candidates) == 0:
        return np.full(len(times), -1)
    index, gap = nearest(times, candidates)
    return np.where(gap <= max_difference, index, -1)


def write_tum(path: str | Path, timestamps: np.ndarray, poses: np.ndarray) -> None:
    """Write a trajectory in the TUM format, ``t tx ty tz qx qy qz qw`` a line; poses that are not finite are left out.

    Times are written with as few digits as give back the same double, the rest with nine decimals (1 nm), so that equal
    input gives equal bytes on every machine.

    Args:
        path: File to write.
        timestamps: Times [s], shape (N,).
        poses: Camera-to-world transforms, shape (N, 4, 4).
    """
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    for time, T in zip(np.asarray(timestamps, dtype=np.float64), np.asarray(poses, dtype=np.float64), strict=True):
        if np.isfinite(T).all():
            qw, qx, qy, qz, tx, ty, tz = vector_from_pose(T)
            # Adding zero turns -0.0, whose sign depends on the order of operations, into 0.0.
            numbers = " ".join(f"{round(x, 9) + 0.0:.9f}" for x in (tx, ty, tz, qx, qy, qz, qw))
            lines.append(f"{np.format_float_positional(time, trim='0')} {numbers}")
    with replacing(Path(path)) as partial:
        partial.write_text("\n".join(lines) + "\n", encoding="ascii", newline="\n")


def read_tum(path: str | Path, *, leave_out_unknown: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Read a trajectory in the TUM format: times [s], shape (N,), and camera-to-world transforms, shape (N, 4, 4).

    Args:
        path: File.
        leave_out_unknown: Lines with NaN or infinity stand for poses that are not known; else they are an error.

    Raises:
        DatasetError: The file can't be read, or a line does not hold eight finite numbers and a quaternion.
    """
    path = Path(path)
    times, poses = [], []
    for number, values in read_numbers(path, 8, "t tx ty tz qx qy qz qw"):
        if not np.isfinite(values).all():
            if leave_out_unknown:
                continue
            raise DatasetError(f"{path}:{number}: holds NaN or infinity; remove the line")
        if np.linalg.norm(values[4:]) < _NO_QUATERNION:
            raise DatasetError(f"{path}:{number}: quaternion qx qy qz qw is zero; remove the line")
        times.append(values[0])
        poses.append(pose_from_vector(values[[7, 4, 5, 6, 1, 2, 3]]))
    return np.array(times, dtype=np.float64), np.array(poses, dtype=np.float64).reshape(-1, 4, 4)
