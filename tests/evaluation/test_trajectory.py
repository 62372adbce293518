"""Trajectory errors against hand-worked cases and against the evo package."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from warpslam.errors import DatasetError, InputError
from warpslam.evaluation import align_horn, ate, rpe
from warpslam.poses import pose_from_vector, rotation_angles, transform_poses
from warpslam.storage.tum import associate, read_tum, write_tum


def random_poses(rng: np.random.Generator, count: int) -> np.ndarray:
    return np.array([pose_from_vector(np.concatenate([rng.normal(size=4), rng.normal(size=3)])) for _ in range(count)])


def walk(rng: np.random.Generator, count: int, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """A smooth truth and an estimate of it with drift, noise and another world frame."""
    times = np.linspace(0, 3, count)
    truth, estimate = np.zeros((2, count, 4, 4))
    for i, t in enumerate(times):
        truth[i] = pose_from_vector(np.array([1, 0.3 * np.sin(t), 0.2 * t, 0.1, t, np.cos(t), 0.3 * t]))
        noisy = pose_from_vector(np.concatenate([[1.0], noise * rng.normal(size=6)]))
        estimate[i] = truth[i] @ noisy
    return transform_poses(random_poses(rng, 1)[0], estimate), truth


def test_ate_of_a_shifted_trajectory_is_the_shift():
    """Unaligned, every error is the 3-4-5 shift; aligned, it vanishes."""
    _, truth = walk(np.random.default_rng(0), 20, 0)
    estimate = truth.copy()
    estimate[:, :3, 3] += [0.03, 0.04, 0.0]
    assert ate(estimate, truth, align=False).rmse == pytest.approx(0.05, abs=1e-12)
    assert ate(estimate, truth).max < 1e-12


def test_ate_statistics_by_hand():
    """Four errors of 0, 0, 3 and 4 m: rmse 2.5, mean 1.75, median 1.5."""
    truth = np.tile(np.eye(4), (4, 1, 1))
    estimate = truth.copy()
    estimate[2, 0, 3], estimate[3, 1, 3] = 3, 4
    result = ate(estimate, truth, align=False)
    assert (result.rmse, result.mean, result.median, result.min, result.max) == (2.5, 1.75, 1.5, 0, 4)
    assert result.std == pytest.approx(np.sqrt(2.5**2 - 1.75**2))
    np.testing.assert_array_equal(result.errors, [0, 0, 3, 4])


def test_ate_has_no_scale():
    """A trajectory of twice the size keeps its error: points at -1, 0, 1 against -2, 0, 2."""
    truth, estimate = np.tile(np.eye(4), (2, 3, 1, 1))
    truth[:, 0, 3], estimate[:, 0, 3] = [-1, 0, 1], [-2, 0, 2]
    assert ate(estimate, truth).rmse == pytest.approx(np.sqrt(2 / 3))


def test_ate_skips_and_counts_unknown_truth():
    """NaN and infinite truth poses are left out, as ScanNet needs it."""
    estimate, truth = walk(np.random.default_rng(1), 30, 0.01)
    holes = truth.copy()
    holes[3], holes[17, 0, 0] = np.nan, -np.inf
    keep = np.setdiff1d(np.arange(30), [3, 17])
    result = ate(estimate, holes)
    assert result.skipped_count == 2
    np.testing.assert_array_equal(result.frame_indices, keep)
    assert result.rmse == pytest.approx(ate(estimate[keep], truth[keep]).rmse, rel=1e-12)


@pytest.mark.parametrize("align", [True, False])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_ate_equals_evo(align: bool, seed: int):
    """The same figures as evo's APE on translations."""
    from evo.core import metrics
    from evo.core.trajectory import PoseTrajectory3D

    estimate, truth = walk(np.random.default_rng(seed), 50, 0.05)
    times = np.arange(50.0)
    reference = PoseTrajectory3D(poses_se3=list(truth), timestamps=times)
    moved = PoseTrajectory3D(poses_se3=list(estimate), timestamps=times)
    if align:
        moved.align(reference, correct_scale=False)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((reference, moved))
    result = ate(estimate, truth, align=align)
    for name, value in ape.get_all_statistics().items():
        if name != "sse":
            assert getattr(result, name) == pytest.approx(value, rel=1e-9), name


@pytest.mark.parametrize("delta", [1, 7])
def test_rpe_equals_evo(delta: int):
    """The same figures as evo's RPE over all pairs, for translations and angles."""
    from evo.core import metrics
    from evo.core.trajectory import PosePath3D

    estimate, truth = walk(np.random.default_rng(3), 40, 0.05)
    result = rpe(estimate, truth, delta=delta)
    for relation, ours in (
        (metrics.PoseRelation.translation_part, result.translation),
        (metrics.PoseRelation.rotation_angle_deg, result.rotation),
    ):
        theirs = metrics.RPE(relation, delta=delta, delta_unit=metrics.Unit.frames, all_pairs=True)
        theirs.process_data((PosePath3D(poses_se3=list(truth)), PosePath3D(poses_se3=list(estimate))))
        for name, value in theirs.get_all_statistics().items():
            if name != "sse":
                assert getattr(ours, name) == pytest.approx(value, rel=1e-9), (relation, name)


def test_rpe_ignores_the_world_frame_and_counts_pairs():
    """A trajectory in another world frame has no relative error; one unknown pose costs two pairs."""
    _, truth = walk(np.random.default_rng(4), 20, 0)
    estimate = transform_poses(random_poses(np.random.default_rng(5), 1)[0], truth)
    truth[9] = np.nan
    result = rpe(estimate, truth)
    assert result.translation.max < 1e-12 and result.rotation.max < 1e-6
    assert result.translation.skipped_count == 2 and len(result.translation.errors) == 17


def test_rpe_by_hand():
    """One step of 1 m instead of 1.5 m and a turn of 10 degrees too much."""
    truth, estimate = np.tile(np.eye(4), (2, 2, 1, 1))
    truth[1, 0, 3], estimate[1, 0, 3] = 1.5, 1.0
    c, s = np.cos(np.radians(10)), np.sin(np.radians(10))
    estimate[1, :2, :2] = [[c, -s], [s, c]]
    result = rpe(estimate, truth)
    assert result.translation.rmse == pytest.approx(0.5)
    assert result.rotation.rmse == pytest.approx(10.0)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 30))
def test_alignment_is_a_proper_rotation_that_recovers_a_motion(seed: int, count: int):
    """For any points, R is orthonormal with determinant +1 and exact data is matched exactly."""
    rng = np.random.default_rng(seed)
    T = random_poses(rng, 1)[0]
    points = rng.normal(size=(count, 3))
    found = align_horn(points, points @ T[:3, :3].T + T[:3, 3])
    np.testing.assert_allclose(found[:3, :3] @ found[:3, :3].T, np.eye(3), atol=1e-9)
    assert np.linalg.det(found[:3, :3]) == pytest.approx(1)
    np.testing.assert_allclose(points @ found[:3, :3].T + found[:3, 3], points @ T[:3, :3].T + T[:3, 3], atol=1e-9)


def test_alignment_never_mirrors():
    """Mirrored points would fit exactly with a reflection, which is not accepted."""
    points = np.random.default_rng(6).normal(size=(20, 3))
    T = align_horn(points, points * [1, 1, -1])
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1)


def test_rotation_angles_near_zero_and_pi():
    """Small angles keep their digits, and half a turn is pi."""
    angles = np.array([0.0, 1e-9, 1e-4, 1.0, np.pi - 1e-9, np.pi])
    R = np.array([pose_from_vector(np.array([np.cos(a / 2), 0, np.sin(a / 2), 0, 0, 0, 0]))[:3, :3] for a in angles])
    np.testing.assert_allclose(rotation_angles(R), angles, rtol=1e-7, atol=1e-15)


@pytest.mark.parametrize(
    ("estimate", "truth", "message"),
    [
        (np.zeros((3, 4, 4)), np.zeros((2, 4, 4)), "shape"),
        (np.zeros((3, 3)), np.zeros((3, 3)), "shape"),
        (np.full((2, 4, 4), np.nan), np.zeros((2, 4, 4)), "NaN"),
        (np.zeros((2, 4, 4)), np.full((2, 4, 4), np.nan), "none of the 2"),
    ],
)
def test_ate_rejects_unusable_input(estimate: np.ndarray, truth: np.ndarray, message: str):
    """Wrong shapes, an estimate that is not finite, and no known truth at all are typed errors."""
    with pytest.raises(InputError, match=message):
        ate(estimate, truth)


def test_associate_takes_the_nearest_in_time():
    """Unsorted candidates, a tie, and a time with nothing near it."""
    matches = associate(np.array([0.0, 1.0, 2.01, 5.0]), np.array([2.0, 0.005, 1.01, 0.99]), 0.02)
    np.testing.assert_array_equal(matches, [1, 3, 0, -1])
    np.testing.assert_array_equal(associate(np.array([0.0]), np.zeros(0)), [-1])


def test_tum_file_round_trip(tmp_path):
    """Times come back exactly, poses to a nanometre, unknown poses are left out, and equal input gives equal bytes."""
    rng = np.random.default_rng(7)
    times = np.concatenate([1305031102.175304 + np.arange(4) / 30, [0.1]])
    poses = random_poses(rng, 5)
    poses[2] = np.nan
    write_tum(tmp_path / "a.tum", times, poses)
    write_tum(tmp_path / "b.tum", times.copy(), poses.copy())
    assert (tmp_path / "a.tum").read_bytes() == (tmp_path / "b.tum").read_bytes()
    read_times, read_poses = read_tum(tmp_path / "a.tum")
    keep = [0, 1, 3, 4]
    np.testing.assert_array_equal(read_times, times[keep])
    np.testing.assert_allclose(read_poses, poses[keep], atol=5e-9)


def test_tum_file_by_hand(tmp_path):
    """The identity and a quarter turn about z are written as the format says, x y z w, and without negative zeros."""
    turn = pose_from_vector(np.array([np.sqrt(0.5), 0, 0, np.sqrt(0.5), 1, -2, -0.0]))
    write_tum(tmp_path / "t.tum", [0, 1 / 3], [np.eye(4), turn])
    assert (tmp_path / "t.tum").read_text().splitlines()[1:] == [
        "0.0 0.000000000 0.000000000 0.000000000 0.000000000 0.000000000 0.000000000 1.000000000",
        "0.3333333333333333 1.000000000 -2.000000000 0.000000000 0.000000000 0.000000000 0.707106781 0.707106781",
    ]


def test_tum_file_is_read_by_evo(tmp_path):
    """The evo package reads what we write and sees the same poses."""
    from evo.tools import file_interface

    times, poses = np.arange(5.0), random_poses(np.random.default_rng(8), 5)
    write_tum(tmp_path / "t.tum", times, poses)
    theirs = file_interface.read_tum_trajectory_file(tmp_path / "t.tum")
    np.testing.assert_allclose(np.array(theirs.poses_se3), poses, atol=5e-9)


@pytest.mark.parametrize("line", ["1 2 3", "1 2 3 4 0 0 0 0", "a b c d e f g h", "1 nan 0 0 0 0 0 1"])
def test_damaged_tum_file_names_file_and_line(tmp_path, line: str):
    """Too few numbers, a zero quaternion, words and NaN end in a DatasetError that says where."""
    path = tmp_path / "bad.tum"
    path.write_text(f"# comment\n0 0 0 0 0 0 0 1\n{line}\n")
    with pytest.raises(DatasetError, match=r"bad\.tum:3: "):
        read_tum(path)


def test_missing_tum_file_is_a_dataset_error(tmp_path):
    """A file that isn't there is named."""
    with pytest.raises(DatasetError, match=r"none\.tum"):
        read_tum(tmp_path / "none.tum")
