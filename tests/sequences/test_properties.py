"""Properties of the parsers: what is written comes back, and any other text is a typed error."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.sequences import writers
from warpslam.errors import DatasetError
from warpslam.poses import check_transform, pose_from_vector
from warpslam.sequences import open_sequence
from warpslam.sequences.calibration import CAMERA_FIELDS, Calibration
from warpslam.sequences.image_files import natural_key
from warpslam.sequences.pairing import frame_number
from warpslam.sequences.pose_files import read_matrix_file, read_matrix_lines, read_redwood_log, read_tum_poses

# The same examples on every machine, however busy it is.
seeded = settings(deadline=None, derandomize=True)
unit = st.floats(-1, 1)
vectors = st.tuples(*[unit] * 4, *[st.floats(-1e3, 1e3)] * 3).filter(lambda v: np.linalg.norm(v[:4]) > 0.1)
poses = st.lists(vectors.map(lambda v: pose_from_vector(np.array(v))), min_size=1, max_size=4)
# Words that numbers files could hold, and words that they should not.
words = st.one_of(
    st.floats().map(repr), st.integers().map(str), st.sampled_from(["nan", "-inf", "1e999", "#", "x", "١"])
)
texts = st.one_of(
    st.text(max_size=60),
    st.lists(st.lists(words, min_size=1, max_size=17).map(" ".join), max_size=8).map("\n".join),
)


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """A file to overwrite."""
    return tmp_path_factory.mktemp("properties") / "poses.txt"


@seeded
@given(poses)
def test_poses_come_back(file, matrices):
    """Matrices written with all their digits are read back to the bit, one a line, one a file, and from a log."""
    file.write_text("\n".join(" ".join(map(repr, T.ravel().tolist())) for T in matrices))
    np.testing.assert_array_equal(read_matrix_lines(file), matrices)
    file.write_text(writers.matrix_text(matrices[0]))
    np.testing.assert_array_equal(read_matrix_file(file), matrices[0])
    writers.write_log(file, dict(enumerate(matrices)))
    np.testing.assert_array_equal(read_redwood_log(file, len(matrices)), matrices)


@seeded
@given(texts)
def test_any_pose_text_is_read_or_refused(file, text):
    """Rigid or unknown poses, or an error that names the file."""
    file.write_text(text, encoding="utf-8")
    for read in (read_matrix_lines, read_matrix_file, lambda path: read_redwood_log(path, 3), read_tum_poses):
        try:
            result = read(file)
        except DatasetError as error:
            assert str(file) in str(error)
            continue
        matrices = result[1] if isinstance(result, tuple) else result
        for T in matrices.reshape(-1, 4, 4):
            assert np.isnan(T).all() or np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() < 0.06


@seeded
@given(st.binary(max_size=80))
def test_any_bytes_are_read_or_refused(file, data):
    """Binary files in place of lists."""
    file.write_bytes(data)
    for read in (read_matrix_lines, read_matrix_file, lambda path: read_redwood_log(path, 3), read_tum_poses):
        try:
            read(file)
        except DatasetError as error:
            assert str(file) in str(error)


values = st.one_of(st.floats(), st.integers(), st.text(max_size=5), st.none(), st.booleans(), st.lists(st.floats()))
fields = st.dictionaries(st.sampled_from([*CAMERA_FIELDS, "distortion", "resize", "crop", "other"]), values)
usable = st.fixed_dictionaries(
    {name: st.floats(1, 2000) for name in ("fx", "fy", "cx", "cy", "depth_scale")}
    | {name: st.integers(1, 2000) for name in ("width", "height")},
    optional={"resize": st.lists(st.integers(-1, 10**7), max_size=3), "crop": st.integers(-2, 3000)},
)


@seeded
@given(st.one_of(fields, usable))
def test_any_camera_is_usable_or_refused(content):
    """A camera that was accepted has positive, finite numbers, also after resizing and cropping."""
    try:
        calibration = Calibration.from_fields(content, "here")
    except DatasetError as error:
        assert str(error).startswith("here")
        return
    for camera in (calibration.stored, calibration.intrinsics):
        assert min(camera.fx, camera.fy, camera.width, camera.height) > 0
        assert max(camera.width, camera.height) <= 16384
        assert all(math.isfinite(value) for value in (camera.fx, camera.fy, camera.cx, camera.cy))
    assert calibration.depth_scale > 0


@seeded
@given(st.text(max_size=40))
def test_any_camera_text_is_usable_or_refused(text):
    """The option --camera."""
    try:
        Calibration.from_text(text)
    except DatasetError as error:
        assert "camera" in str(error)


@seeded
@given(st.lists(st.integers(0, 10**6), min_size=2, max_size=8, unique=True))
def test_numbered_files_sort_by_number(tmp_path_factory, numbers):
    """With and without leading zeros."""
    from pathlib import Path

    files = [Path(f"frame{number}.png") for number in numbers]
    assert [frame_number(file) for file in sorted(files, key=natural_key)] == sorted(numbers)


@pytest.mark.parametrize("count", [1, 4])
def test_truth_of_frames_and_of_the_sequence_agree(tmp_path, count):
    """`ground_truth` holds the pose that each frame has, and each is a rigid transform."""
    sequence = open_sequence(writers.write_replica(tmp_path, count))
    for frame, T in zip(sequence, sequence.ground_truth(), strict=True):
        np.testing.assert_array_equal(frame.T_world_camera, check_transform(T))
