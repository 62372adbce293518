"""What is found in a sequence before a run: each fault on a small room that is otherwise right."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.sequences import writers
from warpslam import cli
from warpslam.camera import Intrinsics
from warpslam.sequences import open_sequence
from warpslam.sequences.checking import ERROR, OK, WARNING, check_folder, check_sequence
from warpslam.sequences.pose_convention import CONVENTIONS
from warpslam.sequences.structure_checks import _EdgePoints
from warpslam.synthetic import SyntheticSequence, write_replica

CAMERA = Intrinsics(60.0, 60.0, 39.5, 29.5, 80, 60)
FRAME_COUNT = 24


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Path:
    """A furnished room in the Replica layout."""
    folder = tmp_path_factory.mktemp("check") / "room"
    write_replica(SyntheticSequence(1, FRAME_COUNT, intrinsics=CAMERA, device="cpu"), folder)
    return folder


@pytest.fixture
def copy(room, tmp_path) -> Path:
    """A copy that may be spoilt."""
    return Path(shutil.copytree(room, tmp_path / "room"))


def severity_of(report, check: str) -> str:
    """Worst severity of a check's findings; "" if there are none."""
    found = [finding.severity for finding in report.findings if finding.check == check]
    return next((severity for severity in (ERROR, WARNING, OK) if severity in found), "")


def expect(report, check: str, severity: str, pattern: str = "") -> None:
    """A finding of that severity whose text, remedy included, matches."""
    texts = [str(f) for f in report.findings if f.check == check and f.severity == severity]
    assert any(re.search(pattern, text) for text in texts), [str(f) for f in report.findings]


def rewrite_depth(folder: Path, change) -> None:
    """Change every depth image."""
    for file in sorted((folder / "results").glob("depth*.png")):
        depth = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        assert cv2.imwrite(str(file), change(depth))


def rewrite_poses(folder: Path, change) -> None:
    poses = np.loadtxt(folder / "traj.txt").reshape(-1, 4, 4)
    np.savetxt(folder / "traj.txt", np.array([change(T) for T in poses]).reshape(-1, 16), fmt="%.17g")


def test_good_sequence_has_no_findings(room):
    """Nothing but "ok", for every check there is."""
    report = check_folder(room)
    assert (report.errors, report.warnings, report.frames) == ([], [], FRAME_COUNT)
    checks = {finding.check for finding in report.findings}
    assert checks == {
        "frames", "files", "timestamps", "camera", "depth scale", "missing depth", "colour", "pose convention",
    }  # fmt: skip


@pytest.mark.parametrize("name", list(CONVENTIONS)[1:])
def test_wrong_pose_convention_is_named(copy, name):
    """Matrices stored the other way are an error that names the convention and the conversion that mends it."""
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    as_opengl = name.endswith("OpenGL axes")

    def store(T):
        T = T @ flip if as_opengl else T
        return np.linalg.inv(T) if name.startswith("world") else T

    rewrite_poses(copy, store)
    report = check_folder(copy)
    expect(report, "pose convention", ERROR, f"as {re.escape(name)} it is")
    remedy = next(finding.remedy for finding in report.errors if finding.check == "pose convention")

    def mend(T):
        T = np.linalg.inv(T) if "inv" in remedy else T
        if "*= -1" in remedy:
            T = T.copy()
            T[:, 1:3] *= -1
        return T

    rewrite_poses(copy, mend)
    assert severity_of(check_folder(copy), "pose convention") == OK


def test_poses_of_another_recording(copy):
    """Poses that fit in no convention are a warning; a single one that jumps is named."""
    rng = np.random.default_rng(0)
    poses = np.loadtxt(copy / "traj.txt").reshape(-1, 4, 4)
    rewrite_poses(copy, lambda T: poses[rng.integers(len(poses))])
    expect(check_folder(copy), "pose convention", WARNING, "no other convention fits")
    poses[5, 0, 3] += 3.0
    np.savetxt(copy / "traj.txt", poses.reshape(-1, 16))
    expect(check_folder(copy), "poses", WARNING, r"jump .*frame 5 \(")


@pytest.mark.parametrize("wrong", [1000.0, 5000.0])
def test_wrong_depth_scale_is_told_from_the_poses(copy, wrong):
    """With another unit than the stored one the poses no longer fit, and the right one is named, ready to type."""
    camera = f"60,60,39.5,29.5,80,60,{wrong:g}"
    rewrite_depth(copy, lambda depth: depth // 4)  # 1638.375 a metre, which no known scale is
    text = (copy / "camera.yaml").read_text()
    rewrite_depth(copy, lambda depth: (depth * (5000.0 if wrong == 1000.0 else 1000.0) / 1638.375).astype(np.uint16))
    right = 5000 if wrong == 1000.0 else 1000
    report = check_folder(copy, camera=camera)
    expect(report, "depth scale", ERROR, f"--camera 60,60,39.5,29.5,80,60,{right}")
    (copy / "camera.yaml").write_text(re.sub("depth_scale: .*", f"depth_scale: {right}", text))
    assert check_folder(copy).errors == []


def test_implausible_depth_scale_without_poses(copy):
    """Depth of 100 m or 3 mm: a scale that would suit a room is named."""
    (copy / "traj.txt").unlink()
    report = check_folder(copy, camera="60,60,39.5,29.5,80,60,65")
    expect(report, "depth scale", ERROR, "beyond 10 m; a depth_scale of .*6553.5")
    report = check_folder(copy, camera="60,60,39.5,29.5,80,60,1000000")
    expect(report, "depth scale", WARNING, "median depth is 0.0")


def test_coarse_and_saturated_depth(copy):
    """Depth in 8 bits, and 65535 for missing."""
    rewrite_depth(copy, lambda depth: (depth // 600 * 600).astype(np.uint16))
    expect(check_folder(copy), "depth steps", WARNING, r"steps of 9\.2 cm")
    rewrite_depth(copy, lambda depth: np.where(depth % 7 == 0, np.uint16(65535), depth))
    expect(check_folder(copy, camera="60,60,39.5,29.5,80,60,6553.5"), "depth values", WARNING, "65535")


def test_missing_depth(copy):
    """Four fifths of the pixels without depth."""

    def thin(depth):
        depth[:, :64] = 0
        return depth

    rewrite_depth(copy, thin)
    expect(check_folder(copy), "missing depth", WARNING, r"8\d%")


@pytest.mark.parametrize(
    ("camera", "severity", "pattern"),
    [
        ("120,120,79,59,80,60,6553.5", ERROR, "not well inside the image.*twice as large"),
        ("60,60,0,0,80,60,6553.5", ERROR, "not well inside"),
        ("60,60,60,29.5,80,60,6553.5", WARNING, "far from the middle"),
        ("600,600,39.5,29.5,80,60,6553.5", WARNING, "field of view of 8 degrees"),
        ("60,90,39.5,29.5,80,60,6553.5", WARNING, "fx and fy"),
    ],
)
def test_camera_against_the_images(room, camera, severity, pattern):
    """A principal point outside, an odd field of view, pixels that are no squares."""
    expect(check_folder(room, camera=camera), "camera", severity, pattern)


def test_bad_frames_and_files(copy):
    """Truncated, empty, dark and bright frames are counted and named; with all of them bad nothing can be done."""
    results = copy / "results"
    file = results / "depth000005.png"
    file.write_bytes(file.read_bytes()[:100])
    (results / "frame000007.png").write_bytes(b"")
    report = check_folder(copy, sample_count=None)
    expect(report, "frames", WARNING, r"2 of the 24 frames.*depth000005\.png: truncated.*frame000007\.png: empty")
    expect(report, "files", WARNING, r"1 image files are missing or empty: .*frame000007\.png")
    assert report.errors == []
    for index in (9, 10):
        cv2.imwrite(str(results / f"frame{index:06d}.png"), np.full((60, 80, 3), 255 * (index - 9), np.uint8))
    report = check_folder(copy, sample_count=None)
    expect(report, "colour", WARNING, "black in 1 of")
    expect(report, "colour", WARNING, "over-exposed in 1 of")
    rewrite_depth_to_nothing = [path for path in results.glob("depth*") if path != file]
    for path in rewrite_depth_to_nothing:
        cv2.imwrite(str(path), np.zeros((60, 80), np.uint16))
    expect(check_folder(copy), "frames", ERROR, "none of the 16 frames")


def test_gap_in_the_numbers(copy):
    """A frame that both folders lack."""
    lines = (copy / "traj.txt").read_text().splitlines()
    del lines[11]
    (copy / "traj.txt").write_text("\n".join(lines))
    for kind in ("frame", "depth"):
        (copy / "results" / f"{kind}000011.png").unlink()
    expect(check_folder(copy), "frame numbers", WARNING, r"1 gaps .* before frame000012\.png")


def test_unopenable_folder_is_one_error(tmp_path):
    """What the reader says is the finding."""
    report = check_folder(tmp_path / "nowhere")
    assert [finding.check for finding in report.errors] == ["sequence"] and not report.name
    writers.write_replica(tmp_path / "room")
    (tmp_path / "room" / "camera.yaml").write_text("fx: 1")
    expect(check_folder(tmp_path / "room"), "sequence", ERROR, "camera.yaml: field fy")


def test_tum_images_without_partner(tmp_path):
    """Colour images that have no depth near in time are counted."""
    times = [1.0, 1.1, 1.2, 1.3]
    writers.write_tum(tmp_path, times, times[:2], times)
    report = check_folder(tmp_path, "tum_rgbd", writers.CAMERA)
    expect(report, "association", WARNING, r"2 of 4 colour images .* first at 1\.2")


def test_timestamps_out_of_order(room):
    """Equal and backward times are named by frame; a pause is a warning too."""
    sequence = open_sequence(room)
    sequence.timestamps = sequence.timestamps.copy()
    sequence.timestamps[3] = sequence.timestamps[2]
    sequence.timestamps[8] = 0.0
    (finding,) = [f for f in check_sequence(sequence) if f.check == "timestamps"]
    assert finding.severity == WARNING and "frame 3" in finding.message and "frame 8" in finding.message
    sequence.timestamps = np.arange(FRAME_COUNT) / 30 + np.where(np.arange(FRAME_COUNT) < 12, 0, 5.0)
    (finding,) = [f for f in check_sequence(sequence) if f.check == "timestamps"]
    assert finding.severity == WARNING and "before frame 12" in finding.message


def test_poses_only_matter_where_they_are_used(copy):
    """In a run that tracks, wrong poses are a warning: only the error figures depend on them."""
    rewrite_poses(copy, np.linalg.inv)
    sequence = open_sequence(copy)
    for matter, severity in ((True, ERROR), (False, WARNING)):
        (finding,) = [f for f in check_sequence(sequence, poses_matter=matter) if f.check == "pose convention"]
        assert finding.severity == severity


def test_command_prints_findings_and_exits_1_on_errors(room, copy, capsys):
    """A line a finding and what to type under it; 0 without errors, 1 with; --json is JSON."""
    assert cli.main(["check", str(room)]) == 0
    out = capsys.readouterr().out
    assert "ok       depth scale" in out and "0 errors, 0 warnings" in out
    rewrite_poses(copy, np.linalg.inv)
    assert cli.main(["check", str(copy)]) == 1
    out = capsys.readouterr().out
    assert "error    pose convention" in out and "-> convert each 4x4 matrix T: T = numpy.linalg.inv(T)" in out
    assert cli.main(["check", str(copy), "--json", "--all"]) == 1
    report = json.loads(capsys.readouterr().out)
    assert report["errors"] == 1 and {"check", "severity", "message", "remedy"} == set(report["findings"][0])


def test_real_recordings_are_fine(data_dir):
    """A Kinect recording and a rendered one have no errors, and their poses fit."""
    for name in ("tum_fr1_xyz", "icl_livingroom1"):
        report = check_folder(data_dir / name, sample_count=4)
        assert report.errors == [] and severity_of(report, "pose convention") == OK, [str(f) for f in report.findings]


def test_an_edge_that_leaves_the_image_proves_nothing():
    """One point, shifted out of the image, is no division by zero."""
    points = _EdgePoints(np.ones((1, 4, 4)), np.zeros(1, int), np.zeros(1), np.zeros(1))
    assert points.mean(1.0, 0.0, 0.0) == 1.0 and points.mean(1.0, 5.0, 0.0) == 0.0
