"""Parsing the pose files of the datasets. Every error names the file and the line."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from warpslam.errors import DatasetError
from warpslam.poses import pose_from_vector

# Files with few digits and drifting integrators are common, reflections and mixed-up columns are not poses.
_ORTHONORMAL_TOLERANCE = 0.05


def read_lines(path: Path) -> list[tuple[int, list[str]]]:
    """Line number (from 1) and words of every line that is neither empty nor a '#' comment; commas part words too."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"{path}: can't be read as text ({error}); fetch the file again") from error
    lines = ((number, line.replace(",", " ").split()) for number, line in enumerate(text.splitlines(), start=1))
    return [(number, words) for number, words in lines if words and not words[0].startswith("#")]


def read_numbers(path: Path, count: int, meaning: str) -> list[tuple[int, np.ndarray]]:
    """Lines of exactly ``count`` numbers each (infinities allowed): line number and float64 array, shape (count,)."""
    return [(number, _parse(path, number, words, count, meaning)) for number, words in read_lines(path)]


def read_matrix_lines(path: Path) -> np.ndarray:
    """One row-major camera-to-world 4x4 matrix a line; shape (N, 4, 4), float64, NaN where a line is not finite."""
    rows = read_numbers(path, 16, "a row-major 4x4 matrix")
    return _stack([_as_pose(path, number, values.reshape(4, 4)) for number, values in rows])


def read_matrix_file(path: Path) -> np.ndarray:
    """A file with one camera-to-world matrix in four lines; shape (4, 4), float64, NaN if it is not finite."""
    rows = read_numbers(path, 4, "one row of a 4x4 matrix")
    if len(rows) != 4:
        raise DatasetError(f"{path}: {len(rows)} lines of numbers, expected the 4 rows of a matrix; correct it")
    return _as_pose(path, rows[0][0], np.stack([values for _, values in rows]))


def read_redwood_log(path: Path, frame_count: int) -> np.ndarray:
    """Poses of a Redwood trajectory (.log): a line "id target fitness" and four matrix lines a frame.

    Returns:
        Camera-to-world matrices, shape (frame_count, 4, 4), float64, NaN for frames that the file does not name.
    """
    lines = read_lines(path)
    poses = np.full((frame_count, 4, 4), np.nan)
    for start in range(0, len(lines), 5):
        number, words = lines[start]
        header = _parse(path, number, words, 3, "the frame line 'id target fitness'")
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
        rows = [_parse(path, at, row, 4, "one row of a 4x4 matrix") for at, row in block]
        poses[int(header[0])] = _as_pose(path, number + 1, np.stack(rows))
    return poses


def read_tum_poses(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Trajectory of lines "t tx ty tz qx qy qz qw": times [s], shape (N,), ascending, and camera-to-world (N, 4, 4)."""
    times, poses = [], []
    for number, values in read_numbers(path, 8, "t tx ty tz qx qy qz qw"):
        if not np.isfinite(values).all():
            continue
        if np.linalg.norm(values[4:]) < 1e-6:
            raise DatasetError(f"{path}:{number}: quaternion qx qy qz qw is zero; remove the line")
        times.append(values[0])
        poses.append(pose_from_vector(values[[7, 4, 5, 6, 1, 2, 3]]))
    order = np.argsort(times, kind="stable")
    return np.asarray(times, dtype=np.float64)[order], _stack(poses)[order]


def _parse(path: Path, number: int, words: list[str], count: int, meaning: str) -> np.ndarray:
    if len(words) != count:
        raise DatasetError(f"{path}:{number}: {len(words)} numbers, expected {count} ({meaning}); correct the line")
    try:
        return np.array([float(word) for word in words])
    except ValueError as error:
        raise DatasetError(f"{path}:{number}: {error} (expected {meaning}); correct the line") from error


def _as_pose(path: Path, number: int, T: np.ndarray) -> np.ndarray:
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
