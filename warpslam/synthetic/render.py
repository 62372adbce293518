"""Exact RGB-D images of a triangle mesh."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from warpslam.camera import Intrinsics
from warpslam.errors import ConfigError, MeshError
from warpslam.poses import check_transform
from warpslam.runtime.environment import named_device
from warpslam.runtime.launching import Launcher, Step

if TYPE_CHECKING:
    import trimesh

DEFAULT_LIGHT = (0.35, 0.5, 0.8)
AMBIENT = 0.55
# A texture much finer than the image would alias: no mip levels here, as they would make colour depend on distance.
TEXTURE_LIMIT = 512


@dataclass(frozen=True)
class ColoredTriangles:
    """Triangles with a colour from their vertices or from a texture."""

    vertices: np.ndarray
    """Positions [m], float32, shape (V, 3)."""
    faces: np.ndarray
    """Vertex indices, int32, shape (F, 3)."""
    colors: np.ndarray
    """Vertex colours 0..255, float32, shape (V, 3)."""
    uvs: np.ndarray
    """Texture coordinates, float32, shape (V, 2); v = 1 is an image's top row."""
    material: np.ndarray
    """Index of a face's texture, int32, shape (F,); -1 = vertex colours."""
    textures: list[np.ndarray]
    """RGB images, uint8, each of shape (h, w, 3)."""

    @classmethod
    def from_trimesh(cls, mesh: trimesh.Trimesh | trimesh.Scene) -> ColoredTriangles:
        """Flatten a mesh, or a scene of several, keeping each face's own texture.

        Raises:
            MeshError: There is no triangle, or a vertex is not finite.
        """
        parts = mesh.dump() if hasattr(mesh, "dump") else [mesh]
        parts = [part for part in parts if hasattr(part, "faces") and len(part.faces)]
        if not parts:
            raise MeshError("the mesh has no triangles; load a mesh with faces, not a point cloud")
        textures: list[np.ndarray] = []
        columns = [_flatten(part, textures) for part in parts]
        offset = np.cumsum([0] + [len(column[0]) for column in columns[:-1]])
        vertices, faces, colors, uvs, material = zip(*columns, strict=True)
        result = cls(
            np.concatenate(vertices).astype(np.float32),
            np.concatenate([f + o for f, o in zip(faces, offset, strict=True)]).astype(np.int32),
            np.concatenate(colors).astype(np.float32),
            np.concatenate(uvs).astype(np.float32),
            np.concatenate(material).astype(np.int32),
            textures,
        )
        if not np.isfinite(result.vertices).all():
            raise MeshError("the mesh has vertices with NaN or infinity; clean it first")
        return result

    @property
    def face_normals(self) -> np.ndarray:
        """Unit normals, float32, shape (F, 3); zero for a triangle without area."""
        a, b, c = self.vertices[self.faces].astype(np.float64).transpose(1, 0, 2)
        normals = np.cross(b - a, c - a)
        return (normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)).astype(np.float32)


def _flatten(part: trimesh.Trimesh, textures: list[np.ndarray]) -> tuple[np.ndarray, ...]:
    count = len(part.vertices)
    colors, uvs = np.full((count, 3), 180.0), np.zeros((count, 2))
    material = np.full(len(part.faces), -1)
    if part.visual.kind == "texture":
        image = getattr(part.visual.material, "image", None)
        if image is None:
            image = getattr(part.visual.material, "baseColorTexture", None)
        uv = getattr(part.visual, "uv", None)
        if image is not None and uv is not None:
            textures.append(_texture(image))
            material[:] = len(textures) - 1
            uvs = np.nan_to_num(np.asarray(uv)[:, :2])
        else:
            colors[:] = np.asarray(part.visual.material.main_color)[:3]
    elif part.visual.kind is not None:
        colors = np.asarray(part.visual.vertex_colors)[:, :3]
    return np.asarray(part.vertices), np.asarray(part.faces), colors, uvs, material


def _texture(image: Image.Image) -> np.ndarray:
    image = image.convert("RGB")
    shrink = TEXTURE_LIMIT / max(image.size)
    if shrink < 1:
        image = image.resize([max(1, round(side * shrink)) for side in image.size], Image.Resampling.BOX)
    return np.asarray(image, dtype=np.uint8)


class MeshRenderer:
    """Renders a mesh through a pinhole camera; the colour of a surface point does not depend on the view.

    Shading is Lambert's by face normal with one fixed light, plus ambient, the same on both sides of a face.
    """

    def __init__(
        self,
        mesh: trimesh.Trimesh | trimesh.Scene,
        intrinsics: Intrinsics,
        *,
        device: str | None = None,
        light: tuple[float, float, float] = DEFAULT_LIGHT,
        max_depth: float = 100.0,
    ) -> None:
        """Upload the mesh.

        Args:
            mesh: Mesh in world coordinates [m], vertex-coloured or textured, or a scene of such meshes.
            device: Warp device, None = Warp's default one.
            light: Direction to the light in world axes; need not have unit length.
            max_depth: Hits beyond this z-depth [m] are misses.
        """
        import warp as wp  # rooms and paths, which the package brings too, need none of it

        from warpslam.kernels.raycast import TexturedMesh

        direction = np.asarray(light, dtype=np.float64)
        if direction.shape != (3,) or not np.linalg.norm(direction) > 0:
            raise ConfigError(f"light = {light!r} must be a direction of three numbers, not zero")
        triangles = ColoredTriangles.from_trimesh(mesh)
        shade = AMBIENT + (1 - AMBIENT) * np.abs(triangles.face_normals @ (direction / np.linalg.norm(direction)))
        sizes = [image.shape[:2] for image in triangles.textures]
        first = np.cumsum([0] + [h * w for h, w in sizes])
        table = [(start, w, h) for start, (h, w) in zip(first[:-1], sizes, strict=True)] or [(0, 1, 1)]
        texels = [image.reshape(-1, 3) for image in triangles.textures] or [np.zeros((1, 3), np.uint8)]

        self.intrinsics = intrinsics
        self.max_depth = max_depth
        self._device = named_device(device)
        with wp.ScopedDevice(self._device):
            faces = wp.array(triangles.faces.ravel(), dtype=wp.int32)
            self._mesh = wp.Mesh(wp.array(triangles.vertices, dtype=wp.vec3), faces)
            self._surface = TexturedMesh()
            self._surface.mesh = self._mesh.id
            self._surface.faces = faces
            self._surface.colors = wp.array(triangles.colors, dtype=wp.vec3)
            self._surface.uvs = wp.array(triangles.uvs, dtype=wp.vec2)
            self._surface.shade = wp.array(shade.astype(np.float32), dtype=wp.float32)
            self._surface.material = wp.array(triangles.material, dtype=wp.int32)
            self._surface.textures = wp.array(np.array(table, dtype=np.int32), dtype=wp.vec3i)
            self._surface.texels = wp.array(np.concatenate(texels), dtype=wp.vec3ub)
            shape = (intrinsics.height, intrinsics.width)
            self._rgb = wp.empty(shape, dtype=wp.vec3ub)
            self._depth = wp.empty(shape, dtype=wp.float32)

    def render(self, T_world_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Render one view.

        Args:
            T_world_camera: Camera-to-world transform, shape (4, 4), OpenCV axes.

        Returns:
            rgb: uint8, shape (H, W, 3), black where nothing is hit.
            depth: z-depth [m], float32, shape (H, W), 0 where nothing is hit.
        """
        import warp as wp

        from warpslam.kernels.raycast import render_mesh

        T = check_transform(T_world_camera)
        k = self.intrinsics
        inputs = [
            self._surface,
            wp.vec2(k.fx, k.fy),
            wp.vec2(k.cx, k.cy),
            wp.mat33(*T[:3, :3].ravel().tolist()),
            wp.vec3(*T[:3, 3].tolist()),
            self.max_depth,
            self._rgb,
            self._depth,
        ]

        def steps(first: int, stop: int, slot: int) -> list[Step]:
            return [(render_mesh, (stop - first, k.width), [first, *inputs])]

        Launcher(self._device).slices(k.height, steps)
        return self._rgb.numpy().copy(), self._depth.numpy().copy()


class AntialiasedRenderer:
    """Renders as `MeshRenderer` does, but a pixel's colour is the mean over rays spread over its area, as on a sensor.

    Depth stays that of the ray through the pixel's middle. Without this, lines thinner than a pixel flicker.
    """

    def __init__(
        self,
        mesh: trimesh.Trimesh | trimesh.Scene,
        intrinsics: Intrinsics,
        *,
        side: int = 2,
        device: str | None = None,
        max_depth: float = 100.0,
    ) -> None:
        """Upload the mesh.

        Args:
            mesh: As of `MeshRenderer`.
            side: Rays a pixel in each direction.
            device: Warp device, None = Warp's default one.
            max_depth: Hits beyond this z-depth [m] are misses.
        """
        k, shift = intrinsics, (side - 1) / 2
        fine = Intrinsics(
            side * k.fx, side * k.fy, side * k.cx + shift, side * k.cy + shift, side * k.width, side * k.height
        )
        self.intrinsics = intrinsics
        self._side = side
        self._exact = MeshRenderer(mesh, intrinsics, device=device, max_depth=max_depth)
        self._fine = MeshRenderer(mesh, fine, device=device, max_depth=max_depth)

    def render(self, T_world_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Render one view; arguments and results are those of `MeshRenderer.render`."""
        _, depth = self._exact.render(T_world_camera)
        height, width = depth.shape
        rgb = self._fine.render(T_world_camera)[0].reshape(height, self._side, width, self._side, 3)
        return np.rint(rgb.mean(axis=(1, 3), dtype=np.float32)).astype(np.uint8), depth


def load_mesh(path: str | Path) -> trimesh.Trimesh | trimesh.Scene:
    """Load a mesh file with its materials.

    Raises:
        MeshError: The file is missing or cannot be read.
    """
    import trimesh

    path = Path(path)
    if not os.path.isfile(path):
        raise MeshError(f"{path}: no such mesh file")
    try:
        # A scene keeps one geometry per material; loading as one mesh would merge their textures into one.
        return trimesh.load(path, process=False)
    except (ValueError, KeyError, IndexError, OSError, NotImplementedError) as error:
        raise MeshError(f"{path}: not a readable mesh ({error})") from error
