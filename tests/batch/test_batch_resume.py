"""Sequences of a batch that were stopped: they go on from their last checkpoint, to the same bytes."""

from __future__ import annotations

import shutil
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from tests.pipeline.test_resume import CAMERA, FRAMES, SAME, SETTINGS
from warpslam.batch import jobs as batch_jobs
from warpslam.batch import local as batch
from warpslam.batch.jobs import Job
from warpslam.batch.local import run_batch
from warpslam.batch.status import CRASHED, FINISHED, INTERRUPTED, JobStatus, ended_status
from warpslam.batch.worker import execute
from warpslam.pipeline import checkpoints as resume
from warpslam.pipeline import run as pipeline
from warpslam.pipeline.checkpoints import read_checkpoint
from warpslam.pipeline.setup import open_source
from warpslam.runs.folder import RunFolder
from warpslam.runs.request import RunRequest, Source
from warpslam.storage.json_files import read_json
from warpslam.synthetic import SyntheticSequence, write_replica

NAME = "room"


@pytest.fixture(scope="module", autouse=True)
def no_plots():
    """Figures and the report take longer than all else here and have no part in it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pipeline, "draw_plots", lambda *arguments: None)
        patch.setattr(pipeline, "draw_panels", lambda *arguments: None)
        patch.setattr(pipeline, "write_report", lambda folder: None)
        yield


@pytest.fixture(scope="module")
def job(tmp_path_factory) -> Job:
    """A few frames on disk."""
    folder = tmp_path_factory.mktemp("recording") / NAME
    write_replica(SyntheticSequence(0, FRAMES, intrinsics=CAMERA), folder)
    source, overrides = Source(str(folder)), tuple(SETTINGS)
    request = RunRequest(source, preset="default", overrides=overrides, device="cpu", seed=3, checkpoint_every=2)
    return Job(NAME, request)


@pytest.fixture(scope="module")
def whole(job, tmp_path_factory) -> Path:
    """The batch that the others are compared with; it writes no checkpoint."""
    output = tmp_path_factory.mktemp("whole")
    assert execute(job.asking(checkpoint_every=None), output, lambda news: None) == FINISHED
    return output


@pytest.fixture(scope="module")
def stopped(job, tmp_path_factory) -> Path:
    """A batch that was interrupted at its sixth frame."""
    output = tmp_path_factory.mktemp("stopped")

    def press_ctrl_c(news):
        if news.get("done") == 6:
            raise KeyboardInterrupt

    assert execute(job, output, press_ctrl_c) == INTERRUPTED
    assert RunFolder(output / NAME).checkpoint.exists()
    return output


def run_again(job: Job, stopped: Path, output: Path, spoil=lambda folder: None) -> JobStatus:
    """The job once more, in a copy of the batch that ``spoil`` may change first."""
    shutil.copytree(stopped, output)
    spoil(RunFolder(output / NAME))
    execute(job, output, lambda news: None)
    return ended_status(job, output, JobStatus(NAME))


def assert_same(output: Path, other: Path) -> None:
    for name in SAME:
        assert (output / NAME / name).read_bytes() == (other / NAME / name).read_bytes(), name


def test_killed_worker_goes_on_to_the_same_bytes(job, whole, tmp_path, monkeypatch):
    """SIGKILL in the middle of a sequence: the next batch takes over the frames up to the last checkpoint."""
    for point, count, end in (("map", 3, CRASHED), ("never", 0, FINISHED)):
        worker = (sys.executable, "-m", "tests.stopped_run", point, str(count))
        monkeypatch.setattr(batch, "WORKER_COMMAND", worker)
        seen: list[JobStatus] = []
        (status,) = run_batch([job], tmp_path, on_update=seen.append)
        assert status.status == end
    assert (status.resumed_after, status.done, status.message) == (6, FRAMES, "")
    assert min(status.done for status in seen if status.done) > 6
    assert_same(tmp_path, whole)
    assert not list((tmp_path / NAME).glob("checkpoint*"))


def test_interrupted_sequence_goes_on_to_the_same_bytes(job, stopped, whole, tmp_path):
    """After ctrl-C, and also if the batch is to write its checkpoints at other frames now."""
    status = run_again(job.asking(checkpoint_every=7), stopped, tmp_path / "out")
    assert (status.status, status.resumed_after, status.done) == (FINISHED, 4, FRAMES)
    assert_same(tmp_path / "out", whole)


@pytest.mark.parametrize("change", ["seed", "version"])
def test_other_settings_start_anew(job, stopped, tmp_path, monkeypatch, change):
    """What was computed with other settings, or by another version, is not mixed with the rest."""
    if change == "version":
        monkeypatch.setattr(batch_jobs, "__version__", "0")
    status = run_again(job.asking(seed=4) if change == "seed" else job, stopped, tmp_path / "out")
    assert (status.status, status.resumed_after, status.done, status.message) == (FINISHED, 0, FRAMES, "")


def damage(folder: RunFolder) -> None:
    for path in (folder.checkpoint, folder.previous_checkpoint):
        content = bytearray(path.read_bytes())
        content[len(content) // 2] ^= 1
        path.write_bytes(content)


def test_damaged_checkpoint_starts_anew(job, stopped, whole, tmp_path, caplog):
    """A checkpoint of no use is told of, in the log and in the table, and costs only the time."""
    status = run_again(job, stopped, tmp_path / "out", damage)
    assert (status.status, status.resumed_after) == (FINISHED, 0)
    for text in (status.message, caplog.text, (tmp_path / "out" / NAME / "log.txt").read_text()):
        assert "from the beginning" in text and "checkpoint.safetensors" in text and "truncated or altered" in text
    assert_same(tmp_path / "out", whole)


def test_changed_input_starts_anew(job, stopped, tmp_path):
    """A frame that was replaced since: the sequence is run again as a whole, and why is in the table."""
    folder = tmp_path / NAME
    shutil.copytree(job.request.source.path, folder)
    status = run_again(job, stopped, tmp_path / "kept")
    assert status.resumed_after == 4
    first, other = (Path(job.request.source.path) / "results" / f"depth{n:06d}.png" for n in (0, 9))
    content = first.read_bytes()
    first.write_bytes(other.read_bytes())
    try:
        status = run_again(job, stopped, tmp_path / "out")
    finally:
        first.write_bytes(content)
    assert (status.status, status.resumed_after) == (FINISHED, 0) and "frame 0 of" in status.message


def test_another_gpu_goes_on(job, stopped, monkeypatch):
    """Which GPU a worker gets may differ from batch to batch; from a GPU to the CPU it is another run."""
    folder, sequence = RunFolder(stopped / NAME), open_source(job.request.source)
    saved = read_checkpoint(folder)
    on_gpu = replace(saved, request=replace(saved.request, device="cuda:1"))
    monkeypatch.setattr(resume, "read_checkpoint", lambda folder: on_gpu)
    found, why = resume.find_checkpoint(folder, replace(saved.request, device="cuda:0"), sequence)
    assert (found.request.device, why) == ("cuda:0", "")
    found, why = resume.find_checkpoint(folder, saved.request, sequence)
    assert found is None and "device is 'cpu', was 'cuda:1'" in why


def test_method_and_poses_of_a_job(job, tmp_path):
    """A baseline runs in a batch, with poses from a file, and without the checkpoints that it does not have."""
    given = tmp_path / "given.tum"
    given.write_text("".join(f"{n / 30:.6f} 0 0 {0.01 * n} 0 0 0 1\n" for n in range(FRAMES)))
    small = ("imap.first_iterations=2", "imap.iterations=1", "imap.rounds=1", "imap.refinement_rounds=0")
    job = job.asking(method="imap", poses=str(given), overrides=(*job.request.overrides, *small, "meshing.voxel=0.3"))
    assert execute(job, tmp_path, lambda news: None) == FINISHED
    folder = RunFolder(tmp_path / NAME)
    metrics = read_json(folder.metrics)
    assert (metrics["method"], metrics["poses"]) == ("imap", str(given))
    assert metrics["ate_m"]["unaligned"]["rmse"] > 0.1, "the poses of the file, not the recording's"
    assert "checkpoint" not in metrics
