"""Reconstruction errors on boxes and planes whose distances are known."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from warpslam.camera import Intrinsics, pose_from_vector
from warpslam.errors import InputError, MeshError
from warpslam.evaluation import (
    accuracy,
    align_icp,
    completion,
    completion_ratio,
    cull_mesh,
    depth_l1,
    evaluate_reconstruction,
    sample_surface,
    visible_points,
)

CAMERA = Intrinsics(100, 100, 49.5, 49.5, 100, 100)


def plane(width: float, z: float) -> trimesh.Trimesh:
    """A square of two triangles, ``width`` on a side, centred on the z axis and facing it."""
    half = width / 2
    corners = np.array([[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]])
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)


def test_distances_by_hand():
    """Two reconstructed points 1 cm and 3 cm off, and a true point 1 m from both."""
    points = np.array([[0, 0, 0.01], [1, 0, 0.03]])
    truth = np.array([[0, 0, 0], [1, 0, 0], [1, 0, 1.03]])
    assert accuracy(points, truth) == pytest.approx(0.02)
    assert completion(points, truth) == pytest.approx((0.01 + 0.03 + 1.0) / 3)
    assert completion_ratio(points, truth) == pytest.approx(2 / 3)
    assert completion_ratio(points, truth, distance=0.02) == pytest.approx(1 / 3)


def test_parallel_planes_are_their_distance_apart():
    """4 cm between two planes is accuracy and completion 4 cm and ratio 1; at 6 cm the ratio is 0."""
    for offset, ratio in ((0.04, 1.0), (0.06, 0.0)):
        result = evaluate_reconstruction(plane(1, 1 + offset), plane(1, 1), align=False)
        assert result.accuracy == pytest.approx(offset, abs=2e-4)
        assert result.completion == pytest.approx(offset, abs=2e-4)
        assert result.completion_ratio == ratio
        assert result.sample_count == 200_000


def test_half_a_reconstruction_is_accurate_and_incomplete():
    """Half of the true plane: accuracy near 0, completion ratio a little over one half."""
    truth = plane(2, 1)
    half = truth.copy()
    half.vertices[half.vertices[:, 0] > 0, 0] = 0
    result = evaluate_reconstruction(half, truth, sample_count=20_000, align=False)
    assert result.accuracy < 0.02
    assert result.completion_ratio == pytest.approx((1 + 0.05) / 2, abs=0.02)


def test_alignment_takes_a_small_motion_out():
    """A box moved by 3 cm and turned by 1 degree comes back: what is left is the spacing of the drawn points."""
    truth = trimesh.creation.box(extents=[1.0, 1.5, 2.0])
    T = pose_from_vector(np.array([1, 0, 0, np.radians(0.5), 0.02, -0.02, 0.01]))
    moved = truth.copy()
    moved.apply_transform(T)
    raw = evaluate_reconstruction(moved, truth, sample_count=30_000, align=False)
    result = evaluate_reconstruction(moved, truth, sample_count=30_000)
    spacing = evaluate_reconstruction(truth, truth, sample_count=30_000, align=False)
    assert raw.accuracy > 1.2 * spacing.accuracy
    assert result.accuracy == pytest.approx(spacing.accuracy, rel=0.02)
    np.testing.assert_allclose(result.T_truth_mesh @ T, np.eye(4), atol=5e-3)


def test_alignment_far_from_the_truth_is_identity():
    """With no pair within the threshold there is nothing to align."""
    points = np.random.default_rng(0).random((100, 3))
    np.testing.assert_array_equal(align_icp(points, points + 10), np.eye(4))


def test_points_are_uniform_over_area_and_repeat():
    """A triangle three times as large gets three times the points, none leaves it, one seed gives one set."""
    mesh = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 0, 0], [8, 0, 0], [5, 1, 0]], [[0, 1, 2], [3, 4, 5]])
    points = sample_surface(mesh, 20_000, seed=3)
    assert (points[:, 0] >= 5).mean() == pytest.approx(0.75, abs=0.01)
    left = points[points[:, 0] < 5]
    assert (left[:, :2].sum(axis=1) <= 1 + 1e-12).all()
    np.testing.assert_allclose(left.mean(axis=0), [1 / 3, 1 / 3, 0], atol=0.01)
    np.testing.assert_array_equal(points, sample_surface(mesh, 20_000, seed=3))
    assert not np.array_equal(points, sample_surface(mesh, 20_000, seed=4))


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


def test_culling_cuts_a_large_face_at_the_edge_of_the_view():
    """A 10 m plane 1 m away, whose corners no camera sees, keeps about the 1 m square in view when faces are split."""
    with pytest.raises(MeshError, match="none of the 2 faces"):
        cull_mesh(plane(10, 1), [np.eye(4)], CAMERA)
    culled = cull_mesh(plane(10, 1), [np.eye(4)], CAMERA, max_edge=0.1)
    assert 1.0 <= culled.area <= 1.35
    assert culled.faces.max() == len(culled.vertices) - 1


def test_depth_l1_over_valid_or_all_pixels():
    """Pixels without truth count only in the all-pixel protocol, where a miss is depth 0."""
    truth = np.array([[1.0, 2.0], [0.0, 0.0]])
    depth = np.array([[1.1, 0.0], [0.4, 0.0]])
    assert depth_l1(depth, truth) == pytest.approx((0.1 + 2.0) / 2)
    assert depth_l1(depth, truth, all_pixels=True) == pytest.approx((0.1 + 2.0 + 0.4) / 4)
    assert np.isnan(depth_l1(depth, np.zeros((2, 2))))
    with pytest.raises(InputError, match="same shape"):
        depth_l1(depth, truth[:1])


def test_meshes_without_a_surface_are_mesh_errors():
    """No face, faces without area, and a NaN vertex each say what is wrong."""
    with pytest.raises(MeshError, match="no surface"):
        sample_surface(trimesh.Trimesh())
    with pytest.raises(MeshError, match="no surface"):
        sample_surface(trimesh.Trimesh(np.zeros((3, 3)), [[0, 1, 2]], process=False))
    with pytest.raises(MeshError, match="NaN"):
        sample_surface(trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, np.nan, 0]], [[0, 1, 2]], process=False))
    with pytest.raises(InputError, match="no distances"):
        accuracy(np.zeros((0, 3)), np.zeros((1, 3)))
