"""Many sequences in worker processes: states, what is skipped and what is done again, and how workers end."""

from __future__ import annotations

import csv
import json
import os
import signal
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.fakes import FakeSequence, FakeSlam, Terminal
from warpslam import cli
from warpslam.batch import local as batch
from warpslam.batch.jobs import Job, with_free_names
from warpslam.batch.local import run_batch, split_cores
from warpslam.batch.manifest import FIELDS, read_manifest
from warpslam.batch.status import BatchState, JobStatus
from warpslam.batch.summary import write_summary
from warpslam.batch.worker import execute
from warpslam.config import Config
from warpslam.errors import ConfigError, WarpSlamError
from warpslam.pipeline import run as pipeline
from warpslam.runs.request import RunRequest, Source
from warpslam.storage.json_files import read_json

COMMON = Job("", RunRequest(source=Source("")))


@pytest.fixture(autouse=True)
def fake_worker(monkeypatch):
    """Workers that need no SLAM."""
    worker = str(Path(__file__).with_name("fake_worker.py"))
    monkeypatch.setattr(batch, "WORKER_COMMAND", (sys.executable, worker))


def jobs(*names: str) -> list[Job]:
    return with_free_names(Job(name, RunRequest(source=Source(f"/data/{name}"))) for name in names)


def test_failures_do_not_stop_the_rest(tmp_path):
    """Every way to end is told, with its reason; the others finish."""
    names = ("good", "broken", "bug", "killed", "exits", "good2")
    statuses = {status.name: status for status in run_batch(jobs(*names), tmp_path, workers=2)}
    assert list(statuses) == list(names)
    assert {name: status.status for name, status in statuses.items()} == {
        "good": "finished", "broken": "failed", "bug": "failed", "killed": "crashed", "exits": "crashed",
        "good2": "finished",
    }  # fmt: skip
    assert statuses["broken"].message.startswith("depth.png: truncated")
    assert statuses["bug"].message == "ZeroDivisionError: by zero"
    assert "SIGKILL" in statuses["killed"].message
    assert statuses["exits"].message == "the worker ended with code 3: last words"
    good = statuses["good"]
    assert (good.done, good.total, good.ate_rmse, good.fps, good.lost) == (4, 4, 0.03, 2.0, 1) and good.seconds > 0


def test_running_again_does_only_what_is_left(tmp_path):
    """Finished jobs are not touched; failed ones, and those with other settings, are run again."""
    first = jobs("good", "broken", "other")
    run_batch(first, tmp_path, workers=2)
    before = {job.name: read_json(tmp_path / job.name / "batch.json") for job in first}
    again = [first[0], first[1], first[2].asking(seed=1)]
    statuses = run_batch(again, tmp_path)
    assert [status.status for status in statuses] == ["done before", "failed", "finished"]
    assert statuses[0].ate_rmse == 0.03
    after = {job.name: read_json(tmp_path / job.name / "batch.json") for job in first}
    assert after["good"] == before["good"]
    assert after["broken"]["pid"] != before["broken"]["pid"] and after["other"]["pid"] != before["other"]["pid"]
    (tmp_path / "good" / "trajectory.tum").unlink()
    assert run_batch(first[:1], tmp_path)[0].status == "finished"


def test_memory_budget(tmp_path):
    """A worker beyond its budget ends with a clear status; far beyond it, at once. Neither stops the rest."""
    budget = 0.3
    for name, at_once in (("hungry", False), ("very_hungry", True)):
        hungry, good = run_batch(jobs(name, "good"), tmp_path / name, workers=2, memory_gb=budget)
        assert (hungry.status, good.status) == ("out of memory", "finished")
        assert f"exceed the budget of {budget:g} GB" in hungry.message and "--memory-gb" in hungry.message
        assert ("ending" in BatchState.of(jobs(name)[0], tmp_path / name).fields) == at_once


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system does not pin processes to cores")
def test_workers_share_the_cores(tmp_path, monkeypatch):
    """Each worker is pinned to its share, disjoint where there are enough cores."""
    run_batch(jobs("slow1", "slow2"), tmp_path, workers=2)
    own = sorted(os.sched_getaffinity(0))
    shares = [eval((tmp_path / name / "cores.txt").read_text()) for name in ("slow1", "slow2")]
    assert sorted(sum(shares, [])) == own if len(own) > 1 else shares == [own, own]
    monkeypatch.setattr("warpslam.batch.local.process_cores", lambda: [0, 1, 4, 5, 6])
    assert split_cores(2) == [[0, 1], [4, 5, 6]]
    assert split_cores(5) == [[0], [1], [4], [5], [6]]
    assert split_cores(6)[5] == [0]


def test_updates_tell_the_story(tmp_path):
    """Waiting, running with frames, and the end, for each job."""
    seen: list[JobStatus] = []
    run_batch(jobs("slow", "good"), tmp_path, on_update=seen.append)
    story = [status.status for status in seen if status.name == "slow"]
    assert story[0] == "waiting" and story[1] == "running" and story[-1] == "finished"
    assert {status.done for status in seen if status.name == "slow"} >= {1, 2, 3, 4}


def test_kernels_are_compiled_once(tmp_path):
    """The second worker starts when the first one has all kernels, not while it compiles them."""
    running = {}
    names = ("compiling", "good", "good2")
    run_batch(
        jobs(*names), tmp_path, workers=2,
        on_update=lambda status: status.status == "running" and running.setdefault(status.name, time.monotonic()),
    )  # fmt: skip
    assert running["good"] - running["compiling"] > 0.5 > running["good2"] - running["good"]


@pytest.fixture
def heard_interrupts():
    """Ctrl-C arrives, also where the tests were started in the background of a shell, which has it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_interrupt_stops_workers_and_the_rest_waits(tmp_path, heard_interrupts):
    """Ctrl-C: the running job is told to write what it has, the next one is not started, and both go on later."""
    sent = []

    def on_update(status):
        if status.done == 1 and not sent:
            sent.append(True)
            os.kill(os.getpid(), signal.SIGINT)

    statuses = run_batch(jobs("slow", "next"), tmp_path, on_update=on_update)
    assert [status.status for status in statuses] == ["interrupted", "interrupted"]
    assert statuses[1].message == "not started"
    assert [status.status for status in run_batch(jobs("slow", "next"), tmp_path)] == ["finished", "finished"]


def test_worker_left_behind_is_no_obstacle(tmp_path):
    """A state file that still says "running" (the machine was switched off) means that the job is run again."""
    (job,) = jobs("good")
    BatchState.of(job, tmp_path).write(settings=job.settings_hash, status="running", attempt=1)
    (status,) = run_batch([job], tmp_path)
    assert (status.status, status.attempt) == ("finished", 2)
    (tmp_path / "good" / "batch.json").write_text("{")
    assert run_batch([job], tmp_path)[0].status == "finished"


def test_manifest(tmp_path):
    """Defaults, entries as text and as mapping, paths relative to the file, names made unique."""
    text = """
    defaults: {preset: replica, set: [mapping.every=2], seed: 3}
    sequences:
      - room
      - {path: a/room, set: [mapping.window=4], frames: "0:200", device: cpu, truth_mesh: a/m.ply}
      - {path: /x/y, name: last one}
    """
    file = tmp_path / "batch.yaml"
    file.write_text(text)
    first, second, third = with_free_names(read_manifest(file, COMMON))
    assert (first.name, second.name, third.name) == ("room", "room_2", "last_one")
    assert first.request.source.path == str(tmp_path / "room") and third.request.source.path == "/x/y"
    asked = second.request
    assert asked.overrides == ("mapping.every=2", "mapping.window=4") and asked.frames == (0, 200, None)
    assert asked.truth_mesh == str(tmp_path / "a" / "m.ply") and (asked.seed, asked.preset) == (3, "replica")
    assert len({job.settings_hash for job in (first, second, third)}) == 3
    assert Job.from_dict(second.to_dict()) == second


def test_manifest_names_methods_poses_and_checkpoints(tmp_path):
    """Method, given poses (relative to the file) and checkpoints, of all sequences or of one; 0 is for none."""
    text = """
    defaults: {method: tsdf, poses: poses.tum, checkpoint_every: 7}
    sequences: [a, {path: b, method: nice-slam, checkpoint_every: 0}]
    """
    (tmp_path / "m.yaml").write_text(text)
    jobs = read_manifest(tmp_path / "m.yaml", COMMON.asking(checkpoint_every=50))
    first, second = (job.request for job in jobs)
    assert (first.method, first.poses, first.checkpoint_every) == ("tsdf", str(tmp_path / "poses.tum"), 7)
    assert (second.method, second.checkpoint_every) == ("nice-slam", None)


def test_manifest_takes_settings_from_files(tmp_path):
    """A config stands in place of a preset that is given for all, and the other way round, but not beside one."""
    Config.from_preset("thorough", ["mapping.window=3"]).save(tmp_path / "c.yaml")
    text = """
    defaults: {config: c.yaml}
    sequences: [a, {path: b, preset: replica}, {path: c, map: m.safetensors, localize_only: true}]
    """
    (tmp_path / "m.yaml").write_text(text)
    jobs = read_manifest(tmp_path / "m.yaml", COMMON.asking(preset="icl"))
    first, second, third = (job.request for job in jobs)
    assert (first.config.mapping.window, first.preset) == (3, None)
    assert (second.config, second.preset) == (None, "replica")
    assert (third.map, third.localize_only) == (str(tmp_path / "m.safetensors"), True)
    assert Job.from_dict(json.loads(json.dumps(jobs[0].to_dict()))) == jobs[0]
    other = replace(jobs[0], request=replace(first, config=first.config.updated(["mapping.window=4"])))
    assert other.settings_hash != jobs[0].settings_hash, "what is in the file decides, not its name"


def test_checkpoints_do_not_decide_on_the_result():
    """A batch with other checkpoints is still the same batch; one with another method or other poses is not."""
    job = Job("a", RunRequest(source=Source("/a")))
    assert job.asking(checkpoint_every=5).settings_hash == job.settings_hash
    assert len({j.settings_hash for j in (job, job.asking(method="tsdf"), job.asking(poses="/p"))}) == 3


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected a list 'sequences'"),
        ("sequences: []", "expected a list 'sequences'"),
        ("sequences: [1]", "entry 1: expected a folder"),
        ("sequences: [{name: a}]", "entry 1: expected"),
        ("sequences: [a, {path: b, sed: 1}]", "entry 2: .*known fields are path"),
        ("sequences: [{path: b, seed: x}]", "seed = 'x'"),
        ("sequences: [{path: b, set: a=1}]", "set = 'a=1' must be a list"),
        ("sequences:\n- path: b\n  frames: 1:20", "frames = 80 must be a text in quotes"),
        ("sequences: [{path: b, frames: 'x'}]", "is not A:B"),
        ("sequences: [{path: b, config: none.yaml}]", "none.yaml: can't be read"),
        ("sequences: [{path: b, config: c.yaml, preset: icl}]", "config and preset do not go together"),
        ("sequences: [{path: b, localize_only: 1}]", "localize_only = 1 must be true or false"),
        ("sequences: [a]\nextra: 1", "unknown field extra"),
        ("a: b: c", "can't be read as yaml"),
        ("[" * 3000, "can't be read as yaml"),
    ],
)
def test_wrong_manifests(tmp_path, text, message):
    """What is wrong is named with the file and the entry."""
    (tmp_path / "m.yaml").write_text(text)
    with pytest.raises(ConfigError, match=message):
        read_manifest(tmp_path / "m.yaml", COMMON)


@settings(deadline=None, derandomize=True)
@given(st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3)
    | st.dictionaries(st.sampled_from([*FIELDS, "sequences", "defaults", "x"]), inner, max_size=4),
    max_leaves=12,
))  # fmt: skip
def test_any_manifest_is_read_or_refused(tmp_path_factory, content):
    """Whatever yaml holds, the answer is jobs or a typed error."""
    file = tmp_path_factory.mktemp("m") / "m.yaml"
    file.write_text(yaml.safe_dump(content))
    try:
        assert all(isinstance(job.request.source.path, str) for job in with_free_names(read_manifest(file, COMMON)))
    except WarpSlamError:
        pass


def test_settings_are_refused_before_any_worker_starts(tmp_path):
    """A setting out of range, an unknown preset, no job at all."""
    bad = [
        ([jobs("a")[0].asking(overrides=("mapping.window=0",))], {}, "mapping.window"),
        ([jobs("a")[0].asking(preset="fast")], {}, "preset 'fast'"),
        ([jobs("b")[0], jobs("a")[0].asking(method="orb")], {}, "method 'orb' is unknown"),
        ([jobs("a")[0].asking(checkpoint_every=-1)], {}, "checkpoint_every = -1 of a"),
        ([], {}, "the batch is empty"),
        (jobs("a"), {"workers": 0}, "workers = 0"),
        (jobs("a"), {"memory_gb": 0.0}, "memory_gb"),
    ]
    for job_list, keywords, message in bad:
        with pytest.raises(ConfigError, match=message):
            run_batch(job_list, tmp_path / "out", **keywords)
    assert not (tmp_path / "out").exists()


def test_summary_files(tmp_path):
    """A row a job; text from errors can't break the page."""
    statuses = [
        JobStatus("a", "finished", 4, 4, 0.0123, 2.5, 61.04, 1, 512.4, "", 2, 3, 0.9123, 24.5),
        JobStatus("b", "failed", message="<script>alert(1)</script>\nsecond line"),
    ]
    csv_path, html_path = write_summary(statuses, tmp_path)
    rows = list(csv.reader(csv_path.open()))
    assert rows[1][:2] == ["a", "finished (2 attempts, resumed after 3 frames)"]
    figures = dict(zip(rows[0], rows[1], strict=True))
    assert rows[1][2:] == ["4/4", "1", "1.23", "91.23", "24.50", "2.50", "61.0", "512", ""]
    assert figures["surface < 5 cm [%]"] == "91.23" and figures["PSNR [dB]"] == "24.50"
    assert rows[2][-1] == "<script>alert(1)</script>" and len(rows) == 3
    page = html_path.read_text()
    assert "1 of 2 sequences done" in page and "<script>" not in page and "&lt;script&gt;" in page


def test_summary_has_means(tmp_path):
    """Over what is done, now or before; where some lack a figure, it says over how many it is."""
    statuses = [
        JobStatus("a", "finished", 4, 4, 0.01, 2.0, 60.0, 1, 500.0, psnr_db=20.0),
        JobStatus("b", "done before", 4, 4, 0.03, 4.0, 20.0, 0, 700.0, completion_ratio=0.5, psnr_db=30.0),
        JobStatus("c", "failed", 2, 4, 9.0, 1.0, 1.0, 2, 900.0),
    ]
    csv_path, html_path = write_summary(statuses, tmp_path)
    *_, last = csv.reader(csv_path.open())
    assert last == ["mean of 2", "", "", "0.5", "2.00", "50.00 (1 of 2)", "25.00", "3.00", "40.0", "600", ""]
    assert "<td>mean of 2</td>" in html_path.read_text()


def test_command(tmp_path, capsys):
    """Lines of progress, the table, both files; exit code 1 while something is unfinished, 0 after."""
    for name in ("good", "broken"):
        (tmp_path / name).mkdir()
    out = tmp_path / "out"
    options = ["--workers", "2", "-o", str(out)]
    assert cli.main(["batch", str(tmp_path / "good"), str(tmp_path / "broken"), *options]) == 1
    text = capsys.readouterr().out
    assert "good: running  frame 4/4  2.00 fps" in text
    assert "broken: failed  frame 2/4  2.00 fps  ATE 1.00 cm  depth.png: truncated" in text
    assert "sequence" in text and "3.00" in text and str(out / "summary.html") in text
    assert cli.main(["batch", str(tmp_path / "good"), *options]) == 0
    assert "good: done before" in capsys.readouterr().out
    assert (out / "summary.csv").is_file()


@pytest.mark.parametrize(
    ("options", "method", "every"),
    [
        ([], "nice-slam", 50),
        (["--checkpoint-every", "7", "--method", "imap"], "imap", 7),
        (["--checkpoint-every", "0"], "nice-slam", None),
    ],
)
def test_command_names_method_and_checkpoints(tmp_path, monkeypatch, options, method, every):
    """Checkpoints are written unless they are switched off, and the method is the option's."""
    found = []
    monkeypatch.setattr(batch, "run_batch", lambda jobs, output, **keywords: found.extend(jobs) or [])
    assert cli.main(["batch", str(tmp_path), "-o", str(tmp_path / "out"), *options]) == 0
    assert [(job.request.method, job.request.checkpoint_every) for job in found] == [(method, every)]


def test_table_on_a_terminal(tmp_path, monkeypatch):
    """On a terminal a table is kept up to date, and ends as the summary."""
    terminal = Terminal()
    monkeypatch.setattr("sys.stdout", terminal)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "150")
    assert cli.main(["batch", str(tmp_path / "slow"), "-o", str(tmp_path / "out")]) == 0
    text = terminal.getvalue()
    assert "running" in text and "finished" in text and "3.00" in text


def test_figures_of_a_batch(tmp_path, monkeypatch):
    """Each sequence logs under the name of its job; where figures go decides nothing on what is done again."""
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    monkeypatch.setattr(pipeline, "build_slam", lambda camera, *others: FakeSlam(camera))
    monkeypatch.setattr(pipeline, "open_source", lambda source: FakeSequence(5))
    for name in ("draw_plots", "draw_panels", "write_report"):
        monkeypatch.setattr(pipeline, name, lambda *arguments: None)
    found = []
    monkeypatch.setattr(batch, "run_batch", lambda jobs, output, **keywords: found.extend(jobs) or [])
    monkeypatch.chdir(tmp_path)
    (tmp_path / "room").mkdir()
    assert cli.main(["batch", "room", "room", "--log", "tensorboard:board", "--checkpoint-every", "0"]) == 0
    assert [job.log for job in found] == [f"tensorboard:{tmp_path / 'board'}"] * 2
    assert [Job.from_dict(json.loads(json.dumps(job.to_dict()))) for job in found] == found
    assert found[0].settings_hash == replace(found[0], log="").settings_hash
    for job in found:
        assert execute(job, tmp_path / "out", lambda news: None) == "finished"
    for name in ("room", "room_2"):
        events = EventAccumulator(str(tmp_path / "board" / name))
        events.Reload()
        assert [event.step for event in events.Scalars("inliers")] == [1, 2, 3, 4, 5]
        assert events.Scalars("end/ate_rmse_m")[0].value > 0


def test_figures_that_can_go_nowhere(tmp_path, monkeypatch, capsys):
    """One line, before any worker starts."""
    monkeypatch.setitem(sys.modules, "wandb", None)
    monkeypatch.setattr(batch, "run_batch", lambda *_, **__: pytest.fail("it was started"))
    assert cli.main(["batch", str(tmp_path), "--log", "wandb:rooms", "-o", str(tmp_path / "out")]) == 2
    assert "pip install wandb" in capsys.readouterr().err


def test_dead_coordinator_takes_its_workers_along(tmp_path):
    """A worker whose reader is gone ends instead of going on unseen."""
    import subprocess

    (job,) = jobs("slow")
    order = {"job": job.to_dict(), "output": str(tmp_path), "slot": 0, "cores": split_cores(1)[0], "memory_gb": None}
    environment = {**os.environ, "PYTHONPATH": str(Path(batch.__file__).parent.parent)}
    (tmp_path / "slow").mkdir()
    process = subprocess.Popen(
        batch.WORKER_COMMAND, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
        env=environment, text=True,
    )  # fmt: skip
    process.stdin.write(json.dumps(order))
    process.stdin.close()
    process.stdout.readline()
    process.stdout.close()
    start = time.monotonic()
    process.wait(timeout=20)
    assert time.monotonic() - start < 20 and not (tmp_path / "slow" / "metrics.json").exists()
