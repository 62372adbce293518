"""Pictures in a report: colour maps and the views of a mesh."""

from __future__ import annotations

import base64
import io

import numpy as np
import trimesh
from PIL import Image

from warpslam.report import pictures as images
from warpslam.report.pictures import VIEW_HEIGHT, VIEW_WIDTH, color_map, data_uri, mesh_views


def decoded(uri: str) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(uri.split(",")[1]))).convert("RGBA")).astype(int)


def room() -> tuple[trimesh.Trimesh, np.ndarray]:
    """A room of 4 x 3 x 2.5 m seen from inside, red floor and blue ceiling, and cameras 1.2 m up that look along y."""
    mesh = trimesh.creation.box(bounds=[[0, 0, 0], [4, 3, 2.5]])
    for _ in range(4):
        mesh = mesh.subdivide()
    mesh.invert()
    height = mesh.vertices[:, 2]
    colors = np.full((len(mesh.vertices), 4), 200, np.uint8)
    colors[height < 0.01] = [220, 0, 0, 255]
    colors[height > 2.49] = [0, 0, 220, 255]
    mesh.visual.vertex_colors = colors
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, :3, :3] = np.stack([[1, 0, 0], [0, 0, -1], [0, 1, 0]], axis=1)
    poses[:, :3, 3] = np.stack([np.linspace(1, 3, 5), np.full(5, 0.8), np.full(5, 1.2)], axis=1)
    return mesh, poses


def test_the_ceiling_is_cut_and_the_path_is_in_the_picture(monkeypatch):
    """From above one sees the floor, not the ceiling; the path over it, and around it nothing."""
    monkeypatch.setattr(images, "SUPERSAMPLING", 1)
    mesh, poses = room()
    views = mesh_views(mesh, poses)
    assert len(views) == 4 and "ceiling cut away" in views[0].title and views[3].path is None
    picture = decoded(views[0].uri)
    red = (picture[..., 0] > 100) & (picture[..., 2] < 60) & (picture[..., 3] > 200)
    blue = (picture[..., 2] > 100) & (picture[..., 0] < 60) & (picture[..., 3] > 200)
    assert red.mean() > 0.3 and blue.sum() == 0 and picture[0, 0, 3] == 0
    for view in views[:3]:
        u, v = view.path.T
        assert (u > 0).all() and (u < VIEW_WIDTH).all() and (v > 0).all() and (v < VIEW_HEIGHT).all()
        assert view.path[-1, 0] > view.path[0, 0] + 50
    x, y = views[0].path.round().astype(int).T
    assert red[y, x].all()
    assert len(mesh_views(mesh, poses, limit=1)) == 1


def test_a_mesh_below_the_cameras_is_left_whole(monkeypatch):
    """A table seen from above has no ceiling, and the titles claim none was cut."""
    monkeypatch.setattr(images, "SUPERSAMPLING", 1)
    mesh, poses = room()
    poses[:, 2, 3] = 4.0
    assert "ceiling" not in mesh_views(mesh, poses, limit=1)[0].title


def test_color_map_ends_and_missing():
    """Values beyond the ends take the end's colour, unknown ones are grey, NaN does no harm."""
    values = np.array([[-5.0, 0.0, 1.0, 9.0, np.nan]])
    image = color_map(values, "turbo", 0, 1, np.array([[True, True, True, True, False]]))
    assert (image[0, 0] == image[0, 1]).all() and (image[0, 2] == image[0, 3]).all()
    assert image[0, 4].tolist() == list(images.MISSING_COLOR)


def test_data_uri_holds_the_image():
    """What is read back is the picture, transparency included, to what a lossy format keeps."""
    picture = np.zeros((40, 60, 4), np.uint8)
    picture[:, 30:] = [200, 100, 50, 255]
    back = decoded(data_uri(picture))
    assert back.shape == picture.shape and (back[:, :28, 3] == 0).all()
    assert np.abs(back[:, 34:] - picture[:, 34:].astype(int)).max() < 12
