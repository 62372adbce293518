"""Runs that are killed and resumed: the same bytes as one that was left alone."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from tests.conftest import REPOSITORY
from warpslam import cli
from warpslam.camera import Intrinsics
from warpslam.config import Config
from warpslam.pipeline import run as pipeline
from warpslam.runs.folder import RunFolder
from warpslam.slam import Slam
from warpslam.storage.json_files import read_json
from warpslam.storage.tum import read_tum
from warpslam.synthetic import SyntheticSequence, write_replica

CAMERA = Intrinsics(40.0, 40.0, 23.5, 17.5, 48, 36)
FRAMES = 11
SETTINGS = [
    "tracking.pixels=32", "tracking.iterations=2", "tracking.ignore_edge_u=2", "tracking.ignore_edge_v=2",
    "tracking.lost_depth_error=10", "tracking.lost_inliers=0", "tracking.max_step=10", "tracking.max_turn=180",
    "mapping.pixels=60", "mapping.every=2", "mapping.first_iterations=10", "mapping.iterations=5",
    "mapping.coarse_iterations=1", "mapping.refinement_rounds=1", "mapping.bundle_adjustment_keyframes=2",
    "keyframes.every=2", "meshing.voxel=0.1", "direct.keyframe_overlap=0.999",
]  # fmt: skip
SAME = ("trajectory.tum", "mesh.ply", "map.safetensors", "frames.csv")


@pytest.fixture(scope="module", autouse=True)
def no_plots():
    """Figures take longer than all else here and have no part in it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pipeline, "draw_plots", lambda *arguments: None)
        patch.setattr(pipeline, "draw_panels", lambda *arguments: None)
        yield


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    """A few frames on disk, one of which can't be read, of a camera with a delay and a rolling shutter."""
    folder = tmp_path_factory.mktemp("recording")
    write_replica(SyntheticSequence(0, FRAMES, intrinsics=CAMERA), folder)
    (folder / "results" / "frame000003.png").write_bytes(b"no image")
    with (folder / "camera.yaml").open("a") as file:
        file.write("depth_delay: -0.02\nreadout: 0.03\n")
    return folder


@pytest.fixture(scope="module")
def uninterrupted(recording, tmp_path_factory) -> Path:
    """The run that the others are compared with; it writes no checkpoint."""
    folder = tmp_path_factory.mktemp("whole")
    assert cli.main(arguments(recording, folder)[:-2]) == 0
    return folder


def arguments(recording: Path, output: Path) -> list[str]:
    run = ["run", str(recording), "-o", str(output), "--device", "cpu", "--seed", "3", "--set", *SETTINGS]
    return [*run, "--checkpoint-every", "2"]


def start(point: str, count: int, command: list[str]) -> subprocess.Popen:
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    process = [sys.executable, "-m", "tests.stopped_run", point, str(count), *command]
    return subprocess.Popen(process, cwd=REPOSITORY, env=environment, stdout=subprocess.DEVNULL)


def assert_same(folder: Path, other: Path) -> None:
    for name in SAME:
        assert (folder / name).read_bytes() == (other / name).read_bytes(), name


@pytest.mark.parametrize(
    ("point", "count", "position"),
    [
        ("rename", 5, 0),  # between the two renames of the second checkpoint: the first is the previous one by then
        ("map", 3, 6),  # where the frame would be mapped
    ],
)
def test_killed_run_is_resumed_to_the_same_bytes(recording, uninterrupted, tmp_path, capsys, point, count, position):
    """Killed at the worst moments, the run goes on from the last whole checkpoint and ends in the same files."""
    assert start(point, count, arguments(recording, tmp_path)).wait() == -signal.SIGKILL
    assert not (tmp_path / "mesh.ply").exists()
    assert cli.main(["run", "--resume", str(tmp_path)]) == 0
    assert_same(tmp_path, uninterrupted)
    assert f"after {position} frames" in (tmp_path / "log.txt").read_text()
    assert "overlapped" not in capsys.readouterr().err
    metrics = read_json(tmp_path / "metrics.json")
    assert metrics["frames"]["processed"] == FRAMES - 1 and metrics["frames"]["unreadable"] == 1
    assert len(read_json(tmp_path / "timing.json")["frames"]) == FRAMES - 1
    assert not list(tmp_path.glob("checkpoint*")), "a finished run needs none"


@pytest.mark.slow
def test_run_killed_at_random_is_resumed_to_the_same_bytes(recording, uninterrupted, tmp_path):
    """SIGKILL after ten random times, and during a write, a rename and the refinement: always the same files."""
    began = time.monotonic()
    assert start("never", 0, arguments(recording, tmp_path / "timed")).wait() == 0
    whole = time.monotonic() - began
    rng = np.random.default_rng()
    kills = [("write", 4, 1e9), ("rename", 4, 1e9), ("rename", 6, 1e9), ("refine", 1, 1e9)]
    kills += [("never", 0, float(seconds)) for seconds in rng.uniform(0.2 * whole, whole, 10)]
    for number, (point, count, seconds) in enumerate(kills):
        folder = tmp_path / str(number)
        process = start(point, count, arguments(recording, folder))
        try:
            process.wait(timeout=seconds)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        if process.returncode == 0:
            continue  # it was done before its time was up
        has_begun = folder.exists() and bool(list(folder.glob("checkpoint*.safetensors")))
        again = ["run", "--resume", str(folder)] if has_begun else arguments(recording, folder)
        assert cli.main(again) == 0, (point, count, seconds)
        assert_same(folder, uninterrupted)


@pytest.fixture(scope="module")
def stopped(recording, tmp_path_factory) -> Path:
    """A run that was killed after its second checkpoint."""
    folder = tmp_path_factory.mktemp("stopped")
    assert start("map", 3, arguments(recording, folder)).wait() == -signal.SIGKILL
    return folder


def copy(folder: Path, to: Path) -> Path:
    to.mkdir()
    for file in folder.iterdir():
        (to / file.name).write_bytes(file.read_bytes())
    return to


@pytest.mark.parametrize("damage", ["truncated", "altered", "missing"])
def test_damaged_checkpoint_falls_back_to_the_one_before(stopped, uninterrupted, tmp_path, capsys, damage):
    """The last checkpoint is of no use: the run goes on from the one before it, says so, and ends in the same files."""
    folder = RunFolder(copy(stopped, tmp_path / "run"))
    content = folder.checkpoint.read_bytes()
    if damage == "missing":
        folder.checkpoint.unlink()
    else:
        middle = len(content) // 2
        altered = content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]
        folder.checkpoint.write_bytes(content[:middle] if damage == "truncated" else altered)
    assert cli.main(["run", "--resume", str(folder.path)]) == 0
    assert damage == "missing" or "truncated or altered" in capsys.readouterr().err
    assert_same(folder.path, uninterrupted)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--set", "tracking.pixels=33"], "config.tracking.pixels is 33, was 32"),
        (["--seed", "4"], "seed is 4, was 3"),
        (["--frames", "0:5"], "frames is [0, 5, 1], was [0, 11, 1]"),
        (["--preset", "replica"], "--preset does not go with --resume"),
        (["-o", "elsewhere"], "--output does not go with --resume"),
    ],
)
def test_changed_settings_are_refused(stopped, capsys, options, message):
    """What is asked for differs from what the run was started with: refused, naming both values; nothing is touched."""
    before = {file.name: file.read_bytes() for file in stopped.iterdir()}
    assert cli.main(["run", "--resume", str(stopped), *options]) == 2
    assert message in capsys.readouterr().err
    assert {file.name: file.read_bytes() for file in stopped.iterdir()} == before


def test_memory_budget_may_change(stopped, uninterrupted, tmp_path):
    """A run that ran out of its budget goes on with a larger one, to the same trajectory and mesh."""
    folder = copy(stopped, tmp_path / "run")
    assert cli.main(["run", "--resume", str(folder), "--set", "grid.max_gigabytes=9", "keyframes.max_gigabytes=1"]) == 0
    for name in ("trajectory.tum", "mesh.ply"):
        assert (folder / name).read_bytes() == (uninterrupted / name).read_bytes()
    assert "max_gigabytes: 9.0" in (folder / "config.yaml").read_text()


def test_changed_input_is_refused(stopped, recording, capsys):
    """A frame that the run has used was replaced: refused by its number."""
    first, other = (recording / "results" / f"depth{n:06d}.png" for n in (0, 9))
    content = first.read_bytes()
    first.write_bytes(other.read_bytes())
    try:
        assert cli.main(["run", "--resume", str(stopped)]) == 2
    finally:
        first.write_bytes(content)
    assert "frame 0 of" in capsys.readouterr().err


def test_overlapped_run_goes_on_with_a_weaker_promise(recording, tmp_path, capsys):
    """With the schedule overlapped a stopped run goes on from a whole map and is finished; that it is not the same to
    the bit is said. Nothing is said where the schedule is strict.
    """
    overlapped = [*arguments(recording, tmp_path), "--set", "schedule=overlapped"]
    assert start("map", 3, overlapped).wait() == -signal.SIGKILL
    assert cli.main(["run", "--resume", str(tmp_path)]) == 0
    assert "with schedule=strict it would be the same" in capsys.readouterr().err
    metrics = read_json(tmp_path / "metrics.json")
    assert metrics["resumed_after"] >= 2 and metrics["frames"]["processed"] == FRAMES - 1
    saved = Slam.load(RunFolder(tmp_path).map, "cpu")
    assert len(saved.trajectory.poses) == FRAMES - 1 and len(read_tum(tmp_path / "trajectory.tum")[0]) == FRAMES - 1
    assert [keyframe.index for keyframe in saved.keyframes] == sorted({key.index for key in saved.keyframes})
    assert np.isfinite(saved.trajectory.poses).all() and (tmp_path / "mesh.ply").exists()


def test_nothing_to_resume_is_said(uninterrupted, tmp_path, capsys):
    """A run that is over, and a folder without any run."""
    assert cli.main(["run", "--resume", str(uninterrupted)]) == 0
    assert "nothing to do" in capsys.readouterr().out
    assert cli.main(["run", "--resume", str(tmp_path)]) == 2
    assert "--checkpoint-every" in capsys.readouterr().err


def test_run_starts_from_a_map(uninterrupted, recording, tmp_path, capsys):
    """With --map the run has its own trajectory, in the world of the map; --localize leaves the map as it was."""
    command = ["run", str(recording), "-o", str(tmp_path / "a"), "--map", str(uninterrupted), "--localize"]
    loose = ["--set", "tracking.relocalized_depth_error=10", "--frames", "5:8"]
    assert cli.main([*command, *loose]) == 0
    folder = RunFolder(tmp_path / "a")
    assert len(read_tum(folder.trajectory)[0]) == 3
    assert read_json(folder.metrics)["frames"]["processed"] == 3
    before, after = Slam.load(RunFolder(uninterrupted).map, "cpu"), Slam.load(folder.map, "cpu")
    assert len(after.keyframes) == len(before.keyframes)
    for level, grid in before.scene.grids.items():
        np.testing.assert_array_equal(after.scene.grids[level].state().features, grid.state().features)
    assert cli.main([*command, "--overwrite", "--set", "grid.fine_spacing=0.5"]) == 2
    assert "grid.fine_spacing = 0.5 does not fit the map" in capsys.readouterr().err
    assert cli.main(["run", str(recording), "--localize"]) == 2
    assert "--map" in capsys.readouterr().err


def test_the_settings_of_a_run_make_the_same_run(uninterrupted, recording, tmp_path):
    """--config takes the config.yaml that a run wrote: the same bytes again; --set goes on top of it."""
    command = ["run", str(recording), "--device", "cpu", "--seed", "3", "--config", str(uninterrupted / "config.yaml")]
    assert cli.main([*command, "-o", str(tmp_path / "same")]) == 0
    assert_same(tmp_path / "same", uninterrupted)
    assert (tmp_path / "same" / "config.yaml").read_bytes() == (uninterrupted / "config.yaml").read_bytes()
    changed = ["--set", "mapping.every=3", "--frames", "0:2", "-o", str(tmp_path / "other")]
    assert cli.main([*command, *changed]) == 0
    was, changed = (Config.load(folder / "config.yaml") for folder in (uninterrupted, tmp_path / "other"))
    assert changed == was.updated(["mapping.every=3"]) != was
