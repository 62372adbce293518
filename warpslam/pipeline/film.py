"""Views of a finished run's mesh from anywhere: a film, images, or arrays."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from warpslam.camera import Intrinsics
from warpslam.errors import InputError, OutputError
from warpslam.evaluation import load_mesh
from warpslam.runs.folder import RunFolder
from warpslam.runs.given_poses import GivenPoses
from warpslam.storage.tum import read_tum
from warpslam.synthetic import MeshRenderer

if TYPE_CHECKING:
    import trimesh

ORBIT, TRAJECTORY = "orbit", "trajectory"
FILM_SUFFIXES = (".mp4", ".avi")
_ELEVATION = np.radians(25.0)
_BACKGROUND = 235  # grey where nothing is known
_LARGEST = 65535
_QUANTILES = (0.02, 0.98)  # of the vertices, that the box of the scene holds

View = tuple[np.ndarray, np.ndarray, np.ndarray]


def render_film(
    folder: RunFolder,
    path: str = ORBIT,
    output: str | Path | None = None,
    *,
    size: tuple[int, int] = (1280, 720),
    field_of_view: float = 60.0,
    frame_count: int = 240,
    rate: float = 30.0,
    device: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Path, int]:
    """Render the mesh of a run along a path.

    Args:
        folder: Run.
        path: "orbit" round the scene, "trajectory" for the run's own, or a file of poses (TUM, KITTI, 4x4).
        output: A film (.mp4, .avi), arrays (.npz: rgb, depth [m], mask, poses, camera), or a folder, which gets colour,
            depth in millimetres and a mask as PNG; None for film.mp4 in the run folder. The mask is 255 where something
            is known.
        size: Width and height of the images [px].
        field_of_view: Across [degrees].
        frame_count: Views of an orbit.
        rate: Of the film [1/s].
        device: Warp device.
        progress: Called with (views done, views).

    Returns:
        What was written, and how many views it holds.

    Raises:
        DatasetError: The poses or a file of the run can't be read.
        InputError: The size or the field of view is none.
        MeshError: The mesh can't be read.
        OutputError: The film can't be written.
    """
    if min(size) < 16 or not 1 <= field_of_view < 170 or frame_count < 1:
        raise InputError(
            f"views of {size[0]} x {size[1]} px and {field_of_view:g} degrees, {frame_count} of them: too few"
        )
    focal = size[0] / (2 * np.tan(np.radians(field_of_view) / 2))
    camera = Intrinsics(focal, focal, (size[0] - 1) / 2, (size[1] - 1) / 2, *size)
    mesh = load_mesh(folder.require(folder.mesh, "see metrics.json for why the run made none"))
    poses = _poses(folder, path, mesh, camera, frame_count)
    target = Path(output) if output is not None else folder.path / "film.mp4"
    renderer = MeshRenderer(mesh, camera, device=device)
    views = _views(renderer, poses, progress)
    if target.suffix.lower() in FILM_SUFFIXES:
        _write_film(target, views, size, rate)
    elif target.suffix.lower() == ".npz":
        rgb, depth, mask = (np.stack(images) for images in zip(*views, strict=True))
        np.savez_compressed(target, rgb=rgb, depth=depth, mask=mask, poses=poses, camera=camera.matrix)
    else:
        _write_images(target, views)
    return target, len(poses)


def orbit(mesh: trimesh.Trimesh, up: np.ndarray, camera: Intrinsics, count: int) -> np.ndarray:
    """Poses (count, 4, 4) on a circle round a mesh, which fills the image.

    Args:
        mesh: The scene.
        up: Direction that is up, (3,), of length 1.
        camera: Its field of view says how far away the circle is.
        count: Poses.
    """
    low, high = np.quantile(mesh.vertices, _QUANTILES, axis=0)
    centre, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    half = min(np.arctan(camera.width / (2 * camera.fx)), np.arctan(camera.height / (2 * camera.fy)))
    distance = radius / np.sin(half)
    side = np.cross(up, [1.0, 0, 0] if abs(up[0]) < 0.9 else [0, 1.0, 0])
    side /= np.linalg.norm(side)
    front = np.cross(side, up)
    poses = np.tile(np.eye(4), (count, 1, 1))
    for pose, angle in zip(poses, np.linspace(0, 2 * np.pi, count, endpoint=False), strict=True):
        outward = np.cos(_ELEVATION) * (np.cos(angle) * front + np.sin(angle) * side) + np.sin(_ELEVATION) * up
        right = np.cross(-outward, up)
        right /= np.linalg.norm(right)
        pose[:3, :3] = np.column_stack([right, np.cross(-outward, right), -outward])
        pose[:3, 3] = centre + distance * outward
    return poses


def _poses(folder: RunFolder, path: str, mesh: trimesh.Trimesh, camera: Intrinsics, count: int) -> np.ndarray:
    if path not in (ORBIT, TRAJECTORY):
        return GivenPoses.read(path).poses
    _, poses = read_tum(folder.require(folder.trajectory, "the run stopped before its first frame"))
    if path == TRAJECTORY:
        return poses
    # People hold cameras upright, more or less: y of the image is down.
    up = -poses[:, :3, 1].mean(axis=0)
    up = up / np.linalg.norm(up) if np.linalg.norm(up) > 1e-3 else np.array([0.0, 0.0, 1.0])
    return orbit(mesh, up, camera, count)


def _views(renderer: MeshRenderer, poses: np.ndarray, progress: Callable[[int, int], None] | None) -> Iterator[View]:
    for done, T in enumerate(poses, start=1):
        yield _view(renderer, T)
        if progress is not None:
            progress(done, len(poses))


def _view(renderer: MeshRenderer, T: np.ndarray) -> View:
    """Colour uint8 (H, W, 3), depth float32 (H, W) [m] and mask uint8 (H, W), 255 where something is known."""
    rgb, depth = renderer.render(T)
    known = depth > 0
    return np.where(known[..., None], rgb, np.uint8(_BACKGROUND)), depth, known.astype(np.uint8) * 255


def _write_film(path: Path, views: Iterator[View], size: tuple[int, int], rate: float) -> None:
    import cv2

    code = cv2.VideoWriter_fourcc(*("mp4v" if path.suffix.lower() == ".mp4" else "MJPG"))
    path.parent.mkdir(parents=True, exist_ok=True)
    film = cv2.VideoWriter(str(path), code, rate, size)
    if not film.isOpened():
        raise OutputError(f"{path}: no film can be written here; choose a folder or an .npz file with -o")
    for rgb, _, _ in views:
        film.write(np.ascontiguousarray(rgb[..., ::-1]))
    film.release()


def _write_images(folder: Path, views: Iterator[View]) -> None:
    import cv2

    folder.mkdir(parents=True, exist_ok=True)
    for i, (rgb, depth, mask) in enumerate(views):
        millimetres = np.clip(np.rint(depth * 1000), 0, _LARGEST).astype(np.uint16)
        images = (("color", np.ascontiguousarray(rgb[..., ::-1])), ("depth", millimetres), ("mask", mask))
        for name, image in images:
            if not cv2.imwrite(str(folder / f"{i:06d}_{name}.png"), image):
                raise OutputError(f"{folder}: can't be written to; check that the disk has room")
