"""Reconstruction errors on boxes and planes whose distances are known."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from warpslam.errors import InputError, MeshError
from warpslam.evaluation import (
    accuracy,
    align_icp,
    completion,
    completion_ratio,
    evaluate_reconstruction,
    f_score,
    load_mesh,
    reconstruction_metrics,
    sample_surface,
)
from warpslam.poses import pose_from_vector


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
        assert result.completion_ratio == result.accuracy_ratio == result.f_score == ratio
        assert result.normal_consistency == pytest.approx(1.0)
        assert result.sample_count == 200_000 and result.protocol is None


def test_half_a_reconstruction_is_accurate_and_incomplete():
    """Half of the true plane: accuracy near 0, completion ratio a little over one half."""
    truth = plane(2, 1)
    half = truth.copy()
    half.vertices[half.vertices[:, 0] > 0, 0] = 0
    result = evaluate_reconstruction(half, truth, sample_count=20_000, align=False)
    assert result.accuracy < 0.02 and result.accuracy_ratio == 1.0
    assert result.completion_ratio == pytest.approx((1 + 0.05) / 2, abs=0.02)
    assert result.f_score == pytest.approx(2 * result.completion_ratio / (1 + result.completion_ratio))


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
    points, normals = sample_surface(mesh, 20_000, seed=3)
    assert (points[:, 0] >= 5).mean() == pytest.approx(0.75, abs=0.01)
    left = points[points[:, 0] < 5]
    assert (left[:, :2].sum(axis=1) <= 1 + 1e-12).all()
    np.testing.assert_allclose(left.mean(axis=0), [1 / 3, 1 / 3, 0], atol=0.01)
    np.testing.assert_array_equal(normals, np.tile([[0.0, 0.0, 1.0]], (20_000, 1)))
    np.testing.assert_array_equal(points, sample_surface(mesh, 20_000, seed=3)[0])
    assert not np.array_equal(points, sample_surface(mesh, 20_000, seed=4)[0])


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


def test_f_score_by_hand():
    """The harmonic mean of 1/2 and 1 is 2/3; of nothing it is 0."""
    assert f_score(0.5, 1.0) == pytest.approx(2 / 3)
    assert f_score(0.0, 0.0) == 0.0


def test_normal_consistency_by_hand():
    """Planes that cross at 60 degrees agree to cos 60; which side a normal points to does not matter."""
    tilted = plane(1, 0)
    tilted.apply_transform(pose_from_vector(np.array([np.cos(np.pi / 6), np.sin(np.pi / 6), 0, 0, 0, 0, 0])))
    result = evaluate_reconstruction(tilted, plane(1, 0), sample_count=5_000, align=False)
    assert result.normal_consistency == pytest.approx(0.5, abs=1e-9)
    flipped = plane(1, 0)
    flipped.invert()
    assert evaluate_reconstruction(flipped, plane(1, 0), sample_count=1_000).normal_consistency == pytest.approx(1.0)


def test_distances_agree_with_open3d():
    """Nearest-neighbour distances as Open3D has them, and close to its exact distances to the triangles."""
    o3d = pytest.importorskip("open3d", reason="open3d can't be imported here")
    truth = trimesh.creation.box(extents=[1.0, 1.5, 2.0])
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.9)
    points, _ = sample_surface(mesh, 5_000, 0)
    truth_points, _ = sample_surface(truth, 50_000, 1)
    clouds = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(p)) for p in (points, truth_points)]
    to_truth = np.asarray(clouds[0].compute_point_cloud_distance(clouds[1]))
    assert accuracy(points, truth_points) == pytest.approx(to_truth.mean())
    to_mesh = np.asarray(clouds[1].compute_point_cloud_distance(clouds[0]))
    assert completion(points, truth_points) == pytest.approx(to_mesh.mean())
    assert completion_ratio(points, truth_points) == pytest.approx((to_mesh < 0.05).mean())
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(np.float32(truth.vertices), np.uint32(truth.faces))
    exact = scene.compute_distance(np.float32(points)).numpy().mean()
    # Drawn points are 0.5 / sqrt(points a square metre) apart, 0.8 cm here, which adds little at a distance.
    assert exact < accuracy(points, truth_points) < exact + 0.008


def test_metrics_are_named_with_their_protocol():
    """What goes into metrics.json says which protocol it is of, and has units in its names."""
    figures = reconstruction_metrics(evaluate_reconstruction(plane(1, 1.04), plane(1, 1), sample_count=500))
    assert set(figures) == {
        "protocol", "accuracy_m", "completion_m", "accuracy_ratio_5cm", "completion_ratio_5cm", "f_score_5cm",
        "normal_consistency", "samples", "T_truth_mesh",
    }  # fmt: skip


@pytest.mark.parametrize("suffix", ["ply", "obj", "glb", "stl"])
def test_meshes_load_from_the_usual_formats(tmp_path, suffix):
    """Every format gives the same surface."""
    trimesh.creation.box(extents=[1.0, 2.0, 3.0]).export(tmp_path / f"box.{suffix}")
    assert load_mesh(tmp_path / f"box.{suffix}").area == pytest.approx(22.0)
