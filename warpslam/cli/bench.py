"""``warpslam bench``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from warpslam.batch.status import BatchState
from warpslam.bench.jobs import Entry, expand, unique_jobs
from warpslam.bench.results import RUNS
from warpslam.bench.runner import run_bench
from warpslam.bench.suite import read_suite
from warpslam.cli.batch import EXIT_UNFINISHED, progress
from warpslam.cli.common import add_command, quiet_warp
from warpslam.cli.exit_codes import EXIT_INTERRUPTED


def add(commands: Any) -> None:
    """Add the command."""
    bench = add_command(commands, "bench", _bench, "the paper's studies on your sequences: tables, plots and a page")
    bench.add_argument("suite", metavar="SUITE", help="yaml file, or the name of a suite that comes along: quick")
    bench.add_argument("-o", "--output", metavar="DIR", help="folder of the bench (default: bench/NAME)")
    bench.add_argument("--studies", metavar="A,B", help="only these studies of the suite")
    bench.add_argument(
        "--data", action="append", default=[], metavar="DIR",
        help="where the suite's paths are looked for; may be repeated (default: the folder of the suite)",
    )  # fmt: skip
    bench.add_argument("--workers", type=int, default=1, metavar="N", help="runs at a time (1)")
    bench.add_argument("--memory-gb", type=float, metavar="GB", help="stop a worker that takes more memory than this")
    bench.add_argument("--list", action="store_true", help="say what would be run, and run nothing")


def _bench(options: argparse.Namespace) -> int:
    suite = read_suite(options.suite, *options.data)
    output = Path(options.output or Path("bench") / suite.name)
    studies = [name.strip() for name in options.studies.split(",")] if options.studies else None
    if options.list:
        _print_list(expand(suite, output, studies), output)
        return 0
    quiet_warp()
    with progress() as on_update:
        bench = run_bench(
            suite, output, studies=studies, workers=options.workers, memory_gb=options.memory_gb,
            command=options.command_line, on_update=on_update, say=lambda text: print(text, flush=True),
        )  # fmt: skip
    for result in bench.results:
        print(f"{result.study.title} ({result.study.source})")
        for direction in result.directions():
            print(f"  {direction.text}: {direction.verdict}")
    print(f"written to  {bench.folder / 'report.html'}, {bench.folder / 'bench.md'}")
    if bench.is_interrupted:
        return EXIT_INTERRUPTED
    return 0 if bench.is_complete else EXIT_UNFINISHED


def _print_list(entries: list[Entry], output: Path) -> None:
    seeds: dict[tuple[str, str, str], list[str]] = {}
    for entry in entries:
        seeds.setdefault((entry.study.name, entry.sequence, entry.variant.name), []).append(str(entry.seed))
    for (study, sequence, variant), numbers in seeds.items():
        print(f"{study:28} {sequence:18} {variant:20} seeds {', '.join(numbers)}")
    jobs = unique_jobs(entries)
    done = sum(BatchState.of(job, output / RUNS).is_finished(job) for job in jobs)
    print(f"{len(jobs)} runs for {len(entries)} entries of the tables, {done} of them done")
