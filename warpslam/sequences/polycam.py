"""Polycam's raw data: keyframes/images, keyframes/depth, keyframes/cameras (or corrected_*), keyframes/confidence."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from warpslam.errors import DatasetError, brief
from warpslam.reading import YAML_LIMIT, read_text
from warpslam.sequences.calibration import find_calibration, has_own_camera
from warpslam.sequences.files import FileSequence
from warpslam.sequences.image_files import image_times, list_images
from warpslam.sequences.pairing import pair
from warpslam.sequences.pose_convention import OPENCV, OPENGL
from warpslam.sequences.recorder_files import from_matrix

_CAMERA = ("fx", "fy", "cx", "cy", "width", "height")


class PolycamSequence(FileSequence):
    """A folder of Polycam; the corrected images and cameras, where they are there, belong together."""

    def __init__(self, folder: Path, camera: str | None = None) -> None:
        base = folder / "keyframes" if (folder / "keyframes").is_dir() else folder
        is_corrected = (base / "corrected_images").is_dir() and (base / "corrected_cameras").is_dir()
        prefix = "corrected_" if is_corrected else ""
        pairs = pair(folder, list_images(base / f"{prefix}images"), list_images(base / "depth"))
        cameras = [_read(base / f"{prefix}cameras" / f"{file.stem}.json") for file in pairs.rgb_files]
        if camera is not None or has_own_camera(folder):
            calibration = find_calibration(folder, camera, None)
        else:
            # The focal length breathes from frame to frame, by a pixel or two.
            fx, fy, cx, cy, width, height = np.median([values for values, _ in cameras], axis=0)
            K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
            calibration = from_matrix(K, (int(width), int(height)), f"{prefix}cameras of {base}")
        confidence = [base / "confidence" / file.name for file in pairs.depth_files]
        super().__init__(
            folder,
            calibration,
            pairs.rgb_files,
            pairs.depth_files,
            poses=np.array([pose for _, pose in cameras]),
            timestamps=image_times(pairs.rgb_files),
            remarks=pairs.remarks,
            same_view=True,
            conventions=(OPENGL, OPENCV),
            confidence_files=confidence if all(file.is_file() for file in confidence) else None,
        )


def _read(path: Path) -> tuple[list[float], np.ndarray]:
    """Camera (fx, fy, cx, cy, width, height) and pose (4, 4) of a frame."""
    try:
        fields = json.loads(read_text(path, YAML_LIMIT))
        values = [float(fields[name]) for name in _CAMERA]
        rows = [[float(fields[f"t_{row}{column}"]) for column in range(4)] for row in range(3)]
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise DatasetError(
            f"{path}: can't be read as a camera of Polycam ({brief(repr(error))}); export it again"
        ) from error
    return values, np.array([*rows, [0, 0, 0, 1]])
