"""Trajectories in the TUM format: ``t tx ty tz qx qy qz qw``, a pose a line."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from warpslam.errors import DatasetError
from warpslam.poses import pose_from_vector, vector_from_pose
from warpslam.storage.atomic import replacing


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
    order = np.argsort(candidates, kind="stable")
    sorted_times = candidates[order]
    right = np.clip(np.searchsorted(sorted_times, times), 0, len(order) - 1)
    left = np.maximum(right - 1, 0)
    nearest = np.where(np.abs(sorted_times[left] - times) <= np.abs(sorted_times[right] - times), left, right)
    return np.where(np.abs(sorted_times[nearest] - times) <= max_difference, order[nearest], -1)


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


def read_tum(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Read a trajectory in the TUM format: times [s], shape (N,), and camera-to-world transforms, shape (N, 4, 4).

    Raises:
        DatasetError: The file can't be read, or a line does not hold eight finite numbers and a quaternion.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"{path}: can't be read as a TUM trajectory ({error})") from error
    times, poses = [], []
    for number, line in enumerate(text.splitlines(), start=1):
        fields = line.split("#", 1)[0].replace(",", " ").split()
        if not fields:
            continue
        try:
            values = np.array([float(field) for field in fields])
        except ValueError:
            values = np.empty(0)
        if len(values) != 8 or not np.isfinite(values).all() or not np.any(values[4:]):
            raise DatasetError(f"{path}, line {number}: expected 't tx ty tz qx qy qz qw' (8 numbers), found {line!r}")
        t, tx, ty, tz, qx, qy, qz, qw = values
        times.append(t)
        poses.append(pose_from_vector(np.array([qw, qx, qy, qz, tx, ty, tz])))
    return np.array(times, dtype=np.float64), np.array(poses, dtype=np.float64).reshape(-1, 4, 4)
