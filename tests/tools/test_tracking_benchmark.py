"""The judge of tracking: what counts as wrong, which sequences can be named, and what is printed."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tools.benchmarks import tracking
from tools.benchmarks.tracking import Drive, Figures, drive, false_ok, judge, open_named, table, within_two_sigma
from warpslam.camera import ONE_MOMENT, Intrinsics
from warpslam.errors import WarpSlamError
from warpslam.frames import FrameResult, FrameStatus
from warpslam.synthetic import SyntheticSequence, write_replica
from warpslam.trajectory import Trajectory

SMALL = Intrinsics(25.0, 25.0, 15.5, 11.5, 32, 24)
OK, LOST = FrameStatus.OK, FrameStatus.LOST


def path(count: int) -> np.ndarray:
    """Poses 14 cm apart along a bend."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = 0.14 * np.arange(count)
    poses[:, 1, 3] = 0.02 * np.arange(count) ** 1.5
    poses[:, :3, :3] = Rotation.from_euler("y", 3.0 * np.arange(count)[:, None], degrees=True).as_matrix()
    return poses


class Told:
    """Stands for `Slam`: says what it was told to say."""

    def __init__(self, poses: np.ndarray, status: list[FrameStatus], final: np.ndarray) -> None:
        self.poses, self.status, self.final = poses, status, final
        self.given: list[np.ndarray | None] = []
        self.depth_times: list[float | None] = []
        self.finished = False

    def step(self, rgb, depth, timestamp=None, T_world_camera=None, *, depth_timestamp=None):
        number = len(self.given)
        self.depth_times.append(depth_timestamp)
        self.given.append(T_world_camera)
        return FrameResult(number, timestamp, self.poses[number], self.status[number])

    def finish(self):
        self.finished = True
        return {}

    @property
    def trajectory(self):
        assert self.finished
        return Trajectory(np.arange(len(self.final)), self.final, self.status)


def test_false_ok_is_a_wrong_step_that_is_called_ok():
    """A jump of 11 cm or 6 degrees counts at the frame where it comes, one of 9 cm or 4 degrees does not, nor where it
    is called lost; what drifts slowly does not either.
    """
    truth = path(12)
    for axis, size, expected in ((0, 0.11, [5]), (2, 0.09, [])):
        poses = truth.copy()
        poses[5:, axis, 3] += size
        assert false_ok(poses, [OK] * 12, truth) == expected
    for angle, expected in ((6.0, [5]), (4.0, [])):
        poses = truth.copy()
        poses[5:] = poses[5:] @ tracking_turn(angle)
        assert false_ok(poses, [OK] * 12, truth) == expected
    drifting = truth.copy()
    drifting[:, 0, 3] += 0.05 * np.arange(12)
    assert false_ok(drifting, [OK] * 12, truth) == []
    assert (
        false_ok(np.array([[0, -1, 0, 3.0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]) @ truth, [OK] * 12, truth) == []
    )


def tracking_turn(degrees: float) -> np.ndarray:
    """A turn in the frame of the camera."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    return T


def test_the_neighbour_is_the_ok_frame_before():
    """A frame that stays where it was while the truth moves on is wrong if it is OK; after lost frames the pose is held
    against the last one that was OK; a frame without truth is left out.
    """
    truth = path(8)
    frozen = truth.copy()
    frozen[4] = truth[3]
    assert false_ok(frozen, [OK] * 8, truth) == [4, 5]
    status = [OK, OK, OK, OK, LOST, OK, OK, OK]
    assert false_ok(frozen, status, truth) == []
    away = frozen.copy()
    away[5:, 2, 3] += 0.3
    assert false_ok(away, status, truth) == [5]
    unknown = truth.copy()
    unknown[4] = np.nan
    assert false_ok(frozen, [OK] * 8, unknown) == []


def test_figures():
    """ATE is aligned, online and after the end apart; the first frame is not in the times."""
    truth = path(9)
    online, final = truth.copy(), truth.copy()
    online[3, 2, 3] += 0.05
    final[:, :3, 3] += 7.0
    unknown = [None] * 9, np.full((9, 4, 4), np.nan), np.full(9, np.nan)
    driven = Drive(online, final, [OK] * 8 + [LOST], np.array([9.0] + [0.02] * 8), *unknown, 1.5)
    figures = judge(driven, truth)
    assert 1.0 < figures.ate_online_cm < 5.0 / np.sqrt(9) + 0.1 and 3.0 < figures.ate_online_max_cm <= 5.0
    assert figures.ate_final_cm < 1e-6 and figures.lost == 1 and figures.false_ok == [] and figures.frames == 9
    assert figures.within_two_sigma is None
    assert figures.cpu_ms_median == pytest.approx(20.0) and figures.cpu_ms_99 == pytest.approx(20.0)


def test_share_within_two_sigma():
    """Of frames that are OK and no keyframe, the shift since the keyframe against its deviation."""
    truth = path(6)
    against = [None, 0, 2, 2, 2, 2]
    since = np.array([np.linalg.inv(truth[k or 0]) @ T for k, T in zip(against, truth, strict=True)])
    since[3:5, 2, 3] += 0.03
    sigma = np.array([0.01, 0.01, 0.01, 0.01, 0.02, 0.01])
    driven = Drive(truth, truth, [OK] * 5 + [LOST], np.ones(6), against, since, sigma, 1.0)
    assert within_two_sigma(driven, truth) == pytest.approx(2 / 3)  # frames 1, 3 and 4; 3 is off


def test_drive_gives_the_first_pose_only():
    """Each frame is stepped once, in order; poses and status come back, the final ones after the end."""

    class Stamped(SyntheticSequence):
        def __getitem__(self, index):
            frame = super().__getitem__(index)
            return replace(frame, depth_timestamp=frame.timestamp - 0.01)

    sequence = Stamped(0, 4, intrinsics=SMALL, device="cpu")
    truth = sequence.ground_truth()
    slam = Told(truth, [OK, OK, LOST, OK], truth + 1.0)
    driven = drive(slam, sequence)
    np.testing.assert_array_equal(slam.given[0], truth[0])
    assert slam.given[1:] == [None] * 3
    np.testing.assert_allclose(slam.depth_times, np.arange(4) / 30 - 0.01)
    np.testing.assert_array_equal(driven.online, truth)
    np.testing.assert_array_equal(driven.final, truth + 1.0)
    assert driven.status == ["OK", "OK", "LOST", "OK"] and len(driven.cpu_seconds) == 4


def test_named_sequences(tmp_path, monkeypatch):
    """A folder, with frames and with what goes wrong, and a scene, which is rendered once."""
    monkeypatch.setattr(tracking, "CAMERA", SMALL)
    write_replica(SyntheticSequence(0, 30, intrinsics=SMALL, device="cpu"), tmp_path / "a+b")
    folder = open_named(str(tmp_path / "a+b"), tmp_path)
    assert len(folder) == 30 and folder.preset == "replica"
    part = open_named(f"{tmp_path / 'a+b'}@4:20:4", tmp_path)
    np.testing.assert_array_equal(part[2].rgb, folder[12].rgb)
    np.testing.assert_array_equal(part.ground_truth(), folder.ground_truth()[4:20:4])
    assert len(open_named(str(tmp_path / "a+b"), tmp_path, slice(0, 7))) == 7
    cabinet = open_named("cabinet@0:40", tmp_path)
    assert len(cabinet) == 40 and cabinet.intrinsics == SMALL and cabinet.preset == "default"
    monkeypatch.setattr(tracking, "write_replica", None)  # would be rendered again
    frozen = open_named("cabinet+frozen+black", tmp_path)
    np.testing.assert_array_equal(frozen[0].rgb, cabinet[0].rgb)
    assert len(frozen) == 58 and frozen.name == "cabinet+frozen+black" and not frozen[30].rgb.any()
    for wrong in ("nowhere", "cabinet+thunder", "cabinet@90:95"):
        with pytest.raises(WarpSlamError):
            open_named(wrong, tmp_path)


def test_command(tmp_path, monkeypatch, capsys):
    """One table with a row for each sequence, those that fail too; figures as JSON; settings reach the run."""
    monkeypatch.setattr(tracking, "CAMERA", SMALL)
    asked = []

    def make(intrinsics, config, device, seed, *, timing):
        assert timing == ONE_MOMENT  # as of all that is rendered
        asked.append(config)
        truth = open_named("cabinet@0:5", tmp_path).ground_truth()
        return Told(truth, [OK, OK, OK, LOST, OK], truth)

    monkeypatch.setattr(tracking, "Slam", make)
    file = tmp_path / "figures.json"
    code = tracking.main(
        ["cabinet", "nowhere", "--frames", "0:5", "--cache", str(tmp_path), "--json", str(file)]
        + ["--optimizer", "adam", "--set", "mapping.enabled=false"]
    )
    assert code == 1 and asked[0].tracking.optimizer == "adam" and not asked[0].mapping.enabled
    out = capsys.readouterr().out.splitlines()
    assert out[2].startswith("| cabinet | 5 | 0.00 (0.00) | 0.00 (0.00) | 1 | 0 | - | ") and "no such folder" in out[3]
    figures = json.loads(file.read_text())
    assert figures["cabinet"]["lost"] == 1 and figures["cabinet"]["false_ok"] == [] and "error" in figures["nowhere"]


def test_table():
    """The rows as they are printed."""
    text = table({"a": Figures(3, 1.234, 2, 0.5, 0.75, 1, [2], 0.954, 44.4, 149.6, 12.34)})
    assert text.splitlines()[2] == "| a | 3 | 1.23 (2.00) | 0.50 (0.75) | 1 | 1 | 95% | 44 / 150 | 12.3 |"
