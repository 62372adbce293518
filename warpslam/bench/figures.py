"""The figures of one run, from its folder, in the units in which studies show them."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np

from warpslam.errors import DatasetError
from warpslam.frames import FrameStatus
from warpslam.reading import read_text
from warpslam.runs.folder import RunFolder
from warpslam.runs.metrics import RunMetrics
from warpslam.runs.timing import RunTiming
from warpslam.storage.tum import read_tum

MIN_GAP = 5
"""A gap is at least this many times as long as the time between two frames usually is."""


def read_figures(folder: RunFolder) -> dict[str, float]:
    """What a finished run has of the figures of `warpslam.bench.studies.METRICS`, by their keys.

    Raises:
        DatasetError: A file is missing or damaged.
    """
    metrics, timing = RunMetrics.read(folder.metrics), RunTiming.read(folder.timing)
    surface = metrics.reconstruction
    figures = {
        "accuracy": _scaled(surface.accuracy_m, 100),
        "completion": _scaled(surface.completion_m, 100),
        "ratio": _scaled(surface.completion_ratio_5cm, 100),
        "depth_l1": _scaled(surface.depth_l1_m, 100),
        "memory": _scaled(metrics.map.bytes, 1e-6),
        "flops": _scaled(metrics.map.flops_per_point, 1e-3),
        "ate": _scaled(metrics.ate_m.aligned.rmse, 100),
        "tracking": _mean_milliseconds(timing, "tracking"),
        "mapping": _mean_milliseconds(timing, "mapping"),
    }
    return {key: value for key, value in figures.items() if value is not None}


def _scaled(value: float | None, factor: float) -> float | None:
    return None if value is None else factor * value


def _mean_milliseconds(timing: RunTiming, phase: str) -> float | None:
    """Of the frames that have the phase, the first frame left out: it is mapped far longer than others."""
    times = [frame.seconds[phase] for frame in timing.frames[1:] if phase in frame.seconds]
    return 1000 * float(np.mean(times)) if times else None


def gap_figures(folder: RunFolder) -> dict[str, float]:
    """Of the frames after the longest time without a usable frame: RMS error [cm] and share that is lost [%].

    The trajectory is put where its last tracked frame before the gap agrees with the truth. A lost frame counts with
    the pose it was given, that of the last tracked one.

    Raises:
        DatasetError: The run has no true poses, or no gap.
    """
    truth_file = folder.require(folder.ground_truth, "so its error after the gap is unknown")
    times, poses = read_tum(folder.trajectory)
    truth_times, truth = read_tum(truth_file)
    statuses = _statuses(folder.frames)
    if len(statuses) != len(times):
        raise DatasetError(f"{folder.frames}: has {len(statuses)} frames, and {folder.trajectory.name} {len(times)}")
    usable = np.flatnonzero(statuses != FrameStatus.SKIPPED)
    steps = np.diff(times[usable])
    if len(steps) < 2 or steps.max() < MIN_GAP * np.median(steps):
        raise DatasetError(f"{folder.path}: no gap: no time without a usable frame stands out")
    is_before = np.arange(len(usable)) <= int(np.argmax(steps))
    known = {round(time, 4): pose for time, pose in zip(truth_times, truth, strict=True)}
    true_pose = np.array([known.get(round(times[i], 4), np.full((4, 4), np.nan)) for i in usable])
    is_known = np.isfinite(true_pose).all(axis=(1, 2))
    reference = np.flatnonzero(is_before & is_known & (statuses[usable] == FrameStatus.OK))
    after = ~is_before & is_known
    if not len(reference) or not after.any():
        raise DatasetError(f"{folder.path}: no true pose is known of a frame before the gap and one after it")
    # What went wrong before the gap is not what this figure is about.
    T = true_pose[reference[-1]] @ np.linalg.inv(poses[usable[reference[-1]]])
    aligned = poses[usable][after][:, :3, 3] @ T[:3, :3].T + T[:3, 3]
    errors = np.linalg.norm(aligned - true_pose[after][:, :3, 3], axis=1)
    lost = statuses[usable][~is_before] == FrameStatus.LOST
    return {"after_gap": 100 * float(np.sqrt((errors**2).mean())), "lost_after_gap": 100 * float(lost.mean())}


def _statuses(path: Path) -> np.ndarray:
    try:
        return np.array([row["status"] for row in csv.DictReader(io.StringIO(read_text(path)))])
    except (OSError, KeyError, csv.Error) as error:
        raise DatasetError(f"{path}: can't be read as the table of a run's frames ({error}); run again") from error
