"""Run a suite: render what is missing, run the jobs, measure the probes, and write what came of it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from warpslam.batch.local import run_batch
from warpslam.batch.status import FINISHED, INTERRUPTED, SKIPPED, JobStatus, Update
from warpslam.bench.figures import gap_figures, read_figures
from warpslam.bench.jobs import Entry, expand, render_missing, unique_jobs
from warpslam.bench.page import write_bench_page
from warpslam.bench.results import RUNS, Bench, Outcome, Row, StudyResult, published_row
from warpslam.bench.suite import Suite
from warpslam.bench.tables import write_tables
from warpslam.errors import WarpSlamError
from warpslam.runs.folder import RunFolder
from warpslam.runs.metrics import RunMetrics
from warpslam.storage.writing import output_error

Say = Callable[[str], None]


def run_bench(
    suite: Suite,
    output: str | Path,
    *,
    studies: Iterable[str] | None = None,
    workers: int = 1,
    memory_gb: float | None = None,
    command: str | None = None,
    on_update: Update | None = None,
    say: Say | None = None,
) -> Bench:
    """Run the jobs that are not done yet, and write tables, plots and the page of all.

    Args:
        suite: See `warpslam.bench.suite.read_suite`.
        output: Folder of the bench; one that was used before goes on.
        studies: Names of the studies to make; all of the suite by default.
        workers: Runs at a time.
        memory_gb: A worker that takes more memory than this [GB] is stopped.
        command: Command line, for the record.
        on_update: Called on every news of a run.
        say: Called with a line on what is done besides the runs.

    Raises:
        ConfigError: A study is not part of the suite, or a setting can't work.
        OutputError: The folder can't be written to.
    """
    output, say = Path(output), say or (lambda text: None)
    entries = expand(suite, output, None if studies is None else list(studies))
    jobs = unique_jobs(entries)
    try:
        (output / RUNS).mkdir(parents=True, exist_ok=True)
        for folder in render_missing(suite, output, entries):
            say(f"rendered {folder}")
        statuses = run_batch(jobs, output / RUNS, workers=workers, memory_gb=memory_gb, on_update=on_update)
        by_run = {status.name: status for status in statuses}
        # After ctrl-C nothing new is begun; what there is is written.
        may_probe = not any(status.status == INTERRUPTED for status in statuses)
        results = _results(suite, output, entries, by_run, say if may_probe else None)
        bench = Bench(suite, output, command, tuple(jobs), tuple(statuses), results)
        write_tables(bench)
        write_bench_page(bench)
    except OSError as error:
        raise output_error(error, output) from error
    return bench


def _results(
    suite: Suite, output: Path, entries: Sequence[Entry], statuses: dict[str, JobStatus], say: Say | None
) -> tuple[StudyResult, ...]:
    groups: dict[Any, dict[tuple[str, str], list[Entry]]] = {}
    for entry in entries:
        rows = groups.setdefault(entry.study.name, {})
        rows.setdefault((entry.sequence, entry.variant.name), []).append(entry)
    results = []
    for rows in groups.values():
        study = next(iter(rows.values()))[0].study
        made = []
        for (sequence, _), seeds in rows.items():
            variant = seeds[0].variant
            published = published_row(suite.spec.sequences[sequence].published, study.name, variant.name)
            outcomes = tuple(_outcome(entry, output, statuses[entry.job.name], say) for entry in seeds)
            made.append(Row(sequence, variant, outcomes, published))
        results.append(StudyResult(study, tuple(made)))
    return tuple(results)


def _outcome(entry: Entry, output: Path, status: JobStatus, say: Say | None) -> Outcome:
    study, job = entry.study, entry.job
    if status.status not in (FINISHED, SKIPPED):
        return Outcome(job.name, entry.seed, status.status, status.message)
    messages: list[str] = []
    figures: dict[str, float] = {}
    curve, protocol = None, None
    folder = RunFolder(output / RUNS / job.name)
    try:
        figures = read_figures(folder)
        surface = RunMetrics.read(folder.metrics).reconstruction
        if study.needs_truth_mesh:
            protocol = surface.protocol
            messages += [f"no reconstruction figures: {surface.error}"] if surface.error is not None else []
    except WarpSlamError as error:
        messages.append(str(error))
    try:
        if "after_gap" in {metric.key for metric in study.metrics}:
            figures |= gap_figures(folder)
        if study.probe is not None and say is not None:
            # Loads Warp and torch, which no bench without probes needs in this process.
            from warpslam.bench.probes import measure

            say(f"{study.name}: {study.probe} of {entry.sequence}, {entry.variant.name}, seed {entry.seed}")
            probed = measure(study.probe, job, output)
            figures |= probed["figures"]
            curve = probed.get("curve")
    except WarpSlamError as error:
        messages.append(str(error))
    shown = {metric.key: figures[metric.key] for metric in study.metrics if metric.key in figures}
    return Outcome(
        job.name, entry.seed, FINISHED, "; ".join(messages), status.lost, status.total, shown, protocol, curve
    )
