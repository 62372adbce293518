"""Meshes as the browser gets them."""

from __future__ import annotations

import io

import numpy as np
import trimesh

from warpslam.viewer.glb import glb


def test_another_program_reads_the_same_mesh():
    """Vertices and faces as they were, colours in linear light, within a step of 8 bits."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3.5]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    colors = np.array([[0, 10, 255, 255], [128, 128, 128, 255], [40, 200, 90, 255], [255, 255, 255, 255]], np.uint8)
    scene = trimesh.load(io.BytesIO(glb(vertices, faces, colors)), file_type="glb", process=False)
    (mesh,) = scene.geometry.values()
    np.testing.assert_array_equal(mesh.vertices, vertices)
    np.testing.assert_array_equal(mesh.faces, faces)
    srgb = colors[:, :3] / 255.0
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    read = np.asarray(mesh.visual.vertex_attributes["color"])[:, :3] / 65535.0
    assert np.abs(read - linear).max() < 1e-4
