"""A texture in place of vertex colours: the surface laid out flat (xatlas), and the map asked for every texel."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from warpslam.errors import InputError, MeshError, MissingDependencyError
from warpslam.storage.atomic import replacing

MAX_FACES = 200_000
"""Laying out more takes many minutes."""
TEXTURE_SUFFIXES = (".glb", ".obj")
_SIZES = (64, 8192)  # [px]
_AT_ONCE = 2_000_000  # candidate texels
_SPREAD = 2  # [px], by which colours go beyond their piece, for no seam to show


def textured(
    mesh: trimesh.Trimesh, query_color: Callable[[np.ndarray], np.ndarray], size: int = 2048
) -> trimesh.Trimesh:
    """The mesh with a texture.

    Args:
        mesh: Mesh [m].
        query_color: Colours (N, 3) in [0, 1] of world points (N, 3) float32 [m].
        size: Width and height of the texture [px].

    Returns:
        A mesh of the same faces, whose vertices are doubled where pieces of the layout end.

    Raises:
        MissingDependencyError: xatlas is not installed.
        InputError: The size can't be, or the mesh has too many faces.
    """
    if not _SIZES[0] <= size <= _SIZES[1]:
        raise InputError(f"a texture of {size} px: {_SIZES[0]} to {_SIZES[1]} are possible")
    if len(mesh.faces) > MAX_FACES:
        raise InputError(
            f"the mesh has {len(mesh.faces)} faces, and a texture takes at most {MAX_FACES}: reduce it by --faces"
        )
    try:
        import xatlas
    except ImportError as error:
        raise MissingDependencyError("a texture needs the package xatlas; type: pip install xatlas") from error
    origin, faces, uv = xatlas.parametrize(
        np.ascontiguousarray(mesh.vertices, np.float32), np.ascontiguousarray(mesh.faces, np.uint32)
    )
    vertices = np.asarray(mesh.vertices)[origin]
    image = _baked(vertices, faces.astype(np.int64), uv.astype(np.float64), query_color, size)
    from PIL import Image

    material = trimesh.visual.material.PBRMaterial(
        baseColorTexture=Image.fromarray(image), metallicFactor=0.0, roughnessFactor=1.0
    )
    visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    normals = np.asarray(mesh.vertex_normals)[origin]
    return trimesh.Trimesh(vertices, faces, vertex_normals=normals, visual=visual, process=False)


def write_textured(mesh: trimesh.Trimesh, path: str | Path) -> Path:
    """Write a mesh with its texture: one .glb, or an .obj with an .mtl and a .png beside it.

    Raises:
        MeshError: The suffix is another one, or a file can't be written.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in TEXTURE_SUFFIXES:
        raise MeshError(f"{path}: a mesh with a texture is written as {' or '.join(TEXTURE_SUFFIXES)}")
    if suffix == ".glb":
        files = {path.name: trimesh.exchange.gltf.export_glb(trimesh.Scene(mesh), include_normals=True)}
    else:
        text, others = _obj(mesh, path.stem)
        files = {**others, path.name: text}
    try:
        for name, data in files.items():
            with replacing(path.parent / name) as partial:
                partial.write_bytes(data)
    except OSError as error:
        raise MeshError(
            f"{path}: can't be written ({error.strerror}); check that the folder exists and is writable"
        ) from error
    return path


def _obj(mesh: trimesh.Trimesh, stem: str) -> tuple[bytes, dict[str, Any]]:
    simple = mesh.copy()
    simple.visual = trimesh.visual.TextureVisuals(
        uv=mesh.visual.uv, material=trimesh.visual.material.SimpleMaterial(image=mesh.visual.material.baseColorTexture)
    )
    simple.visual.material.name = stem
    text, others = trimesh.exchange.obj.export_obj(
        simple, include_normals=True, include_texture=True, return_texture=True, mtl_name=f"{stem}.mtl"
    )
    return text.encode("ascii"), others


def _baked(
    vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray, query_color: Callable[[np.ndarray], np.ndarray], size: int
) -> np.ndarray:
    """The texture, uint8 (size, size, 3), its first row at the top (v = 1)."""
    image = np.zeros((size, size, 3), np.uint8)
    known = np.zeros((size, size), bool)
    # Texel (column, row) has its centre at uv ((column + 0.5) / size, 1 - (row + 0.5) / size).
    places = np.stack([uv[:, 0] * size - 0.5, (1 - uv[:, 1]) * size - 0.5], axis=1)
    for column, row, points in _texels(vertices, faces, places, size):
        colors = np.asarray(query_color(points.astype(np.float32)))
        image[row, column] = np.rint(255 * np.clip(colors, 0, 1)).astype(np.uint8)
        known[row, column] = True
    return _spread(image, known)


def _texels(
    vertices: np.ndarray, faces: np.ndarray, places: np.ndarray, size: int
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Columns, rows and world points (N, 3) of the texels whose centre lies in a face, or within half a texel of it."""
    corners = places[faces]
    low = np.clip(np.floor(corners.min(axis=1)), 0, size - 1).astype(np.int64)
    high = np.clip(np.ceil(corners.max(axis=1)), 0, size - 1).astype(np.int64)
    extent = high - low + 1
    count = extent.prod(axis=1)
    ends = np.cumsum(count)
    begin = 0
    while begin < len(faces):
        end = max(begin + 1, int(np.searchsorted(ends, (ends[begin - 1] if begin else 0) + _AT_ONCE, side="right")))
        part = slice(begin, end)
        owner = np.repeat(np.arange(begin, end), count[part])
        nth = np.arange(len(owner)) - np.repeat(np.cumsum(count[part]) - count[part], count[part])
        column = low[owner, 0] + nth % extent[owner, 0]
        row = low[owner, 1] + nth // extent[owner, 0]
        a, b, c = (corners[owner, n] for n in range(3))
        p = np.stack([column, row], axis=1)
        area = _cross(b - a, c - a)
        solid = np.abs(area) > 1e-12
        area = np.where(solid, area, 1.0)
        weights = np.stack([_cross(b - p, c - p), _cross(c - p, a - p), _cross(a - p, b - p)], axis=1) / area[:, None]
        # Half a texel beyond an edge still belongs to it: the filter of who draws it reads there.
        longest = np.maximum.reduce([np.linalg.norm(x - y, axis=1) for x, y in ((a, b), (b, c), (c, a))])
        slack = 0.5 * longest / np.maximum(np.abs(area), 1e-9)
        inside = solid & (weights >= -slack[:, None]).all(axis=1)
        weights = np.clip(weights[inside], 0, 1)
        weights /= weights.sum(axis=1, keepdims=True)
        points = np.einsum("nk,nkd->nd", weights, vertices[faces[owner[inside]]])
        yield column[inside], row[inside], points
        begin = end


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def _spread(image: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Colours go on beyond their pieces by a few texels."""
    import cv2

    kernel = np.ones((3, 3), np.float32)
    for _ in range(_SPREAD):
        weight = cv2.filter2D(known.astype(np.float32), -1, kernel, borderType=cv2.BORDER_CONSTANT)
        total = cv2.filter2D(image.astype(np.float32) * known[..., None], -1, kernel, borderType=cv2.BORDER_CONSTANT)
        new = ~known & (weight > 0.5)
        image[new] = np.rint(total[new] / weight[new][:, None]).astype(np.uint8)
        known = known | new
    return image
