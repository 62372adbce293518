"""What a batch came to: summary.csv and summary.html in its folder."""

from __future__ import annotations

import csv
import statistics
from collections.abc import Callable, Sequence
from pathlib import Path

from warpslam.batch.status import FINISHED, SKIPPED, JobStatus
from warpslam.report.page import Html, element, join, void
from warpslam.runs.folder import RunFolder

COLUMNS = ("sequence", "status", "frames", "lost", "ATE RMSE [cm]", "frames/s", "time [s]", "memory [MiB]", "message")
"""Of the table on a terminal."""
_RESULTS = ("surface < 5 cm [%]", "PSNR [dB]")
_FILE_COLUMNS = (*COLUMNS[:5], *_RESULTS, *COLUMNS[5:])
_NUMBERS = range(2, len(_FILE_COLUMNS) - 1)
_MESSAGE_LENGTH = 200
_STYLE = """
body { font: 15px/1.4 system-ui, sans-serif; margin: 2em; color: #222 }
table { border-collapse: collapse }
th, td { padding: .35em .8em; text-align: left; border-bottom: 1px solid #ddd; vertical-align: top }
tr.mean td { border-top: 2px solid #888; font-style: italic }
td.number { text-align: right; font-variant-numeric: tabular-nums }
tr.bad td:nth-child(2) { color: #b00020; font-weight: 600 }
"""


def cells(status: JobStatus) -> tuple[str, ...]:
    """A row as text, in the order of `COLUMNS`; empty where there is no figure."""
    notes = [f"{status.attempt} attempts"] if status.attempt > 1 else []
    if status.resumed_after:
        notes.append(f"resumed after {status.resumed_after} frames")
    return (
        status.name,
        status.status + (f" ({', '.join(notes)})" if notes else ""),
        f"{status.done}/{status.total}" if status.total else "",
        str(status.lost) if status.total else "",
        _figure(None if status.ate_rmse is None else 100 * status.ate_rmse, 2),
        _figure(status.fps, 2),
        _figure(status.seconds, 1),
        _figure(status.peak_memory_mib, 0),
        first_line(status.message),
    )


def file_cells(status: JobStatus) -> tuple[str, ...]:
    """A row of the files."""
    short = cells(status)
    surface = None if status.completion_ratio is None else 100 * status.completion_ratio
    return (*short[:5], _figure(surface, 2), _figure(status.psnr_db, 2), *short[5:])


def mean_cells(statuses: Sequence[JobStatus]) -> tuple[str, ...] | None:
    """The row of means over the sequences that are done, each over those that have the figure; None below two."""
    done = [status for status in statuses if is_good(status)]
    if len(done) < 2:
        return None

    def mean(value: Callable[[JobStatus], float | None], digits: int, scale: float = 1.0) -> str:
        known = [found for status in done if (found := value(status)) is not None]
        text = _figure(scale * statistics.fmean(known) if known else None, digits)
        return text + (f" ({len(known)} of {len(done)})" if 0 < len(known) < len(done) else "")

    return (
        f"mean of {len(done)}",
        "",
        "",
        mean(lambda status: float(status.lost), 1),
        mean(lambda status: status.ate_rmse, 2, 100.0),
        mean(lambda status: status.completion_ratio, 2, 100.0),
        mean(lambda status: status.psnr_db, 2),
        mean(lambda status: status.fps, 2),
        mean(lambda status: status.seconds, 1),
        mean(lambda status: status.peak_memory_mib, 0),
        "",
    )


def first_line(message: str) -> str:
    """What fits into a table; all of it is in the state file of the job."""
    line = message.split("\n")[0]
    return line if len(line) <= _MESSAGE_LENGTH else line[: _MESSAGE_LENGTH - 3] + "..."


def write_summary(statuses: Sequence[JobStatus], output: Path) -> tuple[Path, Path]:
    """Write both files; returns their paths."""
    csv_path, html_path = output / "summary.csv", output / "summary.html"
    with open(csv_path, "w", newline="", encoding="utf-8", errors="backslashreplace") as file:
        writer = csv.writer(file)
        writer.writerow(_FILE_COLUMNS)
        writer.writerows(file_cells(status) for status in statuses)
        if (means := mean_cells(statuses)) is not None:
            writer.writerow(means)
    html_path.write_text(_html(statuses, output), encoding="utf-8", errors="backslashreplace")
    return csv_path, html_path


def is_good(status: JobStatus) -> bool:
    """Whether the job has its results, from now or before."""
    return status.status in (FINISHED, SKIPPED)


def _figure(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def _row(texts: Sequence[str]) -> list[Html]:
    return [element("td", text, class_="number" if column in _NUMBERS else None) for column, text in enumerate(texts)]


def _html(statuses: Sequence[JobStatus], output: Path) -> str:
    rows = []
    for status in statuses:
        folder = RunFolder(output / status.name)
        files = ((folder.top_view, "path"), (folder.panels, "views"), (folder.mesh, "mesh"))
        links = [
            join(element("a", text, href=f"{status.name}/{file.name}"), " ") for file, text in files if file.is_file()
        ]
        rows.append(
            element("tr", _row(file_cells(status)), element("td", links), class_="good" if is_good(status) else "bad")
        )
    if (means := mean_cells(statuses)) is not None:
        rows.append(element("tr", _row(means), element("td", ""), class_="mean"))
    good = sum(map(is_good, statuses))
    page = element(
        "html",
        void("meta", charset="utf-8"),
        element("title", output.name),
        element("style", Html(_STYLE)),
        element("h1", f"{output.name}: {good} of {len(statuses)} sequences done"),
        element("table", element("tr", [element("th", column) for column in (*_FILE_COLUMNS, "files")]), rows),
        lang="en",
    )
    return f"<!doctype html>\n{page}\n"
