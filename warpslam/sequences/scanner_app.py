"""3D Scanner App (iPhone), "all data": frame_00000.jpg, frame_00000.json, depth_00000.png, conf_00000.png."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from warpslam.errors import DatasetError, brief
from warpslam.reading import YAML_LIMIT, read_text
from warpslam.sequences.calibration import find_calibration, has_own_camera
from warpslam.sequences.files import FileSequence
from warpslam.sequences.image_files import list_images
from warpslam.sequences.pairing import pair
from warpslam.sequences.pose_convention import OPENCV, OPENGL
from warpslam.sequences.recorder_files import from_matrix, image_size


class ScannerAppSequence(FileSequence):
    """A folder of 3D Scanner App; colour is stored for some frames only, and these are used."""

    def __init__(self, folder: Path, camera: str | None = None) -> None:
        pairs = pair(folder, list_images(folder, "frame_*", (".jpg", ".png")), list_images(folder, "depth_*.png"))
        frames = [_read(file.with_suffix(".json")) for file in pairs.rgb_files]
        if camera is not None or has_own_camera(folder):
            calibration = find_calibration(folder, camera, None)
        else:
            K = np.median([K for K, _, _ in frames], axis=0)
            calibration = from_matrix(K, image_size(pairs.rgb_files), f"frame_*.json of {folder}")
        times = np.array([time for _, _, time in frames])
        confidence = [file.with_name(file.name.replace("depth_", "conf_", 1)) for file in pairs.depth_files]
        super().__init__(
            folder,
            calibration,
            pairs.rgb_files,
            pairs.depth_files,
            poses=np.array([pose for _, pose, _ in frames]),
            timestamps=times if len(times) and np.isfinite(times).all() and (np.diff(times) > 0).all() else None,
            # Depth without colour is this app's way, and nothing that is missing.
            remarks=[remark for remark in pairs.remarks if remark.check != "association"],
            same_view=True,
            conventions=(OPENGL, OPENCV),
            confidence_files=confidence if all(file.is_file() for file in confidence) else None,
        )


def _read(path: Path) -> tuple[np.ndarray, np.ndarray, float]:
    """Camera matrix of colour (3, 3), pose (4, 4) as stored, and time [s] of a frame."""
    try:
        fields = json.loads(read_text(path, YAML_LIMIT))
        K = np.array(fields["intrinsics"], dtype=np.float64).reshape(3, 3)
        pose = np.array(fields["cameraPoseARFrame"], dtype=np.float64).reshape(4, 4)
        return K, pose, float(fields.get("time", np.nan))
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise DatasetError(
            f"{path}: can't be read as a frame of 3D Scanner App ({brief(repr(error))}); export it again"
        ) from error
