"""Mesh files: what a reader gets back from them."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from warpslam.errors import MeshError
from warpslam.meshing import write_mesh


def test_ply_holds_normals_and_colors(mesh, tmp_path):
    """A written file reloads with the same faces, positions, normals and colours, and is binary."""
    path = write_mesh(mesh, tmp_path / "mesh.ply")
    header = path.read_bytes()[:60]
    assert b"binary_little_endian" in header and [p.name for p in tmp_path.iterdir()] == ["mesh.ply"]
    loaded = trimesh.load(path, process=False)
    assert np.array_equal(loaded.faces, mesh.faces)
    assert loaded.vertices == pytest.approx(mesh.vertices, abs=1e-6)
    assert loaded.vertex_normals == pytest.approx(mesh.vertex_normals, abs=1e-6)
    assert np.array_equal(loaded.visual.vertex_colors, mesh.visual.vertex_colors)


def test_glb_holds_normals_and_colors(mesh, tmp_path):
    """The suffix decides: a binary glTF file with the same positions, faces, normals and colours."""
    path = write_mesh(mesh, tmp_path / "mesh.GLB")
    assert path.read_bytes()[:4] == b"glTF" and [p.name for p in tmp_path.iterdir()] == ["mesh.GLB"]
    (loaded,) = trimesh.load(path, file_type="glb", process=False).geometry.values()
    assert np.array_equal(loaded.faces, mesh.faces)
    assert loaded.vertices == pytest.approx(mesh.vertices, abs=1e-6)
    assert loaded.vertex_normals == pytest.approx(mesh.vertex_normals, abs=1e-5)
    assert np.array_equal(loaded.visual.vertex_colors, mesh.visual.vertex_colors)


@pytest.mark.parametrize("name", ["mesh.ply", "mesh.glb"])
def test_open3d_reads_both(mesh, tmp_path, name):
    """Open3D opens the files with positions, colours and normals."""
    o3d = pytest.importorskip("open3d", reason="open3d can't be imported here")
    loaded = o3d.io.read_triangle_mesh(str(write_mesh(mesh, tmp_path / name)))
    # Its glTF reader numbers the vertices anew, so they are compared by triangle corner.
    corners = np.asarray(loaded.triangles)
    assert corners.shape == mesh.faces.shape
    assert np.asarray(loaded.vertices)[corners] == pytest.approx(mesh.vertices[mesh.faces], abs=1e-6)
    assert np.asarray(loaded.vertex_normals)[corners] == pytest.approx(mesh.vertex_normals[mesh.faces], abs=1e-5)
    colors = 255 * np.asarray(loaded.vertex_colors)[corners]
    assert np.abs(colors - mesh.visual.vertex_colors[mesh.faces][..., :3]).max() <= 1


def test_unwritable_mesh_is_an_error(mesh, tmp_path):
    """A missing folder, an unknown suffix and an empty mesh are named."""
    with pytest.raises(MeshError, match="nowhere"):
        write_mesh(mesh, tmp_path / "nowhere" / "mesh.ply")
    with pytest.raises(MeshError, match=r"mesh\.stl: .*\.ply or \.glb"):
        write_mesh(mesh, tmp_path / "mesh.stl")
    with pytest.raises(MeshError, match="no faces"):
        write_mesh(trimesh.Trimesh(), tmp_path / "mesh.ply")
