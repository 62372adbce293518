"""Sections on how a run went: time, memory, frames, settings, versions."""

from __future__ import annotations

import numpy as np

from warpslam.frames import FrameStatus
from warpslam.report import charts
from warpslam.report.data import RunData
from warpslam.report.page import Html, element, figures, join, legend, missing, section, table
from warpslam.report.text import cubic_metres, duration, megabytes, percent
from warpslam.runs.record import UNREADABLE
from warpslam.runs.timing import PhaseTime

MAX_LISTED = 100


def timing_section(run: RunData) -> Html:
    """Where the time went."""
    title = "Timing"
    shares = stage_seconds(run)
    if not shares:
        return section("timing", title, missing("The run did not record its timing."))
    total = sum(seconds for _, seconds in shares)
    keys = {name: f"c{n % 6}" if n < 6 else "rest" for n, (name, _) in enumerate(shares)}
    parts = [(keys[name], f"{name}: {duration(s)}, {percent(s / total)}", s) for name, s in shares]
    phases = run.timing.phases
    rows = []
    for name, seconds in shares:
        phase = phases.get(name, PhaseTime())
        each = duration(phase.mean_seconds) or ""
        calls = "" if phase.calls is None else str(phase.calls)
        label = element("span", element("i", class_=f"swatch {keys[name]}"), name)
        rows.append([label, duration(seconds) or "", percent(seconds / total), calls, each])
    content: list[Html] = [
        charts.share_bar("Share of each stage", parts),
        table(("", "time", "share", "calls", "each"), rows, "numbers"),
    ]
    records = [frame.seconds for frame in run.timing.frames]
    names = [name for name in phases if any(name in record for record in records)]
    if records and names:
        columns = [
            (keys.get(name, "rest"), name, np.array([record.get(name, 0.0) for record in records])) for name in names
        ]
        chart = charts.stacked_bars(
            "Seconds a frame", [frame.index for frame in run.timing.frames], columns,
            x_label="frame", y_label="time [s]",
        )  # fmt: skip
        entries = legend(*((key, name) for key, name, _ in columns))
        content.append(element("figure", chart, entries, element("figcaption", "Time of each frame, by phase.")))
    return section("timing", title, content)


def stage_seconds(run: RunData) -> list[tuple[str, float]]:
    """Name and time [s] of each part of a run, the longest first; together they make up its total."""
    stages = {name: seconds for name, seconds in run.timing.stages_seconds.items() if seconds is not None}
    phases = {name: phase.seconds for name, phase in run.timing.phases.items()}
    total = stages.pop("total", 0.0)
    compile_seconds = stages.get("kernel_compile", 0.0)
    # "frames" holds reading and the phases, "setup" the compiling, "finish" its own phases.
    in_frames = stages.pop("frames", 0.0)
    parts = {name.replace("_", " "): s for name, s in stages.items() if not name.startswith("finish_")}
    if "setup" in parts:
        parts["setup"] = max(0.0, parts["setup"] - compile_seconds)
    rest = max(0.0, in_frames - stages.get("reading", 0.0) - sum(phases.values()))
    parts.update(phases)
    known = sum(parts.values()) + rest
    parts["other"] = rest + max(0.0, total - known)
    return sorted(((name, s) for name, s in parts.items() if s > 0.0005), key=lambda part: -part[1])


def memory_section(run: RunData) -> Html:
    """What the map takes, and what it has seen."""
    title = "Map and memory"
    metrics, levels = run.metrics, run.metrics.levels
    bytes_ = metrics.map.bytes or sum(level.bytes for level in levels.values()) or None
    bounds, peak = metrics.bounds_m, metrics.peak_memory_mib
    extent = (
        " × ".join(f"{(high or 0) - (low or 0):.1f}" for low, high in zip(*bounds, strict=True)) if bounds else None
    )
    facts: list[tuple[str, str | None, str]] = [
        ("Map", megabytes(bytes_), "features of all levels"),
        ("Observed", cubic_metres(metrics.observed_volume_m3), "crossed by depth rays of mapped frames"),
        ("Extent", f"{extent} m" if extent else None, "box of the grids"),
        ("Peak memory", megabytes(peak * 2**20) if peak else None, "of the process"),
    ]
    content = [figures(facts)]
    if levels:
        largest = max(level.bytes for level in levels.values())
        rows = [
            [
                name,
                "–" if level.spacing_m is None else f"{level.spacing_m:g} m",
                " × ".join(str(n) for n in level.shape),
                megabytes(level.bytes) or "",
                charts.value_bar(level.bytes, largest, "c0"),
            ]
            for name, level in levels.items()
        ]
        content.append(table(("level", "spacing", "vertices", "features", ""), rows, "numbers bars"))
    else:
        content.append(missing("The run did not record its levels: it has no feature grids, or stopped too early."))
    return section("memory", title, content)


def frames_section(run: RunData) -> Html:
    """What became of the frames, and why some are not OK."""
    title = "Frames"
    found = run.metrics.found_timing.text if run.metrics.has("found_timing") else None
    names = run.metrics.frames.by_status
    if not names:
        return section("frames", title, missing("No frame was processed."))
    content: list[Html] = [
        charts.share_bar("Frames by status", [(name, f"{count} {name}", count) for name, count in names]),
        legend(*((name, f"{count} {name}") for name, count in names)),
    ]
    if found:
        content.append(element("p", f"The camera's timing was estimated: {found}."))
    record = run.record
    bad = [
        (n, str(result.status), result.message or "–") for n, result in record.frames if result.status != FrameStatus.OK
    ]
    bad += [(frame.index, UNREADABLE, frame.message) for frame in record.left_out]
    rows = [[str(index), status, message] for index, status, message in sorted(bad)]
    if rows:
        content.append(table(("frame", "status", "why"), rows[:MAX_LISTED], "reasons"))
        if len(rows) > MAX_LISTED:
            rest = f"{len(rows) - MAX_LISTED} more are in {run.folder.frame_records.name}."
            content.append(element("p", rest, class_="missing"))
    elif not record.frames:
        content.append(missing("The run did not record why frames were lost or skipped."))
    else:
        content.append(element("p", "Every frame was tracked."))
    return section("frames", title, content)


def settings_section(run: RunData) -> Html:
    """The settings in effect, and how to repeat the run."""
    title = "Settings"
    command = run.source.command if run.source is not None else None
    if command:
        repeat = join(element("p", "This command repeats the run:"), element("pre", element("code", command)))
    else:
        repeat = missing("The run was started by a program, so there is no command to repeat it; see the settings.")
    place = None
    if run.source is not None:
        place = element(
            "p", "Input: ", element("code", "built-in demo sequence" if run.source.is_demo else str(run.source.path))
        )
    if run.config is None:
        return section("settings", title, repeat, place, missing("The run did not write its settings."))
    fold = element("details", element("summary", "Effective settings"), element("pre", element("code", run.config)))
    return section("settings", title, repeat, place, fold)


def versions_section(run: RunData) -> Html:
    """Software and machine."""
    title = "Versions"
    metrics = run.metrics
    rows = [[name, version or "not installed"] for name, version in metrics.versions.items()]
    if not rows and metrics.warpslam:
        rows.append(["warpslam", metrics.warpslam])
    machine = (("platform", metrics.platform), ("processors", metrics.processors), ("Warp device", metrics.device))
    rows += [[label, str(value)] for label, value in machine if value is not None]
    if not rows:
        return section("versions", title, missing("The run did not record versions."))
    return section("versions", title, table(("", ""), rows, "versions"))
