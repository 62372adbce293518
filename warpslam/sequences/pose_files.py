"""Parsing the pose files of the datasets. Every error names the file and the line."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from warpslam.errors import DatasetError
from warpslam.storage.text_lines import parse_numbers, read_lines, read_numbers
from warpslam.storage.tum import read_tum

# Files with few digits and drifting integrators are common, reflections and mixed-up columns are not poses.
_ORTHONORMAL_TOLERANCE = 0.05


def read_matrix_lines(path: Path) -> np.ndarray:
    """One row-major camera-to-world 4x4 matrix a line; shape (N, 4, 4), float64, NaN where a line is not finite."""
    rows = read_numbers(path, 16, "a row-major 4x4 matrix")
    return _stack([as_pose(path, number, values.reshape(4, 4)) for number, values in rows])


def read_matrix_file(path: Path) -> np.ndarray:
    """A file with one camera-to-world matrix in four lines; shape (4, 4), float64, NaN if it is not finite."""
    rows = read_numbers(path, 4, "one row of a 4x4 matrix")
    if len(rows) != 4:
        raise DatasetError(f"{path}: {len(rows)} lines of numbers, expected the 4 rows of a matrix; correct it")
    return as_pose(path, rows[0][0], np.stack([values for _, values in rows]))


def read_redwood_log(path: Path, frame_count: int) -> np.ndarray:
    """Poses of a Redwood trajectory (.log): a line "id target fitness" and four matrix lines a frame.

    Returns:
        Camera-to-world matrices, shape (frame_count, 4, 4), float64, NaN for frames that the file does not name.
    """
    lines = read_lines(path)
    poses = np.full((frame_count, 4, 4), np.nan)
    for start in range(0, len(lines), 5):
        number, words = lines[start]
        header = parse_numbers(path, number, words, 3, "the frame line 'id target fitness'")
        if header[0] != np.floor(header[0]) or not 0 <= header[0] < frame_count:
            raise DatasetError(
                f"{path}:{number}: frame {words[0]} but the folder holds {frame_count} frames; "
                "use the pose file that belongs to these images"
            )
        block = lines[start + 1 : start + 5]
        if len(block) != 4:
            raise DatasetError(
                f"{path}:{number}: frame {words[0]} has {len(block)} of 4 matrix lines; complete the file"
            )
        rows = [parse_numbers(path, at, row, 4, "one row of a 4x4 matrix") for at, row in block]
        poses[int(header[0])] = as_pose(path, number + 1, np.stack(rows))
    return poses


def read_tum_poses(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Trajectory of lines "t tx ty tz qx qy qz qw": times [s], shape (N,), ascending, and camera-to-world (N, 4, 4);
    lines that are not finite are left out.
    """
    times, poses = read_tum(path, leave_out_unknown=True)
    order = np.argsort(times, kind="stable")
    return times[order], poses[order]


def as_pose(path: Path, number: int, T: np.ndarray) -> np.ndarray:
    """A matrix (4, 4) that is rigid, or NaN where it is not finite.

    Raises:
        DatasetError: It is finite and not rigid; the line is named.
    """
    if not np.isfinite(T).all():
        return np.full((4, 4), np.nan)
    R = T[:3, :3]
    if (
        np.abs(R @ R.T - np.eye(3)).max() > _ORTHONORMAL_TOLERANCE
        or np.linalg.det(R) < 0
        or np.abs(T[3] - [0, 0, 0, 1]).max() > 1e-6
    ):
        raise DatasetError(
            f"{path}:{number}: not a rigid transform (rotation and last row 0 0 0 1); correct the matrix"
        )
    return T


def _stack(poses: list[np.ndarray]) -> np.ndarray:
    return np.stack(poses) if poses else np.empty((0, 4, 4))
