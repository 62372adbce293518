"""Meshes with fewer faces, and point clouds."""

from __future__ import annotations

import numpy as np
import trimesh

from warpslam.errors import MeshError, MissingDependencyError

MIN_FACES = 4


def simplified(mesh: trimesh.Trimesh, faces: int) -> trimesh.Trimesh:
    """The mesh with about ``faces`` faces, by quadric edge collapse; colours are those of the nearest old vertices.

    Raises:
        MeshError: Fewer than four faces are wanted.
        MissingDependencyError: The package fast-simplification is not installed.
    """
    from scipy.spatial import cKDTree

    if faces < MIN_FACES:
        raise MeshError(f"{faces} faces are too few for a mesh; ask for {MIN_FACES} or more")
    if len(mesh.faces) <= faces:
        return mesh
    try:
        import fast_simplification
    except ImportError as error:
        raise MissingDependencyError(
            "fewer faces need the package fast-simplification; type: pip install fast-simplification"
        ) from error
    points, triangles = fast_simplification.simplify(
        np.ascontiguousarray(mesh.vertices, np.float32), np.ascontiguousarray(mesh.faces, np.int32), target_count=faces
    )
    _, nearest = cKDTree(mesh.vertices).query(points)
    colors = mesh.visual.vertex_colors[nearest]
    return trimesh.Trimesh(points, triangles, vertex_colors=colors, process=False)


def point_cloud(mesh: trimesh.Trimesh) -> trimesh.PointCloud:
    """The vertices of a mesh and their colours."""
    return trimesh.PointCloud(mesh.vertices, mesh.visual.vertex_colors)
