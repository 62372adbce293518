"""Virtual cameras in a box room whose depth is exact."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from warpslam.camera import Intrinsics
from warpslam.evaluation import Culling, Views, sample_surface, virtual_depth
from warpslam.evaluation.virtual_views import CAMERA, _look_at, _renderer, virtual_culling_views, virtual_poses

FRAME_CAMERA = Intrinsics(60, 60, 59.5, 44.5, 120, 90)
DOWN = np.array([0.0, 0.0, -1.0])


def room(offset: float = 0.0) -> trimesh.Trimesh:
    """A box of 4 x 3 x 2.5 m, seen from within, every wall ``offset`` [m] farther out."""
    mesh = trimesh.creation.box(extents=np.array([4.0, 3.0, 2.5]) + 2 * offset)
    mesh.invert()
    return mesh


@pytest.fixture(scope="module")
def frames() -> Views:
    """Twelve cameras in the middle that look around, up and down."""
    directions = [(np.cos(a), np.sin(a), 0) for a in np.linspace(0, 2 * np.pi, 8, endpoint=False)]
    directions += [(0.1, 0, 1), (0, 0.1, 1), (0.1, 0, -1), (0, 0.1, -1)]
    poses = np.array([_look_at(np.zeros(3), np.array(d, dtype=float), DOWN) for d in directions])
    renderer = _renderer(room(), FRAME_CAMERA, "cpu")
    return Views(poses, FRAME_CAMERA, [renderer.render(T)[1] for T in poses])


@pytest.fixture(scope="module")
def culling(frames) -> Culling:
    """All that the frames saw: the whole room."""
    return Culling("frustum+occlusion", frames)


@pytest.fixture(scope="module")
def targets(culling) -> np.ndarray:
    """Points of the walls."""
    return sample_surface(room(), 2_000, culling=culling)[0]


def test_cameras_stand_in_free_space_and_look_at_the_targets(frames, targets):
    """At least the clearance away from the walls along the rays of the frames, and each has a target on its axis."""
    poses = virtual_poses(targets, frames, 40, np.random.default_rng(0))
    assert 30 <= len(poses) <= 40
    # 20 cm along z of a frame are at least 10 cm off a wall that is seen up to 60 degrees off the axis.
    assert (np.abs(poses[:, :3, 3]) < np.array([2.0, 1.5, 1.25]) - 0.1).all()
    for T in poses:
        local = (targets - T[:3, 3]) @ T[:3, :3]
        assert (np.linalg.norm(local[:, :2], axis=1)[local[:, 2] > 0].min()) < 1e-9
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(T[:3, :3]) > 0 and T[2, 1] <= 1e-12


def test_depth_of_the_true_surface_is_exact(culling, targets):
    """The truth against itself: no error, no miss, as many views as asked for."""
    result = virtual_depth(room(), room(), targets, culling, view_count=4, device="cpu")
    assert result.view_count == 4 and result.drawn_count >= 4
    assert result.l1 == pytest.approx(0, abs=1e-6) and result.missed_share == 0.0


def test_walls_farther_out_by_hand(culling, targets):
    """Walls 3 cm farther out are 3 cm / cos off along z: at least 3 cm nowhere less, and a few more on average."""
    result = virtual_depth(room(0.03), room(), targets, culling, view_count=4, device="cpu")
    assert 0.03 <= result.l1 < 0.08
    assert result.missed_share == 0.0 and result.l1_misses_as_zero == pytest.approx(result.l1)


def test_misses_are_told_apart(culling, targets):
    """A reconstruction without one wall: the rest is exact, and the hole is a share that counts as depth 0."""
    mesh = room()
    mesh.update_faces(mesh.face_normals[:, 0] < 0.5)
    result = virtual_depth(mesh, room(), targets, culling, view_count=8, device="cpu")
    assert result.l1 == pytest.approx(0, abs=1e-6)
    assert 0.02 < result.missed_share < 0.6
    assert result.l1_misses_as_zero > result.missed_share * 0.5


def test_views_of_what_no_frame_saw_are_rejected(frames, targets):
    """With frames that look one way only, views that show the other half are not used; without free space, none is."""
    forward = Views(frames.poses[:1], FRAME_CAMERA, frames.depths[:1])
    culling = Culling("frustum+occlusion", forward)
    seen = sample_surface(room(), 500, culling=culling)[0]
    result = virtual_depth(room(), room(), seen, culling, view_count=3, device="cpu")
    assert result.drawn_count > result.view_count
    assert result.view_count == 0 or result.l1 == pytest.approx(0, abs=1e-6)
    blind = Culling("frustum", Views(frames.poses[:1], FRAME_CAMERA, [np.zeros((90, 120), np.float32)]))
    nothing = virtual_depth(room(), room(), seen, blind, view_count=3, device="cpu")
    assert (nothing.view_count, nothing.l1, nothing.missed_share) == (0, None, None)


def test_views_repeat_with_their_seed(culling, targets):
    """The same seed gives the same figures, another one others."""
    first, again, other = (
        virtual_depth(room(0.03), room(), targets, culling, view_count=2, seed=seed, device="cpu") for seed in (0, 0, 1)
    )
    assert first == again and first != other


def test_virtual_cameras_of_the_protocol_have_the_true_depth(frames, targets):
    """Their depth images are those of the true mesh at their poses."""
    views = virtual_culling_views(room(), targets, frames, device="cpu")
    assert len(views.depths) == len(views.poses) > 20 and views.intrinsics == FRAME_CAMERA
    for T, depth in zip(views.poses[:3], views.depths, strict=False):
        ray = T[:3, 2]
        half = np.array([2.0, 1.5, 1.25])
        expected = np.min(((np.sign(ray) * half) - T[:3, 3]) / np.where(ray == 0, 1e-30, ray))
        # The image's middle lies half a pixel off the axis.
        assert depth[44:46, 59:61].min() - 0.03 <= expected <= depth[44:46, 59:61].max() + 0.03


def test_renderer_agrees_with_open3d():
    """Depth from the virtual camera against Open3D's ray caster on a sphere."""
    o3d = pytest.importorskip("open3d", reason="open3d can't be imported here")
    ball = trimesh.creation.icosphere(subdivisions=3)
    T = _look_at(np.array([0.0, -3.0, 0.5]), np.zeros(3), DOWN)
    depth = _renderer(ball, CAMERA, "cpu").render(T)[1]
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(np.float32(ball.vertices), np.uint32(ball.faces))
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], -1) @ T[:3, :3].T
    origin = np.broadcast_to(T[:3, 3], rays.shape)
    hit = scene.cast_rays(np.float32(np.concatenate([origin, rays], -1)))["t_hit"].numpy()
    hit = np.where(np.isfinite(hit), hit, 0.0)
    both = (hit > 0) & (depth > 0)
    # At the outline one of the two may just miss.
    assert ((hit > 0) != (depth > 0)).mean() < 0.002 and both.mean() > 0.1
    np.testing.assert_allclose(depth[both], hit[both], atol=1e-4)
