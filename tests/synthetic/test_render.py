"""Renderer: exact depth, conventions, colours and textures."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from PIL import Image

from warpslam.camera import Intrinsics
from warpslam.errors import ConfigError, InputError, MeshError
from warpslam.synthetic import MeshRenderer, load_mesh, look_at, make_room, sensor_noise
from warpslam.synthetic.render import TEXTURE_LIMIT, ColoredTriangles

CAMERA = Intrinsics(40.0, 42.0, 31.5, 23.5, 64, 48)
LIGHT = (0.0, 0.0, 1.0)


def back_project(depth: np.ndarray, k: Intrinsics, T_world_camera: np.ndarray) -> np.ndarray:
    i, j = np.meshgrid(np.arange(k.width), np.arange(k.height))
    points = np.stack([(i - k.cx) / k.fx * depth, (j - k.cy) / k.fy * depth, depth], axis=-1)
    return points.reshape(-1, 3) @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]


@pytest.fixture(scope="module")
def box_room() -> trimesh.Trimesh:
    return trimesh.creation.box(extents=(4.0, 6.0, 2.5))


def test_depth_of_a_box_room_is_exact(box_room):
    """Depth equals the analytic distance along z to the walls of a box, to 0.1 mm."""
    T = look_at([0.3, -0.4, 0.2], [1.0, 2.0, -0.3])
    depth = MeshRenderer(box_room, CAMERA).render(T)[1]
    i, j = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    rays = np.stack([(i - CAMERA.cx) / CAMERA.fx, (j - CAMERA.cy) / CAMERA.fy, np.ones(i.shape)], axis=-1)
    rays = rays @ T[:3, :3].T
    half = np.array([2.0, 3.0, 1.25])
    exact = ((np.sign(rays) * half - T[:3, 3]) / rays).min(axis=-1)
    np.testing.assert_allclose(depth, exact, atol=1e-4)


def test_depth_is_z_and_not_range(box_room):
    """A wall square to the optical axis has the same depth in the corner of the image as in its middle."""
    depth = MeshRenderer(box_room, CAMERA.cropped(16)).render(look_at([0, 0, 0], [0, 3, 0]))[1]
    np.testing.assert_allclose(depth, 3.0, atol=1e-4)


def test_pixel_centres_are_integers(box_room):
    """A ray's pixel is where the point projects to with no half-pixel shift."""
    camera = Intrinsics(40.0, 40.0, 20.0, 10.0, 41, 21)
    small = trimesh.creation.box(extents=(0.02, 0.02, 0.02))
    small.apply_translation([2.0 * (25 - 20) / 40, 2.0 * (4 - 10) / 40, 2.0])
    depth = MeshRenderer(small, camera).render(np.eye(4))[1]
    assert np.argwhere(depth > 0).tolist() == [[4, 25]]


def test_misses_are_zero(box_room):
    """From outside, pixels beside the box have depth 0 and are black; a far hit beyond the limit is a miss."""
    T = look_at([0, -30, 0], [0, 0, 0])
    rgb, depth = MeshRenderer(box_room, CAMERA).render(T)
    assert (depth == 0).mean() > 0.5 and (depth > 0).any()
    assert (rgb[depth == 0] == 0).all()
    assert (MeshRenderer(box_room, CAMERA, max_depth=20.0).render(T)[1] == 0).all()


def test_back_projected_depth_lies_on_the_mesh():
    """With OpenCV axes and camera-to-world poses, depth back-projects onto the room's surface."""
    room = make_room(1)
    low, high = room.interior_bounds
    T = look_at((low + high) / 2, [low[0] + 1.0, low[1] + 0.7, 0.5])
    depth = MeshRenderer(room.mesh(0.1), CAMERA).render(T)[1]
    assert (depth > 0).mean() > 0.999
    points = back_project(depth, CAMERA, T)
    step = 0.003 * (points - T[:3, 3]) / np.linalg.norm(points - T[:3, 3], axis=1, keepdims=True)
    crossed = room.occupancy(points + step) & ~room.occupancy(points - step)
    assert crossed.mean() > 0.97


def test_look_at_axes():
    """Looking along +y: image right is +x, image down is -z, and the optical axis hits the target."""
    T = look_at([1, 2, 3], [1, 5, 3])
    np.testing.assert_allclose(T[:3, :3], np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]), atol=1e-12)
    np.testing.assert_allclose(T[:3, 3], [1, 2, 3])
    with pytest.raises(InputError, match="vertical"):
        look_at([0, 0, 0], [0, 0, 1])


def test_colors_are_interpolated_and_do_not_depend_on_the_view():
    """One surface point has the same colour from two views, the interpolated one times the shading."""
    floor = trimesh.Trimesh(
        [[-2, -2, 0], [2, -2, 0], [2, 2, 0], [-2, 2, 0]],
        [[0, 1, 2], [0, 2, 3]],
        vertex_colors=[[0, 40, 200], [200, 40, 200], [200, 240, 200], [0, 240, 200]],
        process=False,
    )
    renderer = MeshRenderer(floor, Intrinsics(300.0, 300.0, 10.0, 10.0, 21, 21), light=LIGHT)
    point = np.array([0.4, -0.6, 0.0])
    expected = [200 * 2.4 / 4, 40 + 200 * 1.4 / 4, 200]
    for eye in ([0.0, -3.0, 1.0], [3.0, 1.0, 2.0], [-2.0, 2.0, -1.0]):
        rgb, _ = renderer.render(look_at(eye, point))
        np.testing.assert_allclose(rgb[10, 10].astype(float), expected, atol=1.0)


def test_shading_is_two_sided_lambert():
    """A face edge-on to the light keeps the ambient part, and turning its winding changes nothing."""
    square = [[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]]
    values = []
    for faces in ([[0, 1, 2], [0, 2, 3]], [[0, 2, 1], [0, 3, 2]]):
        mesh = trimesh.Trimesh(square, faces, vertex_colors=[[200, 200, 200]] * 4, process=False)
        for light in (LIGHT, (0.0, 1.0, 0.0)):
            rgb, _ = MeshRenderer(mesh, CAMERA, light=light).render(look_at([0, -2, 0], [0, 0, 0]))
            values.append(int(rgb[24, 32, 0]))
    assert values == [110, 200, 110, 200]


def textured_square(image: Image.Image, shift: float) -> trimesh.Trimesh:
    vertices = np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1.0]]) + [shift, 0, 0]
    visual = trimesh.visual.TextureVisuals(
        uv=[[0, 0], [1, 0], [1, 1], [0, 1]], material=trimesh.visual.material.SimpleMaterial(image=image)
    )
    return trimesh.Trimesh(vertices, [[0, 1, 2], [0, 2, 3]], visual=visual, process=False)


def test_each_geometry_of_a_scene_keeps_its_texture():
    """Two textured squares show their own images the right way up: v = 1 is the top."""
    quadrants = np.zeros((8, 8, 3), np.uint8)
    quadrants[:4, :4], quadrants[:4, 4:], quadrants[4:, :4] = (200, 0, 0), (0, 200, 0), (0, 0, 200)
    plain = Image.new("RGBA", (5, 3), (10, 20, 30, 255))
    scene = trimesh.Scene([textured_square(Image.fromarray(quadrants), -1.1), textured_square(plain, 1.1)])
    renderer = MeshRenderer(scene, CAMERA, light=(0.0, 1.0, 0.0))
    rgb, _ = renderer.render(look_at([-1.1, -2, 0], [-1.1, 0, 0]))
    assert rgb[14, 22].tolist() == [200, 0, 0]
    assert rgb[14, 41].tolist() == [0, 200, 0]
    assert rgb[33, 22].tolist() == [0, 0, 200]
    assert rgb[33, 41].tolist() == [0, 0, 0]
    rgb, _ = renderer.render(look_at([1.1, -2, 0], [1.1, 0, 0]))
    assert rgb[24, 32].tolist() == [10, 20, 30]


def test_large_textures_are_reduced():
    """Textures are limited in size, in proportion."""
    triangles = ColoredTriangles.from_trimesh(textured_square(Image.new("RGB", (4 * TEXTURE_LIMIT, 40)), 0.0))
    assert triangles.textures[0].shape == (10, TEXTURE_LIMIT, 3)


def test_load_mesh_keeps_materials(tmp_path):
    """A textured OBJ file written to disk renders in its texture's colour."""
    path = tmp_path / "square.obj"
    textured_square(Image.new("RGB", (4, 4), (30, 120, 60)), 0.0).export(path)
    rgb, _ = MeshRenderer(load_mesh(path), CAMERA, light=(0.0, 1.0, 0.0)).render(look_at([0, -2, 0], [0, 0, 0]))
    np.testing.assert_allclose(rgb[24, 32].astype(int), [30, 120, 60], atol=1)


def test_bad_input_is_named(tmp_path, box_room):
    """Missing files, point clouds, NaN vertices, a zero light and a bad pose raise typed errors."""
    with pytest.raises(MeshError, match="none.obj"):
        load_mesh(tmp_path / "none.obj")
    with pytest.raises(MeshError, match="no triangles"):
        MeshRenderer(trimesh.Trimesh(np.zeros((3, 3)), np.zeros((0, 3), int)), CAMERA)
    broken = box_room.copy()
    broken.vertices[0] = np.nan
    with pytest.raises(MeshError, match="NaN"):
        MeshRenderer(broken, CAMERA)
    with pytest.raises(ConfigError, match="light"):
        MeshRenderer(box_room, CAMERA, light=(0, 0, 0))
    with pytest.raises(InputError, match="T_world_camera"):
        MeshRenderer(box_room, CAMERA).render(np.eye(3))


def test_noise_grows_with_depth():
    """The spread on a flat wall follows 1.2 mm + 1.9 mm (z - 0.4)^2, and nothing is lost in its middle."""
    rng = np.random.default_rng(0)
    for z in (1.0, 3.0):
        noisy = sensor_noise(np.full((48, 64), z), rng, CAMERA, baseline=0.0)
        assert (noisy > 0).all()
        assert noisy.std() == pytest.approx(0.0012 + 0.0019 * (z - 0.4) ** 2, rel=0.1)
        assert noisy.mean() == pytest.approx(z, abs=0.002)


def test_noise_quantises_disparity():
    """Without axial noise, f b / z is a multiple of the disparity step."""
    camera = Intrinsics(525.0, 525.0, 31.5, 23.5, 64, 48)
    depth = np.random.default_rng(1).uniform(1, 4, size=(48, 64))
    noisy = sensor_noise(depth, np.random.default_rng(0), camera, edge=1e9, grazing=90.0)
    steps = 525 * 0.075 / noisy * 8
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-3)


def test_noise_makes_holes_at_edges_and_keeps_missing_depth():
    """About half of the pixels along a depth step vanish, missing depth stays missing, far depth is dropped."""
    depth = np.full((48, 64), 1.0)
    depth[:, 32:] = 2.0
    depth[0] = 0.0
    depth[47] = 9.0
    noisy = sensor_noise(depth, np.random.default_rng(0), CAMERA)
    assert 0.2 < (noisy[2:46, 31:33] == 0).mean() < 0.8
    assert (noisy[2:46, :28] > 0).all()
    assert (noisy[0] == 0).all() and (noisy[47] == 0).all()
    assert noisy.dtype == np.float32


def test_noise_makes_holes_at_grazing_angles():
    """A wall almost parallel to the rays loses depth that a frontal one keeps."""
    i = np.arange(64)
    # The plane x = 0.5 m, along the optical axis: a ray of slope u makes an angle of acot(u) with its normal.
    slope = (i - CAMERA.cx) / CAMERA.fx
    depth = np.tile(np.where(slope > 0, 0.5 / np.maximum(slope, 1e-3), 0.0), (48, 1))
    noisy = sensor_noise(depth, np.random.default_rng(0), CAMERA, edge=1e9, grazing=60.0, max_depth=100.0)
    grazing = slope < 1 / np.tan(np.radians(60.0))
    assert 0.3 < (noisy[:, grazing & (i > 34)] == 0).mean() < 0.7
    assert (noisy[2:-2, ~grazing][:, 2:] > 0).mean() > 0.8
