"""Recorded sequences: frame counts, and two posed frames that show the same surface in the same place."""

from __future__ import annotations

import numpy as np
import pytest

from warpslam.camera import Intrinsics
from warpslam.sequences import guess_dataset, open_sequence


def reprojected_depth_error(sequence, first: int, second: int) -> tuple[float, int]:
    """Median |depth| difference [m] of frame ``first`` seen from ``second``, and the number of compared pixels."""
    source, target, K = sequence[first], sequence[second], sequence.intrinsics
    v, u = np.nonzero(source.depth)
    z = source.depth[v, u].astype(np.float64)
    points = np.stack([(u - K.cx) / K.fx * z, (v - K.cy) / K.fy * z, z, np.ones_like(z)])
    x, y, z, _ = np.linalg.inv(target.T_world_camera) @ source.T_world_camera @ points
    in_front = z > 0.1
    x, y, z = x[in_front], y[in_front], z[in_front]
    columns, rows = np.rint(x / z * K.fx + K.cx).astype(int), np.rint(y / z * K.fy + K.cy).astype(int)
    inside = (columns >= 0) & (columns < K.width) & (rows >= 0) & (rows < K.height)
    seen = target.depth[rows[inside], columns[inside]]
    difference = np.abs(seen - z[inside])[seen > 0]
    return float(np.median(difference)), len(difference)


@pytest.fixture
def tum(data_dir):
    """TUM freiburg1_xyz, its first seconds."""
    return open_sequence(data_dir / "tum_fr1_xyz")


@pytest.fixture
def icl(data_dir):
    """Augmented ICL-NUIM living room 1, its first frames."""
    return open_sequence(data_dir / "icl_livingroom1")


def test_tum_frames(tum, data_dir):
    """All 200 colour images find depth and pose; the camera is freiburg1's after cropping, or as the paper has it."""
    assert guess_dataset(data_dir / "tum_fr1_xyz") == "tum_rgbd"
    assert (len(tum), tum.name, tum.preset) == (200, "tum_fr1_xyz", "tum_rgbd")
    times = tum.timestamps
    assert times[0] == 1305031102.175304 and np.diff(times).min() > 1 / 32
    K = tum.as_published().intrinsics
    np.testing.assert_allclose([K.fx, K.fy, K.cx, K.cy], [413.84, 413.2, 318.6 * 0.8 - 8, 255.3 * 0.8 - 8])
    K = tum.intrinsics
    np.testing.assert_allclose([K.fx, K.fy, K.cx, K.cy], [517.3, 516.5, 308.6, 245.3])
    frame = tum[57]
    assert frame.rgb.shape == (K.height, K.width, 3) and frame.depth.shape == (K.height, K.width)
    measured = frame.depth[frame.depth > 0]
    assert 0.1 < np.mean(frame.depth == 0) < 0.4 and 0.3 < measured.min() < measured.max() < 14


def test_tum_first_pose(tum):
    """The first pose is the line of groundtruth.txt that is nearest in time, in the world of the motion capture."""
    np.testing.assert_allclose(tum.ground_truth()[0, :3, 3], [1.3405, 0.6266, 1.6575], atol=1e-9)


def test_icl_frames(icl, data_dir):
    """211 frames, each with a pose of the optimised trajectory."""
    assert guess_dataset(data_dir / "icl_livingroom1") == "icl"
    assert (len(icl), icl.preset) == (211, "icl")
    assert icl.intrinsics == Intrinsics(525, 525, 319.5, 239.5, 640, 480)
    truth = icl.ground_truth()
    assert truth.shape == (211, 4, 4) and np.isfinite(truth).all()
    np.testing.assert_array_equal(truth[210, :3, 3], [0.94402278, -0.09883034, 0.29945675])


@pytest.mark.parametrize(("first", "second"), [(0, 60), (50, 150), (210, 120)])
def test_icl_poses_agree(icl, first, second):
    """ICL: surfaces of two frames coincide to 3 cm, so poses are camera-to-world in OpenCV axes."""
    error, count = reprojected_depth_error(icl, first, second)
    assert error < 0.03 and count > 50_000


@pytest.mark.parametrize(("first", "second"), [(0, 30), (50, 150), (20, 199)])
def test_tum_poses_agree(tum, first, second):
    """TUM: surfaces of two frames coincide to 3 cm, so poses, resizing and cropping fit the intrinsics."""
    error, count = reprojected_depth_error(tum, first, second)
    assert error < 0.03 and count > 50_000
