"""What a run found, for other tools: its trajectory in their formats, with the images where they want them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from warpslam.errors import ConfigError, DatasetError
from warpslam.pipeline.finished import frame_indices
from warpslam.pipeline.setup import as_configured, open_source
from warpslam.runs.folder import RunFolder
from warpslam.storage.trajectory_files import TRAJECTORY_FORMATS, Views, write_trajectory
from warpslam.storage.tum import read_tum

_SUFFIX = {"tum": ".tum", "kitti": ".txt", "euroc": ".csv"}
_LARGEST = 65535  # of a 16-bit image


def export_run(folder: RunFolder, kind: str, output: str | Path | None = None) -> Path:
    """Write the trajectory of a run in one of `warpslam.storage.trajectory_files.TRAJECTORY_FORMATS`.

    "transforms" (nerfstudio) and "colmap" become a folder with the frames as they were used, undistorted and cropped:
    images/, and depth/ in millimetres.

    Args:
        folder: Run.
        kind: Format.
        output: File or folder to write; None for one in the run folder.

    Raises:
        ConfigError: There is no such format.
        DatasetError: A file of the run, or its input, can't be read.
        OSError: The file can't be written.
    """
    if kind not in TRAJECTORY_FORMATS:
        raise ConfigError(f"trajectory format {kind!r} is unknown; choose one of {', '.join(TRAJECTORY_FORMATS)}")
    times, poses = read_tum(folder.require(folder.trajectory, "the run stopped before its first frame"))
    if kind in _SUFFIX:
        path = Path(output) if output is not None else folder.path / f"trajectory_{kind}{_SUFFIX[kind]}"
        return write_trajectory(path, Views(times, poses), kind)
    path = Path(output) if output is not None else folder.path / kind
    views = _write_images(folder, path, times, poses)
    if kind == "transforms":
        write_trajectory(path / "transforms.json", views, kind)
    else:
        write_trajectory(path / "sparse" / "0", views, kind)
    return path


def _write_images(folder: RunFolder, path: Path, times: np.ndarray, poses: np.ndarray) -> Views:
    """Colour and depth of all frames of the run, below ``path``."""
    import cv2

    sequence = as_configured(open_source(folder.read_source()), folder.read_config())
    for name in ("images", "depth"):
        (path / name).mkdir(parents=True, exist_ok=True)
    names = []
    for index in frame_indices(folder, len(poses)):
        frame, name = sequence[index], f"{index:06d}.png"
        depth = np.clip(np.rint(frame.depth * 1000), 0, _LARGEST).astype(np.uint16)
        for file, image in ((path / "images" / name, frame.rgb[..., ::-1]), (path / "depth" / name, depth)):
            if not cv2.imwrite(str(file), np.ascontiguousarray(image)):
                raise DatasetError(f"{file}: can't be written; check that the disk has room")
        names.append(name)
    images, depths = ([f"{kind}/{name}" for name in names] for kind in ("images", "depth"))
    return Views(times, poses, sequence.intrinsics, images, depths)
