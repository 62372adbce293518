"""Files of a bench: bench.json, bench.md, a table and a plot a study."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from warpslam import __version__
from warpslam.bench.plots import plot_study
from warpslam.bench.results import Bench, Row, StudyResult, to_dict
from warpslam.bench.studies import Metric
from warpslam.runs.metrics import RunMetrics
from warpslam.storage.json_files import write_json

PAPER = "paper"
"""What marks the rows of published figures."""


def write_tables(bench: Bench) -> None:
    """Write all files but the page.

    Raises:
        OSError: One can't be written.
    """
    facts = bench_facts(bench)
    write_json(
        bench.folder / "bench.json",
        {**facts, "studies": [to_dict(result) for result in bench.results]},
    )
    for result in bench.results:
        write_csv(bench.folder / f"{result.study.name}.csv", result)
        plot_study(plot_path(bench.folder, result), result)
    (bench.folder / "bench.md").write_text(_markdown(bench, facts), encoding="utf-8")


def plot_path(folder: Path, result: StudyResult) -> Path:
    """Where the plot of a study is."""
    return folder / f"{result.study.name}.png"


def bench_facts(bench: Bench) -> dict[str, Any]:
    """How the bench was made: suite, command, devices, platforms, versions, and how its runs ended."""
    found: dict[str, set[str]] = {"device": set(), "platform": set(), "processors": set()}
    versions: dict[str, set[str]] = {}
    for job in bench.jobs:
        file = bench.run_folder(job.name).metrics
        metrics = RunMetrics.read(file) if file.is_file() else RunMetrics()
        for name, values in found.items():
            value = getattr(metrics, name)
            values.update([] if value is None else [str(value)])
        for package, version in metrics.versions.items():
            versions.setdefault(package, set()).update([version] if version else [])
    statuses = [status.status for status in bench.statuses]
    spec = bench.suite.spec
    return {
        "warpslam": __version__,
        "suite": bench.suite.name,
        "suite_source": bench.suite.source,
        "description": spec.description,
        "command": bench.command,
        "seeds": sorted({job.request.seed for job in bench.jobs}),
        "devices": sorted(found["device"]),
        "platforms": sorted(found["platform"]),
        "processors": sorted(found["processors"]),
        "versions": {package: ", ".join(sorted(values)) for package, values in sorted(versions.items()) if values},
        "runs": {status: statuses.count(status) for status in dict.fromkeys(statuses)},
        "spec": spec.model_dump(exclude_defaults=True),
    }


def header(result: StudyResult) -> list[str]:
    """Names of the columns of `table_rows`."""
    protocol = ["protocol"] if _has_protocol(result) else []
    return ["sequence", "variant", *(metric.heading for metric in result.metrics), *protocol, "runs", "lost frames"]


def table_rows(result: StudyResult) -> list[list[str]]:
    """Cells of all rows as text; published figures follow the row that they stand beside."""
    lines = []
    for row in result.rows:
        protocol = [row.protocol or "–"] if _has_protocol(result) else []
        cells = [row.cell(metric) for metric in result.metrics]
        lines.append([row.sequence, row.variant.name, *cells, *protocol, row.finished, row.lost])
        if row.published:
            cells = [_published(row, metric) for metric in result.metrics]
            protocol = ["as in the paper"] if protocol else []
            lines.append([row.sequence, f"{row.variant.name} ({PAPER})", *cells, *protocol, "", ""])
    return lines


def write_csv(path: Path, result: StudyResult) -> None:
    """A line a sequence and variant: mean, standard deviation and number of values of each figure, and the paper's."""
    columns = ["sequence", "variant", "protocol", "runs", "finished", "lost_frames", "frames"]
    for metric in result.study.metrics:
        columns += [f"{metric.heading} {part}" for part in ("mean", "std", "values", PAPER)]
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        for row in result.rows:
            done = [outcome for outcome in row.outcomes if outcome.is_finished]
            cells: list[Any] = [row.sequence, row.variant.name, row.protocol or "", len(row.outcomes), len(done)]
            cells += [sum(outcome.lost for outcome in done), sum(outcome.frames for outcome in done)]
            for metric in result.study.metrics:
                summary = row.summary(metric)
                paper = row.published.get(metric.key, "")
                cells += [_cell(summary.mean), _cell(summary.std), len(summary.values), paper]
            writer.writerow(cells)


def trouble(rows: Sequence[Row]) -> list[str]:
    """A line a run that failed or has no figure."""
    return [
        f"{row.sequence}, {row.variant.name}, seed {outcome.seed}: "
        + (outcome.message if outcome.is_finished else f"{outcome.status}. {outcome.message}").strip()
        for row in rows
        for outcome in row.outcomes
        if outcome.message or not outcome.is_finished
    ]


def how_to_read(result: StudyResult) -> str:
    """What the numbers of a table are."""
    text = "Mean ± standard deviation over seeds" if any(len(row.outcomes) > 1 for row in result.rows) else "One seed"
    protocols = _protocols(result)
    if len(protocols) == 1:
        text += f"; surfaces are compared under the culling protocol {protocols[0]}"
    if any(row.published for row in result.rows):
        text += f"; rows marked ({PAPER}) are what the paper prints for the same data"
    return f"{text}."


def made_with(facts: dict[str, Any]) -> list[tuple[str, str]]:
    """The facts of `bench_facts` as pairs of text."""
    pairs = [
        ("command", facts["command"] or "started by a program"),
        ("suite", f"{facts['suite']} ({facts['suite_source']})"),
        ("seeds", ", ".join(map(str, facts["seeds"]))),
        ("device", ", ".join(facts["devices"]) or "unknown"),
        ("platform", ", ".join(facts["platforms"]) or "unknown"),
        ("processors", ", ".join(facts["processors"]) or "unknown"),
        ("versions", ", ".join(f"{package} {version}" for package, version in facts["versions"].items())),
        ("runs", ", ".join(f"{count} {status}" for status, count in facts["runs"].items())),
    ]
    return [(name, text) for name, text in pairs if text]


def _markdown(bench: Bench, facts: dict[str, Any]) -> str:
    lines = [f"# Bench {bench.suite.name}", "", facts["description"].strip(), ""]
    lines += [f"- {name}: {f'`{text}`' if name == 'command' else text}" for name, text in made_with(facts)]
    for result in bench.results:
        study = result.study
        lines += ["", f"## {study.title} ({study.source})", "", study.text, how_to_read(result), ""]
        head = header(result)
        lines += [_line(head), _line(["---"] * 2 + ["---:"] * (len(head) - 2))]
        lines += [_line(cells) for cells in table_rows(result)]
        directions = [f"- {direction.text}: {direction.verdict}" for direction in result.directions()]
        lines += ["", "Expected directions:", "", *directions] if directions else []
        problems = [f"- {line}" for line in trouble(result.rows)]
        lines += ["", "Runs that failed, or lack a figure:", "", *problems] if problems else []
        lines += ["", f"![{study.title}]({plot_path(bench.folder, result).name})"]
    return "\n".join(lines) + "\n"


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in cells) + " |"


def _protocols(result: StudyResult) -> list[str]:
    return sorted({row.protocol for row in result.rows if row.protocol})


def _has_protocol(result: StudyResult) -> bool:
    """Whether a column has to say which protocol a row's figures hold under; one for all stands above the table."""
    return len(_protocols(result)) > 1


def _published(row: Row, metric: Metric) -> str:
    value = row.published.get(metric.key)
    return "–" if value is None else str(value)


def _cell(value: float | None) -> str:
    return "" if value is None else f"{value:.6g}"
