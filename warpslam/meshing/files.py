"""Mesh files: binary PLY and glTF."""

from __future__ import annotations

import os
from pathlib import Path

import trimesh

from warpslam.errors import MeshError
from warpslam.storage.atomic import replacing

MESH_SUFFIXES = (".ply", ".glb")


def check_mesh_path(path: str | os.PathLike[str]) -> Path:
    """The path of a mesh file.

    Raises:
        MeshError: `write_mesh` does not know its suffix.
    """
    path = Path(path)
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise MeshError(f"{path}: a mesh is written as {' or '.join(MESH_SUFFIXES)}, by the suffix of its file")
    return path


def write_mesh(mesh: trimesh.Trimesh, path: str | os.PathLike[str]) -> Path:
    """Write a mesh with vertex normals and colours: binary PLY or binary glTF (.glb), by the suffix of `path`.

    Both hold world coordinates [m] as they are. An existing file is replaced only once all is written.

    Raises:
        MeshError: The mesh is empty, the suffix is another one, or the file can't be written.
    """
    path = check_mesh_path(path)
    if len(mesh.faces) == 0:
        raise MeshError(f"{path}: the mesh has no faces, so there is nothing to write; extract a mesh first")
    if path.suffix.lower() == ".ply":
        data = trimesh.exchange.ply.export_ply(mesh, encoding="binary", vertex_normal=True)
    else:
        data = trimesh.exchange.gltf.export_glb(trimesh.Scene(mesh), include_normals=True)
    try:
        with replacing(path) as partial:
            partial.write_bytes(data)
    except OSError as error:
        raise MeshError(
            f"{path}: can't be written ({error.strerror}); check that the folder exists and is writable"
        ) from error
    return path
