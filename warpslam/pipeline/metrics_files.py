"""The account of a run, whatever ended it: metrics.json, timing.json and the tables of its frames."""

from __future__ import annotations

import csv
import math
import os
import platform
from collections import defaultdict
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from warpslam import __version__
from warpslam.camera import SensorTiming
from warpslam.frames import FrameStatus
from warpslam.runs.record import UNREADABLE, RunRecord
from warpslam.runtime.environment import package_versions, peak_memory_mib
from warpslam.storage.atomic import replacing
from warpslam.storage.json_files import write_json

if TYPE_CHECKING:
    from warpslam.runs.folder import RunFolder
    from warpslam.runtime.compilation import ModuleProgress
    from warpslam.sequences.base import RgbdSequence

_DIGITS = (4, 5, 4, 6, 6)  # of inliers, depth error, correlation and the two deviations in frames.csv


def figures_of_every_run(record: RunRecord, selected_count: int, modules: Sequence[ModuleProgress]) -> dict[str, Any]:
    """Fields of metrics.json that follow from the record, and those about the machine and the software."""
    seconds = {stage: record.seconds[stage] for stage in ("total", "kernel_compile", "frames")}
    return {
        "warpslam": __version__,
        "frames": {"selected": selected_count, **record.counts},
        "unusable_frames": unusable_frames(record),
        "seconds": {
            "total": seconds["total"],
            "kernel_compile": seconds["kernel_compile"],
            "run": seconds["total"] - seconds["kernel_compile"],
            "frames": seconds["frames"],
        },
        "compiled_kernels": sorted(module.name for module in modules if module.compiled),
        "fps": len(record.results) / seconds["frames"] if seconds["frames"] > 0 else None,
        "peak_memory_mib": peak_memory_mib(),
        "versions": {"warpslam": __version__, "python": platform.python_version(), **package_versions()},
        "platform": platform.platform(),
        "processors": os.cpu_count(),
    }


def unusable_frames(record: RunRecord) -> list[dict[str, Any]]:
    """Frames that were left out or skipped, and why, in their order."""
    frames = [{"frame": f.index, "status": UNREADABLE, "reason": f.message} for f in record.left_out]
    for index, result in record.frames:
        if result.status == FrameStatus.SKIPPED:
            frames.append({"frame": index, "status": FrameStatus.SKIPPED, "reason": result.message})
    return sorted(frames, key=lambda frame: frame["frame"])


def found_timing(record: RunRecord, sequence: RgbdSequence) -> dict[str, float] | None:
    """Field ``found_timing`` of metrics.json; None where the camera's timing was not estimated."""
    if record.found_timing is None:
        return None
    frame, found = record.found_timing
    stored = sequence.stored_timing(SensorTiming(found["depth_delay"], found["readout"]))
    rounded = {name: round(seconds, 4) for name, seconds in vars(stored).items()}
    return {**found, **rounded, "after_frame": frame}


def write_timing(folder: RunFolder, record: RunRecord, modules: Sequence[ModuleProgress]) -> None:
    """Seconds by phase, stage, kernel module and frame."""
    phases: dict[str, list[float]] = defaultdict(list)
    for result in record.results:
        for phase, seconds in result.timings.items():
            phases[phase].append(seconds)
    write_json(
        folder.timing,
        {
            "phases": {
                phase: {"seconds": sum(times), "calls": len(times), "mean_seconds": sum(times) / len(times)}
                for phase, times in phases.items()
            },
            "stages_seconds": dict(record.seconds),
            "kernel_modules": {
                module.name: {"seconds": module.seconds, "compiled": module.compiled} for module in modules
            },
            "frames": [{"index": index, **result.timings} for index, result in record.frames],
        },
    )


def write_frames(folder: RunFolder, record: RunRecord) -> None:
    """What became of each frame: all of it for the report, and a table of it."""
    write_json(folder.frame_records, record.to_rows())
    with (
        replacing(folder.frames) as partial,
        open(partial, "w", newline="", encoding="utf-8", errors="backslashreplace") as file,
    ):
        writer = csv.writer(file, lineterminator="\n")
        columns = ["inliers", "depth_error_m", "correlation", "sigma_m", "sigma_deg"]
        writer.writerow(["frame", "timestamp", "status", *columns, "message"])
        for index, result in record.frames:
            correlation = math.nan if result.correlation is None else result.correlation
            measured = zip((result.inliers, result.depth_error, correlation, *result.sigma), _DIGITS, strict=True)
            figures = ["" if math.isnan(value) else f"{value:.{digits}f}" for value, digits in measured]
            writer.writerow([index, f"{result.timestamp:.6f}", result.status, *figures, result.message])
