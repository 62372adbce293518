"""What is measured besides runs, on a few tiny frames."""

from __future__ import annotations

import pytest

from warpslam.batch.jobs import Job
from warpslam.bench.probes import PROBES, convergence, measure, outside_change
from warpslam.camera import Intrinsics
from warpslam.errors import DatasetError
from warpslam.runs.request import RunRequest, Source
from warpslam.synthetic import make_sequence, write_sequence


@pytest.fixture(scope="module")
def job(tmp_path_factory) -> Job:
    """A rendered room of four frames."""
    folder = tmp_path_factory.mktemp("room") / "room"
    write_sequence(make_sequence("room", 1, 4, intrinsics=Intrinsics(24.0, 24.0, 15.5, 11.5, 32, 24)), folder)
    overrides = (
        "mapping.every=1", "mapping.pixels=80", "mapping.first_iterations=20", "mapping.iterations=10",
        "mapping.coarse_iterations=2", "keyframes.every=1", "tracking.ignore_edge_u=2", "tracking.ignore_edge_v=2",
    )  # fmt: skip
    return Job("room", RunRequest(Source(str(folder)), preset="rendering", overrides=overrides, device="cpu"))


def test_only_the_frustum_changes(job):
    """With the selection nothing outside changes, to the bit; without it something does, on every level."""
    on = outside_change(job)
    off = outside_change(job.asking(overrides=(*job.request.overrides, "mapping.frustum_selection=false")))
    assert on["figures"] == {"outside": 0.0} and off["figures"]["outside"] > 0
    for level, known in on["levels"].items():
        assert known["outside"] > 0 and known["changed"] == 0 and off["levels"][level]["changed"] > 0


def test_convergence_on_the_first_frame(job):
    """The view's depth comes nearer to the measured one; its last value is the figure."""
    result = convergence(job)
    iterations, errors = zip(*result["curve"], strict=True)
    assert iterations[0] == 0 and iterations[-1] == 20 and list(iterations) == sorted(set(iterations))
    assert errors[-1] < errors[0] / 2 and result["figures"] == {"view_depth": errors[-1]}


def test_measured_once(job, tmp_path, monkeypatch):
    """What was measured with the same settings is read; other settings are measured."""
    calls = []
    monkeypatch.setitem(PROBES, "outside", lambda job: calls.append(job) or {"figures": {"outside": 0.5}})
    first, again = measure("outside", job, tmp_path), measure("outside", job, tmp_path)
    assert first == again and len(calls) == 1
    measure("outside", job.asking(seed=1), tmp_path)
    assert len(calls) == 2


def test_frames_without_poses(job, tmp_path):
    """The message says that none has one."""
    elsewhen = tmp_path / "elsewhen.tum"
    elsewhen.write_text("1000 0 0 0 0 0 0 1\n")
    with pytest.raises(DatasetError, match="none of the selected frames has a pose"):
        convergence(job.asking(poses=str(elsewhen)))
