"""What counts under each protocol: a wall with another one behind it, and a camera whose image is known."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from warpslam.camera import Intrinsics
from warpslam.errors import ConfigError, InputError, MeshError
from warpslam.evaluation import PROTOCOLS, Culling, Views, sample_surface, visible_points
from warpslam.evaluation.culling import _ball_in_frustum
from warpslam.poses import pose_from_vector

CAMERA = Intrinsics(100, 100, 49.5, 49.5, 100, 100)


def plane(width: float, z: float) -> trimesh.Trimesh:
    """A square of two triangles, ``width`` on a side, centred on the z axis and facing it."""
    half = width / 2
    corners = np.array([[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]])
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)


def two_walls() -> trimesh.Trimesh:
    """A 4 m wall at 1 m and one at 2 m behind it."""
    return trimesh.util.concatenate([plane(4, 1), plane(4, 2)])


FRAME = Views(np.eye(4)[None], CAMERA, [np.full((100, 100), 1.0, np.float32)])
# The same camera, whose image has one pixel that reaches far.
DEEP = Views(np.eye(4)[None], CAMERA, [np.full((100, 100), 1.0, np.float32)])
DEEP.depths[0][0, 0] = 3.0
# A camera between the walls that looks at the second one.
BETWEEN = Views(np.eye(4)[None].copy(), CAMERA, [np.full((100, 100), 0.5, np.float32)])
BETWEEN.poses[0, 2, 3] = 1.5


def test_visibility_follows_the_frustum():
    """In the image, outside it, behind the camera, and with a camera elsewhere or nowhere."""
    points = np.array([[0, 0, 1], [0.49, 0, 1], [0.52, 0, 1], [0, 0, -1]])
    np.testing.assert_array_equal(visible_points(points, [np.eye(4)], CAMERA), [True, True, False, False])
    back = pose_from_vector(np.array([0, 0, 1, 0, 0, 0, 0.0]))
    np.testing.assert_array_equal(visible_points(points, [np.eye(4), back], CAMERA), [True, True, False, True])
    np.testing.assert_array_equal(visible_points(points, [np.full((4, 4), np.nan)], CAMERA), [False] * 4)


def test_visibility_respects_occlusion():
    """Behind a surface at 1 m only 5 cm count; a pixel without depth shows nothing; an unknown pose keeps its depth."""
    points = np.array([[0, 0, 0.5], [0, 0, 1.04], [0, 0, 1.06], [0.4, 0.4, 1.0]])
    depth = np.full((100, 100), 1.0, dtype=np.float32)
    depth[80:, 80:] = 0
    poses = [np.full((4, 4), np.nan), np.eye(4)]
    seen = visible_points(points, poses, CAMERA, [np.full((100, 100), 9.0), depth])
    np.testing.assert_array_equal(seen, [True, True, False, False])


@pytest.mark.parametrize("shape", [(100, 99), (4, 4), (200, 200), (10000,)])
def test_depth_of_another_size_is_refused(shape):
    """Its pixels would be read from wherever the camera's lie; nothing else of it is looked at."""
    with pytest.raises(InputError, match=r"depths\[1\] has shape"):
        visible_points(np.eye(3), [np.eye(4)] * 2, CAMERA, [np.ones((100, 100)), np.ones(shape)])


def test_negative_tolerance_means_in_front():
    """A point counts as seen free only where it lies that far before the surface."""
    points = np.array([[0, 0, 0.7], [0, 0, 0.9]])
    depth = np.full((100, 100), 1.0, dtype=np.float32)
    np.testing.assert_array_equal(visible_points(points, [np.eye(4)], CAMERA, [depth], tolerance=-0.2), [True, False])


def test_protocols_by_hand():
    """In the image: 1 m^2 of the near wall and 4 m^2 of the far one; hidden: the far one; virtual: 0.25 m^2 of it."""
    mesh = two_walls()
    shares = {"frustum": 4 / 5, "frustum+occlusion": 0.0, "frustum+occlusion+virtual": 0.25 / 1.25}
    assert set(shares) == set(PROTOCOLS)
    for protocol, share in shares.items():
        culling = Culling(protocol, DEEP, BETWEEN)
        points, normals = sample_surface(mesh, 20_000, culling=culling)
        assert len(points) == len(normals) == 20_000
        assert (points[:, 2] > 1.5).mean() == pytest.approx(share, abs=0.01), protocol
        assert culling.keeps(points).all()
        near = points[points[:, 2] < 1.5]
        assert np.abs(near[:, :2]).max() <= 0.5 + 1e-9
        np.testing.assert_allclose(near[:, :2].mean(axis=0), 0, atol=0.02)


def test_virtual_cameras_do_not_reach_beyond_the_frames():
    """What lies deeper than all that a frame measured, or beside its image, is not asked for by the third protocol."""
    points = np.array([[0.0, 0.0, 2.0], [0.2, 0.0, 2.0], [1.1, 0.0, 2.0]])
    wide = Views(BETWEEN.poses, Intrinsics(20, 20, 49.5, 49.5, 100, 100), BETWEEN.depths)
    deep, shallow = (Culling("frustum+occlusion+virtual", frames, wide) for frames in (DEEP, FRAME))
    np.testing.assert_array_equal(deep.keeps(points), [True, True, False])
    np.testing.assert_array_equal(shallow.keeps(points), [False] * 3)


def test_a_hidden_room_is_an_error():
    """Where nothing counts, the message says under which protocol."""
    with pytest.raises(MeshError, match=r"none of the 2 faces .* under frustum\+occlusion"):
        sample_surface(plane(1, 3), 100, culling=Culling("frustum+occlusion", FRAME))
    assert len(sample_surface(plane(1, 3), 100, culling=Culling("frustum", FRAME))[0]) == 100


def test_a_small_part_gives_fewer_points():
    """A sliver of a large mesh ends with what was found, not with an error and not without end."""
    far = trimesh.util.concatenate([plane(0.02, 1), plane(100, 1)])
    tiny = Views(np.eye(4)[None], Intrinsics(10_000, 10_000, 49.5, 49.5, 100, 100), FRAME.depths)
    points, _ = sample_surface(far, 1_000, culling=Culling("frustum", tiny))
    assert 0 < len(points) < 1_000


def test_balls_in_a_frustum_are_never_missed():
    """Every ball around a visible point passes; balls wholly beside, behind or beyond the view do not."""
    rng = np.random.default_rng(0)
    T = pose_from_vector(np.array([0.9, 0.1, -0.3, 0.2, 0.5, -0.2, 0.3]))
    centers, radii = rng.uniform(-3, 3, (4_000, 3)), rng.uniform(0.01, 1.0, 4_000)
    offsets = rng.normal(size=(4_000, 3))
    offsets *= radii[:, None] * rng.uniform(0, 1, (4_000, 1)) / np.linalg.norm(offsets, axis=1)[:, None]
    inner = centers + offsets
    inside = _ball_in_frustum(centers, radii, T, CAMERA, 2.0)
    z = ((inner - T[:3, 3]) @ T[:3, :3])[:, 2]
    visible = visible_points(inner, [T], CAMERA) & (z < 2.0)
    assert visible.sum() > 30 and inside[visible].all()
    assert inside.mean() < 0.5
    outside = np.array([[0.9, 0, 1], [0, -0.9, 1], [0, 0, -0.3], [0, 0, 2.3]])
    assert not _ball_in_frustum(outside, np.full(4, 0.2), np.eye(4), CAMERA, 2.0).any()


def test_unknown_protocols_are_config_errors():
    """The message lists the names; the protocol with virtual cameras needs some."""
    with pytest.raises(ConfigError, match=r"'occlusion' is unknown; choose one of frustum, frustum\+occlusion"):
        Culling("occlusion", FRAME)
    with pytest.raises(ConfigError, match="needs virtual views"):
        Culling("frustum+occlusion+virtual", FRAME)
