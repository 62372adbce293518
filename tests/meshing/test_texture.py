"""Textures: what the map has at a point is what the texture has there."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import trimesh

from warpslam.errors import InputError, MeshError, MissingDependencyError
from warpslam.meshing import texture
from warpslam.meshing.texture import textured, write_textured

SIZE = 256


def stripes(points: np.ndarray) -> np.ndarray:
    """Finer than the faces: vertex colours could not hold it."""
    return np.stack([0.5 + 0.5 * np.sin(12 * points[:, 0]), 0.5 + 0.4 * points[:, 1], np.full(len(points), 0.25)], 1)


@pytest.fixture(scope="module")
def ball() -> trimesh.Trimesh:
    """A coarse ball with a texture."""
    pytest.importorskip("xatlas")
    return textured(trimesh.creation.icosphere(subdivisions=2), stripes, SIZE)


def colors_of(mesh: trimesh.Trimesh, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World points inside the faces, and the texture's colours there, as a renderer would look them up."""
    weights = np.random.default_rng(0).dirichlet((2, 2, 2), (len(mesh.faces), 6))
    points = np.einsum("fnk,fkd->fnd", weights, mesh.vertices[mesh.faces]).reshape(-1, 3)
    uv = np.einsum("fnk,fkd->fnd", weights, np.asarray(mesh.visual.uv)[mesh.faces]).reshape(-1, 2)
    column = np.clip(np.rint(uv[:, 0] * image.shape[1] - 0.5), 0, image.shape[1] - 1).astype(int)
    row = np.clip(np.rint((1 - uv[:, 1]) * image.shape[0] - 0.5), 0, image.shape[0] - 1).astype(int)
    return points, image[row, column] / 255.0


def test_colours_are_those_of_the_map(ball):
    """At points within the faces, up to what a texel spans."""
    image = np.array(ball.visual.material.baseColorTexture.convert("RGB"))
    assert image.shape == (SIZE, SIZE, 3)
    points, found = colors_of(ball, image)
    assert np.abs(found - stripes(points)).mean() < 0.03
    assert np.quantile(np.abs(found - stripes(points)).max(axis=1), 0.99) < 0.25


def test_surface_stays(ball):
    """The same faces in space, as many and wound the same way."""
    plain = trimesh.creation.icosphere(subdivisions=2)
    assert len(ball.faces) == len(plain.faces) and ball.area == pytest.approx(plain.area)
    assert ball.volume == pytest.approx(plain.volume, rel=1e-6)


@pytest.mark.parametrize("suffix", [".glb", ".obj"])
def test_files(ball, tmp_path, suffix):
    """Another program reads the file with its texture, and finds the colours."""
    path = write_textured(ball, tmp_path / f"ball{suffix}")
    mesh = trimesh.load(path, force="mesh", process=False)
    material = mesh.visual.material
    picture = getattr(material, "baseColorTexture", None) or material.image
    points, found = colors_of(mesh, np.array(picture.convert("RGB")))
    assert np.abs(found - stripes(points)).mean() < 0.03
    if suffix == ".obj":
        assert "ball.mtl" in path.read_text()[:500] and (tmp_path / "ball.mtl").is_file()


def test_what_can_not_be(ball, tmp_path, monkeypatch):
    """Sizes, suffixes, too many faces, and a missing package."""
    plain = trimesh.creation.icosphere(subdivisions=1)
    with pytest.raises(InputError, match="64 to 8192"):
        textured(plain, stripes, 16)
    with pytest.raises(MeshError, match=".glb or .obj"):
        write_textured(ball, tmp_path / "a.ply")
    monkeypatch.setattr(texture, "MAX_FACES", 10)
    with pytest.raises(InputError, match="--faces"):
        textured(plain, stripes)
    monkeypatch.undo()
    monkeypatch.setitem(sys.modules, "xatlas", None)
    with pytest.raises(MissingDependencyError, match="pip install xatlas"):
        textured(plain, stripes)
