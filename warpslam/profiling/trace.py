"""A profile as a trace: every launch, with its dimensions, on its thread, inside its phase, for Perfetto or
chrome://tracing.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from warpslam.profiling.records import GPU, Recording

_SHOWN = {"wait": "wait for slices", "load": "load"}


def write_trace(recording: Recording, path: Path) -> None:
    """Write the complete events ("X") of a recording, times in microseconds from its beginning.

    On CUDA kernels follow one another from where their phase began: their durations are measured, their starts are not.
    """
    rows = {thread: row for row, thread in enumerate(sorted(recording.threads, key=lambda t: _order(recording, t)))}
    events: list[dict[str, Any]] = [
        {"name": "thread_name", "ph": "M", "pid": 1, "tid": row, "args": {"name": recording.threads[thread]}}
        for thread, row in rows.items()
    ]

    def add(name: str, category: str, thread: int, start: float, seconds: float, **arguments: Any) -> None:
        event = {"name": name, "cat": category, "ph": "X", "pid": 1, "tid": rows[thread]}
        event |= {"ts": round(1e6 * (start - recording.start), 3), "dur": round(1e6 * seconds, 3)}
        events.append(event | ({"args": arguments} if arguments else {}))

    for span in recording.spans:
        add(span.path.rpartition(" / ")[2], "phase", span.thread, span.start, span.stop - span.start)
    for launch in recording.launches:
        arguments: dict[str, Any] = {"phase": launch.path}
        if launch.dim:
            arguments["dim"] = list(launch.dim)
        if launch.work.points is not None:
            arguments["points"] = launch.work.points
        add(launch.kernel, "kernel", launch.thread, launch.start, launch.stop - launch.start, **arguments)
    for interval in recording.intervals:
        if interval.what in _SHOWN:
            name = f"{_SHOWN[interval.what]} {interval.name}".strip()
            add(name, interval.what, interval.thread, interval.start, interval.seconds)
    events.sort(key=lambda event: (event["ph"] == "X", event.get("ts", 0.0), -event.get("dur", 0.0)))
    with path.open("w", encoding="utf-8") as file:
        json.dump({"traceEvents": events, "displayTimeUnit": "ms"}, file, separators=(",", ":"))


def _order(recording: Recording, thread: int) -> tuple[bool, bool, str, int]:
    """The main thread first, the GPU last."""
    name = recording.threads[thread]
    return thread == GPU, name != "MainThread", name, thread
