"""Pictures as data URIs: colour maps, panels, and views of the mesh."""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from warpslam.camera import Intrinsics
from warpslam.report.data import upright_axes

if TYPE_CHECKING:
    import trimesh

MISSING_COLOR = (128, 128, 128)
VIEW_WIDTH, VIEW_HEIGHT = 480, 360  # [px]
SUPERSAMPLING = 2
QUALITY = 85
CUT_ABOVE_CAMERA = 0.3  # [m], what is higher than this above the cameras is taken for the ceiling
MIN_KEPT = 0.2  # of the faces; where the cut leaves fewer, it was no ceiling


@dataclass(frozen=True)
class MeshView:
    """A picture of the mesh."""

    title: str
    """What it shows."""

    uri: str
    """The picture."""

    path: np.ndarray | None = None
    """Where the cameras appear in it [px], shape (N, 2), or None."""


def data_uri(image: np.ndarray) -> str:
    """An image, uint8 (H, W, 3) or (H, W, 4), as a data URI; lossy, at a quality that does not show."""
    from PIL import Image, features

    buffer = io.BytesIO()
    if features.check("webp"):
        Image.fromarray(image).save(buffer, "WEBP", quality=QUALITY)
        kind = "webp"
    else:
        Image.fromarray(image).save(buffer, "PNG")
        kind = "png"
    return f"data:image/{kind};base64,{base64.b64encode(buffer.getvalue()).decode('ascii')}"


def color_map(values: np.ndarray, name: str, low: float, high: float, known: np.ndarray | None = None) -> np.ndarray:
    """Values (H, W) between ``low`` and ``high`` as colours, uint8 (H, W, 3); grey where ``known`` is False."""
    import matplotlib

    scaled = (np.nan_to_num(values) - low) / max(high - low, 1e-9)
    image = (matplotlib.colormaps[name](np.clip(scaled, 0, 1))[..., :3] * 255).astype(np.uint8)
    if known is not None:
        image[~known] = MISSING_COLOR
    return image


def color_stops(name: str, count: int = 9) -> str:
    """A colour map as the stops of a CSS gradient, from low to high."""
    colors = color_map(np.linspace(0, 1, count)[None], name, 0, 1)[0]
    return ", ".join(f"rgb({r} {g} {b})" for r, g, b in colors.tolist())


def mesh_views(mesh: trimesh.Trimesh, poses: np.ndarray, limit: int | None = None) -> list[MeshView]:
    """Views of a mesh: from above and from two corners, without the ceiling, and from the camera in mid-run.

    Faces that are seen from behind are left out, so that a room is looked into from outside.

    Args:
        mesh: Mesh with vertex colours [m].
        poses: Camera-to-world transforms of the run in the same frame, shape (N, 4, 4), N >= 1.
        limit: Only the first so many of the views.
    """
    axes = upright_axes(poses)
    open_mesh, was_cut = _without_ceiling(mesh, poses, axes[2])
    cut = ", ceiling cut away" if was_cut else ""
    # Narrow lens, far away: walls stay nearly upright in the view from above.
    narrow, wide = _camera(0.35), _camera(1.2)
    # Over the cameras' shoulders, where walls do not hide what they looked at.
    back = mean_backward(poses, axes)
    aside = np.cross(axes[2], back)
    corners = [_unit(back + side * 0.8 * aside + 0.85 * axes[2]) for side in (-1, 1)]
    shown = np.concatenate([open_mesh.vertices, poses[:, :3, 3]])
    center = (shown.min(axis=0) + shown.max(axis=0)) / 2
    radius = float(np.linalg.norm(np.ptp(shown, axis=0))) / 2
    above = _look(center, axes[2], axes[1], narrow, shown)
    views = [(f"From above{cut}", open_mesh, narrow, above, True)]
    for direction, side in zip(corners, ("left", "right"), strict=True):
        T = _look(center, direction, axes[2], narrow, shown)
        views.append((f"From the {side}{cut}", open_mesh, narrow, T, True))
    views.append(("From the camera, in mid-run", mesh, wide, poses[len(poses) // 2], False))
    pictures = []
    for title, subject, camera, T, outside in views[:limit]:
        visible = _facing(subject, T[:3, 3]) if outside else subject
        pixels = _project(poses[:, :3, 3], T, camera) / SUPERSAMPLING if outside else None
        pictures.append(MeshView(title, data_uri(_render(visible, camera, T, 4 * radius + 50)), pixels))
    return pictures


def mean_backward(poses: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Level direction against the cameras' mean view; the nearer side of the picture where they looked all around."""
    back = axes[:2].T @ (axes[:2] @ -poses[:, :3, 2].mean(axis=0))
    return _unit(back) if np.linalg.norm(back) > 0.2 else -axes[1]


def _without_ceiling(mesh: trimesh.Trimesh, poses: np.ndarray, up: np.ndarray) -> tuple[trimesh.Trimesh, bool]:
    height = float(np.percentile(poses[:, :3, 3] @ up, 90)) + CUT_ABOVE_CAMERA
    keep = (mesh.vertices @ up)[mesh.faces].max(axis=1) < height
    if keep.all() or keep.mean() < MIN_KEPT:
        return mesh, False
    return _faces(mesh, keep), True


def _facing(mesh: trimesh.Trimesh, eye: np.ndarray) -> trimesh.Trimesh:
    toward = eye - mesh.triangles_center
    keep = np.einsum("ij,ij->i", mesh.face_normals, toward) > 0
    return _faces(mesh, keep) if keep.any() else mesh


def _faces(mesh: trimesh.Trimesh, keep: np.ndarray) -> trimesh.Trimesh:
    import trimesh

    colors = mesh.visual.vertex_colors
    part = trimesh.Trimesh(mesh.vertices, mesh.faces[keep], vertex_colors=colors, process=False)
    part.remove_unreferenced_vertices()
    return part


def _camera(angle: float) -> Intrinsics:
    """Camera of the views with a horizontal field of ``angle`` [rad]."""
    width, height = VIEW_WIDTH * SUPERSAMPLING, VIEW_HEIGHT * SUPERSAMPLING
    f = width / 2 / np.tan(angle / 2)
    return Intrinsics(f, f, (width - 1) / 2, (height - 1) / 2, width, height)


def _look(center: np.ndarray, back: np.ndarray, up: np.ndarray, camera: Intrinsics, points: np.ndarray) -> np.ndarray:
    """Pose of a camera that looks along ``-back``, about at ``center``, from where all points (N, 3) just fit in."""
    T = np.eye(4)
    T[:3, 2] = -back
    T[:3, 0] = _unit(np.cross(T[:3, 2], up))
    T[:3, 1] = np.cross(T[:3, 2], T[:3, 0])
    local = (points - center) @ T[:3, :3]
    middle = (local[:, :2].min(axis=0) + local[:, :2].max(axis=0)) / 2
    local[:, :2] -= middle
    slope = np.array([camera.width / 2 / camera.fx, camera.height / 2 / camera.fy]) * 0.96
    distance = float((np.abs(local[:, :2]) / slope - local[:, 2:]).max())
    T[:3, 3] = center + T[:3, :2] @ middle + back * max(distance, 0.1)
    return T


def _project(points: np.ndarray, T_world_camera: np.ndarray, camera: Intrinsics) -> np.ndarray:
    local = (points - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
    return np.stack(camera.project(*local.T), axis=1)


def _render(mesh: trimesh.Trimesh, camera: Intrinsics, T_world_camera: np.ndarray, max_depth: float) -> np.ndarray:
    """Smoothed picture, uint8 (VIEW_HEIGHT, VIEW_WIDTH, 4), transparent where there is no surface."""
    from warpslam.synthetic.render import MeshRenderer

    rgb, depth = MeshRenderer(mesh, camera, max_depth=max_depth).render(T_world_camera)
    hit = (depth > 0).astype(np.float32)[..., None]
    blocks = (VIEW_HEIGHT, SUPERSAMPLING, VIEW_WIDTH, SUPERSAMPLING, -1)
    weight = hit.reshape(blocks).mean(axis=(1, 3))
    color = (rgb * hit).reshape(blocks).mean(axis=(1, 3)) / np.maximum(weight, 1e-6)
    return np.rint(np.concatenate([color, 255 * weight], axis=2)).astype(np.uint8)


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)
