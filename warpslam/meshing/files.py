"""Mesh files: binary PLY, glTF, OBJ and STL; point clouds as PLY."""

from __future__ import annotations

import os
from pathlib import Path

import trimesh

from warpslam.errors import MeshError
from warpslam.storage.atomic import replacing

MESH_SUFFIXES = (".ply", ".glb", ".obj", ".stl")


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
    """Write a mesh with vertex normals and colours: binary PLY, binary glTF (.glb) or OBJ, by the suffix of `path`;
    STL has neither normals of vertices nor colours.

    All hold world coordinates [m] as they are. An existing file is replaced only once all is written.

    Raises:
        MeshError: The mesh is empty, the suffix is another one, or the file can't be written.
    """
    path = check_mesh_path(path)
    if len(mesh.faces) == 0:
        raise MeshError(f"{path}: the mesh has no faces, so there is nothing to write; extract a mesh first")
    suffix = path.suffix.lower()
    if suffix == ".ply":
        data = trimesh.exchange.ply.export_ply(mesh, encoding="binary", vertex_normal=True)
    elif suffix == ".glb":
        data = trimesh.exchange.gltf.export_glb(trimesh.Scene(mesh), include_normals=True)
    elif suffix == ".obj":
        data = trimesh.exchange.obj.export_obj(mesh, include_normals=True, include_color=True).encode("ascii")
    else:
        data = trimesh.exchange.stl.export_stl(mesh)
    _replace(path, data)
    return path


def write_points(cloud: trimesh.PointCloud, path: str | os.PathLike[str]) -> Path:
    """Write a coloured point cloud as binary PLY.

    Raises:
        MeshError: It is empty, the suffix is another one, or the file can't be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".ply":
        raise MeshError(f"{path}: points are written as .ply")
    if len(cloud.vertices) == 0:
        raise MeshError(f"{path}: there are no points to write")
    _replace(path, trimesh.exchange.ply.export_ply(cloud, encoding="binary"))
    return path


def _replace(path: Path, data: bytes) -> None:
    try:
        with replacing(path) as partial:
            partial.write_bytes(data)
    except OSError as error:
        raise MeshError(
            f"{path}: can't be written ({error.strerror}); check that the folder exists and is writable"
        ) from error
