"""Run folders to report on, made by the pipeline around a SLAM object that answers at once."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.fakes import FakeSequence, FakeSlam, run_sequence, wall
from warpslam.config import Config
from warpslam.pipeline import results
from warpslam.pipeline import run as pipeline
from warpslam.report import pictures as images
from warpslam.runs.folder import RunFolder
from warpslam.runs.request import Source
from warpslam.storage.json_files import read_json, write_json

LEVELS = {
    level: {"spacing_m": spacing, "shape": [4, 5, 6], "bytes": 4 * 5 * 6 * 128}
    for level, spacing in (("coarse", 2.0), ("middle", 0.32), ("fine", 0.16), ("color", 0.16))
}


@pytest.fixture
def make_run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., RunFolder]:
    """Make a run folder: ``make_run("name", sequence, slam attributes)``, with the figures that only a real map has."""

    for plot in ("plot_top_view", "plot_error", "plot_panels"):
        monkeypatch.setattr(results, plot, lambda *arguments: None)
    monkeypatch.setattr(images, "SUPERSAMPLING", 1)

    def make(name: str = "run", sequence: FakeSequence | None = None, **behaviour: Any) -> RunFolder:
        slam = type("Slam", (FakeSlam,), behaviour)
        monkeypatch.setattr(pipeline, "build_slam", lambda camera, config, device, seed, method, timing: slam(camera))
        source = Source("somewhere", command="warpslam run somewhere --seed 0")
        sequence = sequence or FakeSequence(8)
        try:
            result = run_sequence(sequence, Config(), tmp_path / name, source=source, truth_mesh=wall())
        except RuntimeError:
            return RunFolder(tmp_path / name)
        if result.metrics.frames.processed > 4:
            metrics = read_json(result.folder.metrics)
            metrics |= {"levels": LEVELS, "observed_volume_m3": 12.5, "bounds_m": [[0, 0, 0], [4, 3, 2.5]]}
            metrics["keyframes"] = {"frames": [0, 2, 4], "overlaps": [[0, 1, 0.8], [1, 2, 0.3], [0, 2, 0.1]]}
            write_json(result.folder.metrics, metrics)
        return result.folder

    return make
