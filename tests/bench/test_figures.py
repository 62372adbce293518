"""Figures of a run folder, against values worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from warpslam.bench.figures import gap_figures, read_figures
from warpslam.errors import DatasetError
from warpslam.runs.folder import RunFolder
from warpslam.storage.json_files import write_json
from warpslam.storage.tum import write_tum


def test_units(tmp_path):
    """Centimetres, percent, MB, thousands and milliseconds; the first frame does not count in times."""
    folder = RunFolder(tmp_path)
    write_json(
        folder.metrics,
        {
            "ate_m": {"aligned": {"rmse": 0.012}},
            "reconstruction": {"accuracy_m": 0.02, "completion_ratio_5cm": 0.5},
            "map": {"bytes": 2_500_000, "flops_per_point": None},
        },
    )
    seconds = [{"tracking": 9.0, "mapping": 9.0}, {"tracking": 0.1}, {"tracking": 0.3, "mapping": 0.7}]
    frames = [{"index": index, **of_frame} for index, of_frame in enumerate(seconds)]
    write_json(folder.timing, {"frames": frames})
    assert read_figures(folder) == pytest.approx(
        {"ate": 1.2, "accuracy": 2.0, "ratio": 50.0, "memory": 2.5, "tracking": 200.0, "mapping": 700.0}
    )


def gap_run(folder: RunFolder, statuses: list[str], offset: float) -> RunFolder:
    """A camera along x, 1 m and 1 s a frame; the estimate is turned and, from frame 8 on, ``offset`` off."""
    count = len(statuses)
    truth = np.tile(np.eye(4), (count, 1, 1))
    truth[:, 0, 3] = np.arange(count)
    estimate = truth.copy()
    estimate[8:, 1, 3] += offset
    turn = np.eye(4)
    turn[:2, :2] = [[0, -1], [1, 0]]
    write_tum(folder.ground_truth, np.arange(count), truth)
    write_tum(folder.trajectory, np.arange(count), turn @ estimate)
    lines = ["frame,timestamp,status", *(f"{n},{n},{status}" for n, status in enumerate(statuses))]
    folder.frames.write_text("\n".join(lines) + "\n")
    return folder


def test_error_after_a_gap(tmp_path):
    """Frames 3 to 7 are skipped; the poses before them place the trajectory, those after are 0.2 m off."""
    statuses = ["OK"] * 3 + ["SKIPPED"] * 5 + ["LOST", "OK", "OK", "OK"]
    figures = gap_figures(gap_run(RunFolder(tmp_path), statuses, 0.2))
    assert figures == pytest.approx({"after_gap": 20.0, "lost_after_gap": 25.0})


def test_a_run_without_a_gap(tmp_path):
    """Nothing is measured where no gap stands out."""
    with pytest.raises(DatasetError, match="no gap"):
        gap_figures(gap_run(RunFolder(tmp_path), ["OK"] * 12, 0.2))
