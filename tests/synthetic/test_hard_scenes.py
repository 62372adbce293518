"""Scenes that are hard to track through: what is hard about them, and that their truth is exact."""

from __future__ import annotations

import numpy as np
import pytest

from warpslam.camera import Intrinsics
from warpslam.errors import ConfigError
from warpslam.synthetic import HARD_SCENES, AntialiasedRenderer, HardScene, MeshRenderer, RenderedSequence
from warpslam.synthetic.hand_held import steps, turns
from warpslam.synthetic.hard_scenes import sheet

CAMERA = Intrinsics(80.0, 80.0, 47.5, 35.5, 96, 72)


@pytest.fixture(scope="module", params=HARD_SCENES)
def scene(request) -> HardScene:
    return HardScene(request.param, intrinsics=CAMERA, device="cpu")


def kind(scene: HardScene) -> str:
    return scene.name.split("_")[0]


def test_way_and_pace(scene):
    """20 m at 14 cm a frame; a closed circle of 14 cm and 7 degrees a frame; 8 m of wall there and back."""
    poses = scene.ground_truth()
    moved, turned = steps(poses), turns(poses)
    if kind(scene) == "corridor":
        np.testing.assert_allclose(moved, 0.14, rtol=1e-6)
        assert moved.sum() == pytest.approx(20.0, abs=0.1) and turned.max() < 6.0
        assert 0.35 < 0.8 - np.abs(poses[:, 1, 3]).max() < 0.6  # [m] to the nearer wall
    elif kind(scene) == "cabinet":
        assert moved.mean() == pytest.approx(0.14, abs=0.003) and turned.mean() == pytest.approx(7.0, abs=0.2)
        assert np.linalg.norm(poses[0, :3, 3] - poses[51, :3, 3]) < 0.1
    else:
        assert moved.mean() == pytest.approx(0.085, abs=0.005) and np.ptp(poses[:, 0, 3]) == pytest.approx(8.0)


def test_points_of_the_depth_lie_on_the_surface(scene):
    """Depth and pose of several frames agree with the mesh; beyond 5 m nothing is measured."""
    from trimesh.proximity import closest_point_naive

    for index in np.linspace(0, len(scene) - 1, 3).astype(int):
        frame = scene[int(index)]
        v, u = (side.ravel() for side in np.mgrid[5:72:22, 5:96:22])
        z = frame.depth[v, u].astype(np.float64)
        points = np.stack([(u - CAMERA.cx) / CAMERA.fx * z, (v - CAMERA.cy) / CAMERA.fy * z, z], axis=1)[z > 0]
        T = frame.T_world_camera
        assert closest_point_naive(scene.mesh, points @ T[:3, :3].T + T[:3, 3])[1].max() < 2e-3
        assert 0.1 < frame.depth[frame.depth > 0].min() and frame.depth.max() <= 5.0


def test_what_is_hard(scene):
    """Along the corridor most of the view is one or two planes; the cabinet has next to no edges in colour inside its
    faces; the posters' wall is a plane to the millimetre, and colour changes on it.
    """
    if kind(scene) == "posters":
        for index in (0, 57, 150):
            frame = scene[index]
            rows, columns = np.mgrid[:72, :96]
            rays = np.stack([(columns - 47.5) / 80.0, (rows - 35.5) / 80.0, np.ones((72, 96))], axis=-1)
            points = (rays * frame.depth[..., None]) @ frame.T_world_camera[:3, :3].T + frame.T_world_camera[:3, 3]
            assert np.abs(points[..., 1]).max() < 2e-3
            assert frame.rgb.astype(float).std() > 25
        return
    gradients = []
    for index in range(0, len(scene), 7):
        frame = scene[index]
        gray = frame.rgb.mean(axis=2)
        inside = np.abs(np.diff(frame.depth, n=2, axis=1)[1:-1]) < 3e-3  # no edge of the surface
        gradients.append(np.abs(np.diff(gray, axis=1))[1:-1, 1:][inside])
    gradient = np.concatenate(gradients)
    if kind(scene) == "cabinet":
        assert np.quantile(gradient, 0.95) < 3 and gradient.mean() > 0.05
    else:
        assert np.quantile(gradient, 0.75) < 4 and np.quantile(gradient, 0.99) > 10  # thin lines on plain tiles


def test_seed_decides(scene):
    """The same seed gives the same frame, another one other colours."""
    again, other = (HardScene(kind(scene), 30, seed=seed, intrinsics=CAMERA, device="cpu") for seed in (0, 1))
    np.testing.assert_array_equal(again[20].rgb, scene[20].rgb)
    assert len(again) == 30 and not np.array_equal(other[20].rgb, scene[20].rgb)


def test_unknown_scene():
    """The message names those that there are."""
    with pytest.raises(ConfigError, match="corridor, cabinet, posters"):
        HardScene("cellar")


def test_a_pixel_is_the_mean_over_its_area():
    """Black and white halves meet at a pixel's middle: half grey with several rays, black or white with one; depth is
    the same.
    """
    import trimesh

    def halves(u, v):
        return np.repeat((u > 0.5)[:, None], 3, axis=1).astype(float)

    x, y, _ = np.eye(3)
    vertices, faces, colors = sheet([-0.5, -0.5, 1.0], x, y, np.array([0.0, 0.5, 1.0]), np.array([0.0, 1.0]), halves)
    mesh = trimesh.Trimesh(vertices, faces, vertex_colors=colors, process=False)
    camera = Intrinsics(40.0, 40.0, 10.0, 10.0, 21, 21)
    (rgb, depth), (plain, expected) = (make(mesh, camera, device="cpu").render(np.eye(4)) for make in (
        AntialiasedRenderer, MeshRenderer
    ))  # fmt: skip
    white = int(plain[10, 15, 0])
    assert white > 100 and plain[10, 5, 0] == 0
    assert rgb[10, 10, 0] == pytest.approx(white / 2, abs=1) and rgb[10, 9, 0] == 0 and rgb[10, 11, 0] == white
    np.testing.assert_array_equal(depth, expected)


def test_motion_blur_is_the_mean_of_the_way():
    """Blur changes colour along the motion only, leaves depth and pose alone, and is none where the camera stands."""
    scene = HardScene("posters", 12, intrinsics=CAMERA, device="cpu")
    poses = scene.ground_truth()
    blurred = RenderedSequence("blurred", scene._renderer, poses, exposure=0.5)
    sharp = RenderedSequence("sharp", scene._renderer, poses)
    a, b = blurred[5], sharp[5]
    np.testing.assert_array_equal(a.depth, b.depth)
    np.testing.assert_array_equal(a.T_world_camera, b.T_world_camera)
    across, down = ([np.abs(np.diff(frame.rgb.astype(float), axis=axis)).mean() for frame in (a, b)] for axis in (1, 0))
    assert across[0] < 0.8 * across[1] and down[0] > 0.8 * down[1]
    still = RenderedSequence("still", scene._renderer, np.repeat(poses[:1], 3, axis=0), exposure=0.5)
    np.testing.assert_array_equal(still[1].rgb, sharp[0].rgb)
