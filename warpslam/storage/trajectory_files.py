"""Trajectories in the formats that other tools read. Poses are T_world_camera, OpenCV axes."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warpslam.camera import Intrinsics
from warpslam.errors import ConfigError
from warpslam.poses import inverse, vector_from_pose
from warpslam.storage.atomic import replacing
from warpslam.storage.tum import write_tum

_OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Views:
    """Poses with what belongs to them."""

    times: np.ndarray
    """[s], shape (N,)."""
    poses: np.ndarray
    """T_world_camera (N, 4, 4); frames whose pose is not finite are left out, but of KITTI, which counts lines."""
    camera: Intrinsics | None = None
    """Of the images; transforms.json and COLMAP need it."""
    images: Sequence[str] = ()
    """Paths of the colour images, as they are to be written; N or none."""
    depth_images: Sequence[str] = ()
    """Paths of the depth images in millimetres; N or none."""

    @property
    def known(self) -> list[int]:
        """Frames whose pose is known."""
        return np.flatnonzero(np.isfinite(self.poses).all(axis=(1, 2))).tolist()


def write_trajectory(path: str | Path, views: Views, kind: str = "tum") -> Path:
    """Write a trajectory in one of `TRAJECTORY_FORMATS`.

    Args:
        path: File; a folder for colmap, where cameras.txt, images.txt and an empty points3D.txt are written.
        views: Poses, and the camera and images that two of the formats hold, too.
        kind: Format.

    Raises:
        ConfigError: There is no such format, or it needs a camera that is not given.
        OSError: The file can't be written.
    """
    path = Path(path)
    if kind not in _WRITERS:
        raise ConfigError(f"trajectory format {kind!r} is unknown; choose one of {', '.join(TRAJECTORY_FORMATS)}")
    if kind in ("transforms", "colmap") and views.camera is None:
        raise ConfigError(f"trajectory format {kind} holds the camera: give it")
    _WRITERS[kind](path, views)
    return path


def _write_tum(path: Path, views: Views) -> None:
    write_tum(path, views.times, views.poses)


def _write_kitti(path: Path, views: Views) -> None:
    _write(path, [" ".join(f"{value:.9g}" for value in T[:3].ravel()) for T in views.poses])


def _write_euroc(path: Path, views: Views) -> None:
    lines = ["#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []"]
    for i in views.known:
        w, x, y, z, *t = vector_from_pose(views.poses[i])
        numbers = ",".join(f"{value:.9f}" for value in (*t, w, x, y, z))
        # The seconds apart from their fraction: a double has not enough digits for both.
        seconds = int(np.floor(views.times[i]))
        lines.append(f"{seconds * 10**9 + round((views.times[i] - seconds) * 1e9)},{numbers}")
    _write(path, lines)


def _write_transforms(path: Path, views: Views) -> None:
    camera = views.camera
    assert camera is not None
    fields: dict[str, Any] = {
        "camera_model": "PINHOLE", "fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy,
        "w": camera.width, "h": camera.height, "depth_unit_scale_factor": 0.001,
    }  # fmt: skip
    frames = []
    for i in views.known:
        frame: dict[str, Any] = {"file_path": _image(views, i), "timestamp": float(views.times[i])}
        if views.depth_images:
            frame["depth_file_path"] = views.depth_images[i]
        frames.append(frame | {"transform_matrix": (views.poses[i] @ _OPENGL_FROM_OPENCV).tolist()})
    _write(path, [json.dumps(fields | {"frames": frames}, indent=1)])


def _write_colmap(path: Path, views: Views) -> None:
    camera = views.camera
    assert camera is not None
    path.mkdir(parents=True, exist_ok=True)
    # COLMAP's origin is the corner of the first pixel, ours its centre.
    numbers = (camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5)
    text = " ".join(f"{number:.9g}" for number in numbers)
    _write(path / "cameras.txt", [f"1 PINHOLE {camera.width} {camera.height} {text}"])
    lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; then its points, none"]
    for i in views.known:
        vector = vector_from_pose(inverse(views.poses[i]))
        lines += [f"{i + 1} " + " ".join(f"{value:.9f}" for value in vector) + f" 1 {_image(views, i)}", ""]
    _write(path / "images.txt", lines)
    _write(path / "points3D.txt", ["# none"])


def _image(views: Views, index: int) -> str:
    return views.images[index] if views.images else f"{index:06d}.png"


def _write(path: Path, lines: list[str]) -> None:
    with replacing(path) as partial:
        partial.write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")


_WRITERS: dict[str, Callable[[Path, Views], None]] = {
    "tum": _write_tum,
    "kitti": _write_kitti,
    "euroc": _write_euroc,
    "transforms": _write_transforms,
    "colmap": _write_colmap,
}
TRAJECTORY_FORMATS: tuple[str, ...] = tuple(_WRITERS)
"""Names that `write_trajectory` takes."""
