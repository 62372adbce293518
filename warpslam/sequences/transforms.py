"""transforms.json of nerfstudio, instant-ngp, NeRFCapture: camera, poses in OpenGL axes, depth beside."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from warpslam.errors import DatasetError, InputError, brief
from warpslam.poses import check_transform
from warpslam.reading import read_text
from warpslam.sequences.base import Remark
from warpslam.sequences.calibration import Calibration, find_calibration, has_own_camera
from warpslam.sequences.files import FileSequence
from warpslam.sequences.image_files import DEPTH_SUFFIXES, IMAGE_SUFFIXES, natural_key
from warpslam.sequences.pose_convention import OPENGL_FROM_OPENCV

FILE = "transforms.json"
_MILLIMETRES = 1e-3  # what nerfstudio takes integer depth for


class TransformsSequence(FileSequence):
    """A folder with transforms.json whose frames have depth: ``depth_path`` or ``depth_file_path``, or an image of the
    same name with ".depth" in it or in a folder depth/.

    The unit of integer depth is ``integer_depth_scale`` [m] or ``depth_unit_scale_factor``, else a millimetre.
    """

    def __init__(self, folder: Path, camera: str | None = None) -> None:
        path = folder / FILE
        try:
            fields = json.loads(read_text(path))
            frames = [dict(frame) for frame in fields["frames"]]
            rows = [
                (_file(folder, frame["file_path"], IMAGE_SUFFIXES), _depth(folder, frame), frame) for frame in frames
            ]
        except (OSError, ValueError, KeyError, TypeError, RecursionError, AttributeError) as error:
            raise DatasetError(
                f"{path}: can't be read as a list of frames with file_path ({brief(repr(error))}); correct it"
            ) from error
        usable = [row for row in rows if row[0] is not None and row[1] is not None]
        if not usable:
            raise DatasetError(
                f"{path}: none of the {len(rows)} frames has colour and depth here; depth is looked for as depth_path, "
                "depth_file_path, IMAGE.depth.png or depth/IMAGE.png"
            )
        remarks = []
        if len(usable) < len(rows):
            text = f"{len(rows) - len(usable)} of {len(rows)} frames of {FILE} lack colour or depth"
            remarks.append(Remark("files", text, "complete the download; they are left out"))
        times = _times([frame for _, _, frame in usable])
        # The order of time where there is one, else that of the names: the list may be in any.
        order = np.argsort(times, kind="stable") if times is not None else _by_name([row[0] for row in usable])
        usable = [usable[i] for i in order]
        if camera is not None or has_own_camera(folder):
            calibration = find_calibration(folder, camera, None)
        else:
            calibration = _calibration(path, {**usable[0][2], **fields})
        super().__init__(
            folder,
            calibration,
            [row[0] for row in usable if row[0]],
            [row[1] for row in usable if row[1]],
            poses=np.array([_pose(path, frame) for _, _, frame in usable]),
            timestamps=None if times is None else times[order],
            remarks=remarks,
        )


def _file(folder: Path, name: str, suffixes: tuple[str, ...]) -> Path | None:
    """The file of that name, whose suffix may be left out."""
    path = folder / name
    return next((p for p in (path, *(path.with_name(path.name + s) for s in suffixes)) if p.is_file()), None)


def _depth(folder: Path, frame: dict[str, Any]) -> Path | None:
    for field in ("depth_path", "depth_file_path"):
        if frame.get(field):
            return _file(folder, frame[field], DEPTH_SUFFIXES)
    image = folder / frame["file_path"]
    stem = image.stem if image.suffix.lower() in IMAGE_SUFFIXES else image.name
    places = [image.with_name(f"{stem}.depth"), *(base / "depth" / stem for base in (folder, image.parent.parent))]
    found = (_file(place.parent, place.name, DEPTH_SUFFIXES) for place in places)
    return next((file for file in found if file is not None), None)


def _times(frames: list[dict[str, Any]]) -> np.ndarray | None:
    try:
        times = np.array([float(frame["timestamp"]) for frame in frames])
    except (KeyError, TypeError, ValueError):
        return None
    return times if np.isfinite(times).all() and len(np.unique(times)) == len(times) else None


def _by_name(files: list[Path | None]) -> np.ndarray:
    return np.array(sorted(range(len(files)), key=lambda i: natural_key(files[i] or Path())), dtype=int)


def _calibration(path: Path, fields: dict[str, Any]) -> Calibration:
    try:
        focal = float(fields["fl_x"])
        camera = {"fx": focal, "fy": float(fields.get("fl_y", focal)), "width": fields["w"], "height": fields["h"]}
        camera |= {name: fields.get(name, float(fields[size]) / 2) for name, size in (("cx", "w"), ("cy", "h"))}
        distortion = [float(fields.get(name) or 0) for name in ("k1", "k2", "p1", "p2", "k3")]
        unit = float(fields.get("integer_depth_scale") or fields.get("depth_unit_scale_factor") or _MILLIMETRES)
    except (KeyError, TypeError, ValueError) as error:
        raise DatasetError(
            f"{path}: no camera (fl_x, fl_y, cx, cy, w, h): {brief(repr(error))}; write a camera.yaml or give --camera"
        ) from error
    if not unit > 0:
        raise DatasetError(f"{path}: integer_depth_scale = {unit} must be metres a stored unit")
    extra = {"distortion": distortion} if any(distortion) else {}
    return Calibration.from_fields({**camera, "depth_scale": 1 / unit, **extra}, str(path))


def _pose(path: Path, frame: dict[str, Any]) -> np.ndarray:
    """T_world_camera in OpenCV axes; NaN where the frame has none that is rigid."""
    if "transform_matrix" not in frame:
        return np.full((4, 4), np.nan)
    try:
        matrix = np.array(frame["transform_matrix"], dtype=np.float64)
        matrix = np.vstack([matrix, [0, 0, 0, 1]]) if matrix.shape == (3, 4) else matrix
        return check_transform(matrix, "transform_matrix", unknown_is_nan=True) @ OPENGL_FROM_OPENCV
    except (InputError, ValueError, TypeError) as error:
        raise DatasetError(f"{path}: frame {frame.get('file_path')}: {error}; correct the matrix") from error
