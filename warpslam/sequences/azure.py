"""NICE-SLAM's Apartment, and recordings of one's own: color/, depth/ and, where there is one, scene/trajectory.log."""

from __future__ import annotations

import json
from pathlib import Path

from warpslam.errors import DatasetError, brief
from warpslam.reading import YAML_LIMIT, read_text
from warpslam.sequences.calibration import Calibration, find_calibration, has_own_camera
from warpslam.sequences.files import FileSequence
from warpslam.sequences.image_files import list_images
from warpslam.sequences.redwood import find_log_poses


class AzureSequence(FileSequence):
    """Folders color/ and depth/ (millimetres), as Open3D's recorder writes them.

    The camera is the argument, else camera.yaml, else the recorder's intrinsic.json. Only a folder named Apartment has
    a built-in one: a camera guessed for a recording of one's own would bend the map without a word.
    """

    preset = "apartment"

    def __init__(self, folder: Path, camera: str | None = None) -> None:
        rgb_files = list_images(folder / "color")
        recorded = folder / "intrinsic.json"
        if recorded.is_file() and camera is None and not has_own_camera(folder):
            calibration = _from_intrinsic_json(recorded)
        else:
            resolved = folder.resolve()
            is_apartment = "apartment" in f"{resolved.parent.name}/{resolved.name}".lower()
            remedy = "Only a folder named Apartment has a built-in camera. "
            calibration = find_calibration(folder, camera, "azure" if is_apartment else None, remedy)
        super().__init__(
            folder,
            calibration,
            rgb_files,
            list_images(folder / "depth", suffixes=(".png",)),
            poses=find_log_poses(folder, ("scene/trajectory.log", "trajectory.log", "*.log"), len(rgb_files)),
        )


def _from_intrinsic_json(path: Path) -> Calibration:
    """Camera of a file by Open3D: width, height and the column-major 3x3 intrinsic_matrix."""
    try:
        fields = json.loads(read_text(path, YAML_LIMIT))
        fx, _, _, _, fy, _, cx, cy, _ = fields["intrinsic_matrix"]
        size = {"width": fields["width"], "height": fields["height"]}
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise DatasetError(
            f"{path}: no camera of Open3D (width, height, intrinsic_matrix with 9 numbers): {brief(repr(error))}; "
            "correct it or write a camera.yaml"
        ) from error
    return Calibration.from_fields({"fx": fx, "fy": fy, "cx": cx, "cy": cy, **size, "depth_scale": 1000}, str(path))
