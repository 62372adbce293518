"""Recordings for Rerun, read by its own reader."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from tests.fakes import FakeSequence, FakeSlam, run_sequence, true_pose
from warpslam.cli import main
from warpslam.config import Config
from warpslam.errors import OutputError
from warpslam.pipeline import run as pipeline
from warpslam.viewer.recording import RerunRecording


@pytest.fixture
def faked(monkeypatch):
    """A SLAM object that answers at once, without plots."""
    monkeypatch.setattr(pipeline, "build_slam", lambda camera, *others: FakeSlam(camera))
    for name in ("draw_plots", "draw_panels", "write_report"):
        monkeypatch.setattr(pipeline, name, lambda *arguments: None)


def test_a_recording_holds_the_run(faked, tmp_path):
    """World, camera, images, path and mesh; the camera's poses are those of the frames."""
    pytest.importorskip("rerun")
    from rerun.chunk import RrdReader

    file = tmp_path / "deep" / "run.rrd"
    run_sequence(FakeSequence(5), Config(), tmp_path / "run", observer=RerunRecording(file))
    chunks = RrdReader(file).stream().to_chunks()
    entities = {str(chunk.entity_path) for chunk in chunks}
    wanted = {"camera", "camera/image", "camera/depth", "trajectory", "mesh"}
    assert {f"/world/{name}" for name in wanted} <= entities
    assert {"/tracking/inliers", "/tracking/ate_rmse_m", "/status"} <= entities
    found = {}
    for chunk in chunks:
        if str(chunk.entity_path) == "/world/camera" and not chunk.is_static:
            table = chunk.to_record_batch().to_pydict()
            name = next(name for name in table if name.endswith("translation"))
            for frame, translation in zip(table["frame"], table[name], strict=True):
                found[frame] = translation[0]
    assert sorted(found) == list(range(5))
    for frame, translation in found.items():
        expected = true_pose(frame)[:3, 3] + [0.01 * (frame % 2), 0, 0]
        np.testing.assert_allclose(translation, expected, atol=1e-5)


def test_without_rerun(faked, monkeypatch, tmp_path, capsys):
    """A line that says what to install, before anything is computed."""
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert main(["demo", "--record", str(tmp_path / "a.rrd"), "-o", str(tmp_path / "run")]) == 2
    assert "pip install rerun-sdk" in capsys.readouterr().err and not (tmp_path / "run").exists()


def test_a_file_that_can_not_be_written(tmp_path):
    """It is said before the run."""
    pytest.importorskip("rerun")
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="choose another file"):
        RerunRecording(tmp_path / "file" / "a.rrd")
