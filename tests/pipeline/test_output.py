"""Full disks, folders that can't be written to, and bad frames, seen from a run: what is said and what is left."""

from __future__ import annotations

import dataclasses
import errno
import json
import logging
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.fakes import FakeSequence, FakeSlam, run_sequence
from warpslam import cli
from warpslam.config import Config
from warpslam.errors import ConfigError, DatasetError, MeshError, OutputError
from warpslam.frames import FrameStatus
from warpslam.pipeline import finished
from warpslam.pipeline import run as pipeline
from warpslam.runs.folder import RunFolder
from warpslam.runtime.kernel_cache import kernel_cache_errors
from warpslam.storage.json_files import read_json
from warpslam.storage.tum import read_tum


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> type[FakeSlam]:
    """A SLAM object that answers at once, and no plots."""

    class Slam(FakeSlam):
        skip: tuple[int, ...] = ()

        def step(self, rgb, depth, timestamp=None, T_world_camera=None, *, depth_timestamp=None):
            result = super().step(rgb, depth, timestamp, T_world_camera)
            if result.index in self.skip or (T_world_camera is not None and np.isnan(T_world_camera).any()):
                result = self.results[-1] = dataclasses.replace(result, status=FrameStatus.SKIPPED, message="no use")
            return result

    monkeypatch.setattr(
        pipeline, "build_slam", lambda intrinsics, config, device, seed, method, timing: Slam(intrinsics, config=config)
    )
    monkeypatch.setattr(pipeline, "draw_plots", lambda *arguments: None)
    monkeypatch.setattr(pipeline, "draw_panels", lambda *arguments: None)
    monkeypatch.setattr(pipeline, "open_source", lambda source: FakeSequence(8))
    return Slam


@pytest.fixture
def small_disk(tmp_path):
    """A file system of 64 kB; what fills it is the test's business."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = shutil.which("mount")
    if mount is None or os.name != "posix" or os.geteuid() != 0:
        pytest.skip("mounting a small file system needs root")
    if subprocess.run([mount, "-t", "tmpfs", "-o", "size=64k", "tmpfs", folder], capture_output=True).returncode:
        pytest.skip("mounting is not allowed here")
    yield folder
    subprocess.run(["umount", "-l", folder], check=True)


def fill(folder: Path, leave: int) -> None:
    """Fill a file system up to ``leave`` bytes."""
    stat = os.statvfs(folder)
    (folder / "filler").write_bytes(bytes(stat.f_bavail * stat.f_frsize - leave))


def test_full_disk_keeps_the_trajectory(fake, small_disk, monkeypatch, capsys):
    """The map does not fit: one line, exit code 2; trajectory and metrics are there, half the map is not."""

    def save(self, path):
        Path(path).with_name("map.npz.part").write_bytes(bytes(1 << 20))

    monkeypatch.setattr(fake, "save", save)
    assert cli.main(["run", "seq", "-o", str(small_disk / "run")]) == 2
    err = capsys.readouterr().err
    assert re.search(r"warpslam: .*can't be written \(No space left on device\); free some space", err)
    assert "Traceback" not in err
    assert len(read_tum(small_disk / "run" / "trajectory.tum")[0]) == 8
    metrics = read_json(small_disk / "run" / "metrics.json")
    assert metrics["status"] == "failed" and "No space left" in metrics["error"]
    assert not list((small_disk / "run").glob("*.part*"))


def test_disk_that_fills_up_during_the_run(fake, small_disk, monkeypatch, caplog):
    """Not even the trajectory fits any more: it goes to the folder for temporary files, and the log says where."""
    step = fake.step

    def filling(self, *arguments, **keywords):
        if len(self.results) == 5:
            fill(small_disk, 0)
        return step(self, *arguments, **keywords)

    monkeypatch.setattr(fake, "step", filling)
    with pytest.raises(OutputError, match="No space left"):
        run_sequence(FakeSequence(8), Config(), small_disk / "run")
    where = re.search(r"trajectory so far is in (\S+)", caplog.text)
    assert where is not None
    assert len(read_tum(where[1])[0]) == 8
    shutil.rmtree(Path(where[1]).parent)


@pytest.mark.parametrize("lost", ["map", "mesh"])
def test_what_fits_on_a_full_disk_is_written(fake, tmp_path, monkeypatch, lost):
    """One result that does not fit takes no other one along; what is missing is made later of what is there."""
    run = tmp_path / "run"
    real_write = Path.write_bytes
    real_text = Path.write_text

    def full(write):
        def call(self, *arguments, **keywords):
            if self.name.startswith(lost):
                raise OSError(errno.ENOSPC, "No space left on device", str(self))
            return write(self, *arguments, **keywords)

        return call

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", full(real_write))
        patch.setattr(Path, "write_text", full(real_text))
        with pytest.raises((OutputError, MeshError), match="No space left|can't be written"):
            run_sequence(FakeSequence(4), Config(), run)
    there = {path.name for path in run.iterdir()}
    expected = {"map.safetensors", "mesh.ply", "trajectory.tum", "metrics.json", "frames.csv", "report.html"}
    assert expected - there == {name for name in expected if name.startswith(lost)}
    assert json.loads((run / "metrics.json").read_text())["status"] == "failed"
    monkeypatch.setattr(finished, "load_slam", lambda folder, device=None: FakeSlam(FakeSequence.intrinsics))
    if lost == "mesh":
        assert finished.complete(RunFolder(run))[0] == "mesh.ply" and (run / "mesh.ply").is_file()


def test_figures_are_there_before_the_map(fake, tmp_path, monkeypatch):
    """A run that is killed while its map is written leaves a folder that a report can be made of."""
    seen = {}

    def save(self, path):
        seen.update(json.loads((path.parent / "metrics.json").read_text()))
        raise SystemExit

    monkeypatch.setattr(FakeSlam, "save", save)
    with pytest.raises(SystemExit):
        run_sequence(FakeSequence(4), Config(), tmp_path / "run")
    assert seen["status"] == "unfinished" and seen["frames"]["processed"] == 4


def test_log_that_can_not_be_written_does_not_end_the_run(fake, tmp_path, monkeypatch, caplog, capsys):
    """The run goes on without its log, and says so once."""
    emit = logging.StreamHandler.emit

    def failing(self, record):
        if isinstance(self, logging.FileHandler) and "frame 2" in record.getMessage():
            self.handleError(record)
        else:
            emit(self, record)

    monkeypatch.setattr(logging.StreamHandler, "emit", failing)
    result = run_sequence(FakeSequence(8), Config(), tmp_path)
    assert result.status == "finished" and caplog.text.count("goes on without it") == 1
    assert "Logging error" not in capsys.readouterr().err


def test_read_only_output_is_refused_before_the_run(fake, small_disk):
    """A folder that is there and can't be written to."""
    (small_disk / "run").mkdir()
    subprocess.run(["mount", "-o", "remount,ro", small_disk], check=True)
    for folder in (small_disk / "run", small_disk / "new"):
        with pytest.raises(ConfigError, match=r"can't be used \(Read-only file system\); choose another"):
            RunFolder.create(folder, "x")


def test_output_that_is_a_file(fake, tmp_path, capsys):
    """One line and exit code 2."""
    (tmp_path / "file").write_text("")
    assert cli.main(["run", "seq", "-o", str(tmp_path / "file")]) == 2
    assert "File exists" in capsys.readouterr().err


def test_unwritable_kernel_cache(monkeypatch):
    """An error about the cache names it and the way out; any other error passes as it is."""
    with pytest.raises(ConfigError, match=r"kernel cache .* \(Read-only file system\).*WARP_CACHE_PATH"):
        with kernel_cache_errors():
            raise OSError(errno.EROFS, "Read-only file system")
    with pytest.raises(RuntimeError, match="something else"), kernel_cache_errors():
        raise RuntimeError("something else")
    with pytest.raises(FileNotFoundError), kernel_cache_errors():
        raise FileNotFoundError(errno.ENOENT, "no such file", "/somewhere/else")
    # The compiler's own error, with a cache that can't be written.
    monkeypatch.setattr(Path, "write_bytes", lambda self, data: (_ for _ in ()).throw(OSError(errno.ENOSPC, "full")))
    with pytest.raises(ConfigError, match=r"\(full\)"), kernel_cache_errors():
        raise RuntimeError("build failed")


@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_closed_pipe(tmp_path, unbuffered):
    """A reader that goes away, as "| head" does, is no traceback."""
    reader, writer = os.pipe()
    os.close(reader)
    process = subprocess.run(
        [sys.executable, "-m", "warpslam", "check", str(tmp_path)], stdout=writer, stderr=subprocess.PIPE, text=True,
        cwd=Path(__file__).resolve().parents[2], env={**os.environ, "PYTHONUNBUFFERED": unbuffered},
    )  # fmt: skip
    os.close(writer)
    assert process.returncode == 2 and process.stderr == ""


# -- bad frames ------------------------------------------------------------------------------------------------------


class Timed(FakeSequence):
    """Frames with given times."""

    def __init__(self, times):
        super().__init__(len(times))
        self.times = times

    def __getitem__(self, index):
        return dataclasses.replace(super().__getitem__(index), timestamp=self.times[index])


@pytest.mark.parametrize(
    ("times", "kept"),
    [
        ([1, 2, 2, 3], [1, 2, 3]),
        ([1, 2, 1.5, 3, 4], [1, 2, 3, 4]),
        ([1, 2, 900, 3, 4, 5], [1, 2, 900, 4, 5]),
        ([5, 6, 1, 2, 3], [5, 6, 2, 3]),
    ],
)
def test_times_that_do_not_go_forward(fake, tmp_path, times, kept):
    """Each wrong time costs a frame, and not all that come after it; metrics.json says which and why."""
    result = run_sequence(Timed([t / 30 for t in times]), Config(), tmp_path)
    np.testing.assert_allclose(read_tum(result.folder.trajectory)[0], np.array(kept) / 30)
    unusable = read_json(result.folder.metrics)["unusable_frames"]
    assert len(unusable) == len(times) - len(kept) == result.metrics.frames.unreadable
    assert all("is not after" in entry["reason"] for entry in unusable)


def test_skipped_and_unreadable_frames_are_listed(fake, tmp_path, monkeypatch):
    """metrics.json has a line for each frame without a result, with its number in the sequence."""
    monkeypatch.setattr(fake, "skip", (1,))
    result = run_sequence(FakeSequence(8, unreadable=(1,)), Config(), tmp_path, frames=(0, 8, None))
    assert read_json(result.folder.metrics)["unusable_frames"] == [
        {"frame": 1, "status": "unreadable", "reason": "frame000001.jpg is truncated"},
        {"frame": 2, "status": "SKIPPED", "reason": "no use"},
    ]


def test_no_usable_frame_is_an_error(fake, tmp_path, monkeypatch):
    """When every frame is skipped the run says so, instead of showing an empty map."""
    monkeypatch.setattr(fake, "skip", tuple(range(8)))
    with pytest.raises(DatasetError, match="none of the 8 frames can be used: no use"):
        run_sequence(FakeSequence(8), Config(), tmp_path)


def test_given_poses_with_holes(fake, tmp_path):
    """With use_given_poses a frame without a pose is skipped; a sequence without any is refused at the start."""
    config = Config.from_preset("default", ["tracking.use_given_poses=true"])
    result = run_sequence(FakeSequence(8, no_truth=(3,)), config, tmp_path / "a")
    assert result.metrics.frames.SKIPPED == 1 and result.metrics.frames.OK == 7
    with pytest.raises(ConfigError, match="has no poses"):
        run_sequence(FakeSequence(8, no_truth=tuple(range(8))), config, tmp_path / "b")


def test_input_that_can_not_work_is_refused_before_any_work(fake, tmp_path, monkeypatch):
    """An error of the checks ends the run before SLAM starts, unless it is told to go on; warnings are kept."""

    class OffCentre(FakeSequence):
        intrinsics = dataclasses.replace(FakeSequence.intrinsics, cx=0.0)

    built = []
    build = pipeline.build_slam
    monkeypatch.setattr(pipeline, "build_slam", lambda *arguments: built.append(1) or build(*arguments))
    with pytest.raises(DatasetError, match="principal point .*--camera.*warpslam check"):
        run_sequence(OffCentre(4), Config(), tmp_path)
    assert not built and read_json(tmp_path / "metrics.json")["status"] == "failed"
    result = run_sequence(OffCentre(4), Config(), tmp_path, check_input=False)
    (finding,) = (found for found in result.metrics.input_checks if found.check != "structure")  # a plain wall
    assert built and finding.check == "camera" and json.loads((tmp_path / "metrics.json").read_text())
