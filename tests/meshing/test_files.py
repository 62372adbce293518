"""Mesh files: what a reader gets back from them."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from warpslam.errors import MeshError
from warpslam.meshing import point_cloud, simplified, write_mesh, write_points


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
    with pytest.raises(MeshError, match=r"mesh\.xyz: .*\.ply or \.glb"):
        write_mesh(mesh, tmp_path / "mesh.xyz")
    with pytest.raises(MeshError, match="no faces"):
        write_mesh(trimesh.Trimesh(), tmp_path / "mesh.ply")


@pytest.mark.parametrize("suffix", [".obj", ".stl"])
def test_other_formats(mesh, tmp_path, suffix):
    """OBJ keeps positions, faces and colours; STL the surface."""
    path = write_mesh(mesh, tmp_path / f"mesh{suffix}")
    loaded = trimesh.load(path, process=False)
    assert len(loaded.faces) == len(mesh.faces)
    assert loaded.area == pytest.approx(mesh.area, rel=1e-4)
    if suffix == ".obj":
        assert loaded.vertices == pytest.approx(mesh.vertices, abs=1e-6)
        assert np.array_equal(loaded.visual.vertex_colors, mesh.visual.vertex_colors)


def test_fewer_faces(mesh):
    """About as many as were asked for, on the same surface, with its colours; all where that is no fewer."""
    pytest.importorskip("fast_simplification", reason="fast-simplification is not installed")
    small = simplified(mesh, 800)
    assert 600 < len(small.faces) <= 900
    assert np.quantile(cKDTree(mesh.vertices).query(small.vertices)[0], 0.9) < 0.02
    original = {tuple(color) for color in mesh.visual.vertex_colors}
    assert {tuple(color) for color in small.visual.vertex_colors} <= original
    assert simplified(mesh, 10**9) is mesh
    with pytest.raises(MeshError, match="3 faces are too few"):
        simplified(mesh, 3)


def test_points(mesh, tmp_path):
    """Vertices and colours come back; other suffixes are refused."""
    path = write_points(point_cloud(mesh), tmp_path / "cloud.ply")
    loaded = trimesh.load(path)
    assert isinstance(loaded, trimesh.PointCloud)
    assert loaded.vertices == pytest.approx(mesh.vertices, abs=1e-6)
    assert np.array_equal(loaded.colors, mesh.visual.vertex_colors)
    with pytest.raises(MeshError, match="points are written as .ply"):
        write_points(point_cloud(mesh), tmp_path / "cloud.obj")
