"""Figures for TensorBoard and Weights & Biases."""

from __future__ import annotations

import sys
from types import ModuleType

import numpy as np
import pytest

from tests.fakes import FakeSequence, FakeSlam, run_sequence
from warpslam.cli import main
from warpslam.config import Config
from warpslam.errors import ConfigError
from warpslam.pipeline import run as pipeline
from warpslam.viewer.figures import FigureLog


class Run:
    """Stands for a run of wandb."""

    def __init__(self, **about) -> None:
        self.about, self.logged, self.is_over = about, [], False

    def log(self, figures, step) -> None:
        assert not self.is_over
        self.logged.append((step, figures))

    def finish(self) -> None:
        self.is_over = True


@pytest.fixture
def faked(monkeypatch):
    """A SLAM object that answers at once, without plots."""
    monkeypatch.setattr(pipeline, "build_slam", lambda camera, *others: FakeSlam(camera))
    for name in ("draw_plots", "draw_panels", "write_report"):
        monkeypatch.setattr(pipeline, name, lambda *arguments: None)


def test_weights_and_biases(faked, monkeypatch, tmp_path):
    """A run of the project, with the figures of every frame and of the end; what was not measured is not there."""
    wandb = ModuleType("wandb")
    runs: list[Run] = []
    wandb.init = lambda **about: runs.append(Run(**about)) or runs[-1]
    monkeypatch.setitem(sys.modules, "wandb", wandb)
    log = FigureLog("wandb:rooms")
    run_sequence(FakeSequence(5), Config(), tmp_path / "run", observer=log)
    log.close()
    (run,) = runs
    assert run.about == {"project": "rooms", "name": "fake sequence"} and run.is_over
    assert [step for step, _ in run.logged] == [1, 2, 3, 4, 5, 5]
    figures = run.logged[2][1]
    assert figures["inliers"] == 0.9 and figures["loss/loss"] == 1.5 and figures["seconds/mapping"] == 0.5
    end = run.logged[-1][1]
    assert 0 < end["end/ate_rmse_m"] < 0.02 and "end/psnr_db" not in end
    assert all(np.isfinite(value) for _, figures in run.logged for value in figures.values())


def test_tensorboard(faked, tmp_path):
    """Its own reader finds the figures."""
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    log = FigureLog(f"tensorboard:{tmp_path}/board")
    run_sequence(FakeSequence(5), Config(), tmp_path / "run", observer=log)
    log.close()
    events = EventAccumulator(str(tmp_path / "board" / "fake sequence"))
    events.Reload()
    assert [event.step for event in events.Scalars("inliers")] == [1, 2, 3, 4, 5]
    assert events.Scalars("end/ate_rmse_m")[0].value > 0


def test_what_is_missing_or_wrong(monkeypatch, tmp_path, capsys):
    """Each in one line, before a run begins."""
    for module, package in (("torch.utils.tensorboard", "tensorboard"), ("wandb", "wandb")):
        monkeypatch.setitem(sys.modules, module, None)
        assert main(["demo", "--log", f"{package}:x", "-o", str(tmp_path / "run")]) == 2
        assert f"pip install {package}" in capsys.readouterr().err
    for target in ("paper:x", "wandb", "wandb:"):
        with pytest.raises(ConfigError, match="tensorboard:FOLDER or wandb:PROJECT"):
            FigureLog(target)
    assert not (tmp_path / "run").exists()
