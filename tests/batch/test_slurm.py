"""Batches under Slurm, with submitit's processes of this machine in its place."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from warpslam import cli
from warpslam.batch import slurm_cluster
from warpslam.batch.jobs import Job
from warpslam.batch.slurm_cluster import run_on_slurm
from warpslam.camera import Intrinsics
from warpslam.runs.request import RunRequest, Source
from warpslam.synthetic import SyntheticSequence, write_replica

SMALL = ("mapping.pixels=60", "mapping.first_iterations=4", "mapping.iterations=2", "mapping.refinement_rounds=1")


def test_without_submitit(monkeypatch, tmp_path, capsys):
    """One line that says what to install."""
    monkeypatch.setitem(sys.modules, "submitit", None)
    assert cli.main(["batch", str(tmp_path), "--cluster", "slurm", "-o", str(tmp_path / "out")]) == 2
    assert "pip install submitit" in capsys.readouterr().err


def test_without_slurm(monkeypatch, tmp_path, capsys):
    """A machine without Slurm is told so, in one line."""
    pytest.importorskip("submitit")
    monkeypatch.setenv("PATH", str(tmp_path))
    assert cli.main(["batch", str(tmp_path), "--cluster", "slurm:gpu", "-o", str(tmp_path / "out")]) == 2
    err = capsys.readouterr().err
    assert "no Slurm here" in err and len(err.strip().splitlines()) == 1


def test_two_sequences(monkeypatch, tmp_path):
    """A sequence that works and one that is not there: each ends in its state, news come meanwhile, and a second batch
    does only what is left.
    """
    pytest.importorskip("submitit")
    monkeypatch.setenv("PYTHONPATH", str(Path(cli.__file__).resolve().parents[2]))
    monkeypatch.setattr(slurm_cluster, "_NEWS_SECONDS", 0.0)
    camera = Intrinsics(60.0, 60.0, 39.5, 29.5, 80, 60)
    write_replica(SyntheticSequence(1, 4, intrinsics=camera, device="cpu"), tmp_path / "room")
    jobs = [
        Job(name, RunRequest(Source(str(tmp_path / name)), preset="default", overrides=SMALL, device="cpu"))
        for name in ("room", "nowhere")
    ]
    seen: list[str] = []
    statuses = run_on_slurm(
        jobs, tmp_path / "out", backend="local", on_update=lambda status: seen.append(f"{status.name} {status.status}")
    )
    assert [status.status for status in statuses] == ["finished", "failed"]
    assert statuses[0].done == 4 and "nowhere" in statuses[1].message
    assert "room waiting" in seen and "room running" in seen
    assert (tmp_path / "out" / "room" / "trajectory.tum").is_file()
    again = run_on_slurm(jobs, tmp_path / "out", backend="local")
    assert [status.status for status in again] == ["done before", "failed"]
