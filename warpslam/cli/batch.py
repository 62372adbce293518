"""``warpslam batch``."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from warpslam.batch import local
from warpslam.batch.jobs import Job, with_free_names
from warpslam.batch.manifest import read_manifest
from warpslam.batch.status import INTERRUPTED, RUNNING, WAITING, JobStatus
from warpslam.batch.summary import COLUMNS, cells, first_line, is_good, write_summary
from warpslam.cli.common import (
    EXIT_INTERRUPTED,
    add_command,
    add_config_option,
    add_format_options,
    add_log_option,
    add_method_option,
    add_run_options,
    parse_frames,
    read_config,
    slice_of,
)
from warpslam.report.text import duration
from warpslam.runs.request import RunRequest, Source
from warpslam.storage.writing import output_error

if TYPE_CHECKING:
    from collections.abc import Iterator

EXIT_UNFINISHED = 1
CHECKPOINT_EVERY = 50
_LINES_A_JOB = 10


def add(commands: Any) -> None:
    """Add the command."""
    batch = add_command(commands, "batch", _batch, "run many sequences, and go on where an earlier batch stopped")
    batch.add_argument("folders", nargs="*", metavar="FOLDER", help="folders of one sequence each")
    batch.add_argument("--manifest", metavar="FILE", help="yaml file with sequences and their settings")
    batch.add_argument("--workers", type=int, metavar="N", help="sequences at a time (1; on a cluster: what fits)")
    batch.add_argument("--memory-gb", type=float, metavar="GB", help="stop a worker that takes more memory than this")
    batch.add_argument("--cluster", metavar="ADDRESS", help="ray://HOST:10001 or local (Ray), slurm or slurm:PARTITION")
    add_log_option(batch)
    add_format_options(batch)
    batch.add_argument("--preset", help="settings to start from (default: each dataset's)")
    add_config_option(batch)
    batch.add_argument("--frames", type=parse_frames, metavar="A:B:STEP", help="frames to use")
    add_method_option(batch)
    batch.add_argument(
        "--checkpoint-every", type=int, default=CHECKPOINT_EVERY, metavar="N",
        help=f"frames between two checkpoints, from which an unfinished sequence goes on ({CHECKPOINT_EVERY}; 0: none)",
    )  # fmt: skip
    add_run_options(batch, output="folder of the batch, with a folder a sequence and the summary (default: batch)")


def _batch(options: argparse.Namespace) -> int:
    jobs = _jobs(options)
    output = Path(options.output or "batch")
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise output_error(error, output) from error
    with progress() as on_update:
        if options.cluster and options.cluster.partition(":")[0] == "slurm":
            from warpslam.batch.slurm_cluster import run_on_slurm

            statuses = run_on_slurm(
                jobs, output, address=options.cluster, workers=options.workers, memory_gb=options.memory_gb,
                on_update=on_update,
            )  # fmt: skip
        elif options.cluster:
            from warpslam.batch.ray_cluster import run_on_ray

            statuses = run_on_ray(
                jobs, output, address=options.cluster, workers=options.workers, memory_gb=options.memory_gb,
                on_update=on_update,
            )  # fmt: skip
        else:
            workers = 1 if options.workers is None else options.workers
            statuses = local.run_batch(jobs, output, workers=workers, memory_gb=options.memory_gb, on_update=on_update)
    paths = write_summary(statuses, output)
    _print_table(statuses)
    print(f"written to  {paths[0]}, {paths[1]}")
    if any(status.status == INTERRUPTED for status in statuses):
        return EXIT_INTERRUPTED
    return 0 if all(map(is_good, statuses)) else EXIT_UNFINISHED


def _jobs(options: argparse.Namespace) -> list[Job]:
    request = RunRequest(
        source=Source("", options.dataset, options.camera, topics=options.topics),
        frames=slice_of(options.frames),
        config=read_config(options),
        preset=options.preset,
        overrides=tuple(options.overrides),
        decoders=str(Path(options.decoders).resolve()) if options.decoders else None,
        device=options.device,
        seed=options.seed,
        method=options.method,
        checkpoint_every=options.checkpoint_every or None,
    )
    common = Job("", request)
    paths = [Path(os.path.abspath(Path(folder).expanduser())) for folder in options.folders]
    jobs = [
        Job(
            path.name,
            replace(request, source=Source(str(path), options.dataset, options.camera, topics=options.topics)),
        )
        for path in paths
    ]
    if options.manifest:
        jobs += read_manifest(options.manifest, common)
    log = _log_target(options.log)
    return [replace(job, log=log) for job in with_free_names(jobs)]


def _log_target(text: str | None) -> str:
    """The option's value, whose folder holds in any folder; refused here rather than by every worker."""
    if not text:
        return ""
    from warpslam.viewer.figures import FigureLog

    FigureLog(text)
    kind, _, place = text.partition(":")
    return f"{kind}:{Path(place).expanduser().resolve()}" if kind == "tensorboard" else text


@contextmanager
def progress() -> Iterator[Callable[[JobStatus], None]]:
    """A table that is kept up to date on a terminal, lines anywhere else."""
    if not sys.stdout.isatty():
        yield _Lines().show
        return
    from rich.console import Console
    from rich.live import Live

    known: dict[str, JobStatus] = {}
    # rich's own console goes by what standard output was when it was first asked for.
    with Live(_table([]), refresh_per_second=4, console=Console()) as live:

        def show(status: JobStatus) -> None:
            before = known.get(status.name)
            known[status.name] = status
            is_news = before is None or before.status != status.status  # shown at once, however short a job is
            live.update(_table(list(known.values())), refresh=is_news)

        yield show
        # The summary follows; the same table twice would only be read twice.
        live.update("")


class _Lines:
    """A line when a job changes its state, and about ten for its frames."""

    def __init__(self) -> None:
        self._last: dict[str, tuple[str, int]] = {}

    def show(self, status: JobStatus) -> None:
        """Print, if there is something new."""
        tenth = _LINES_A_JOB * status.done // status.total if status.total else 0
        if self._last.get(status.name) == (status.status, tenth):
            return
        self._last[status.name] = (status.status, tenth)
        parts = [f"{status.name}: {status.status}"]
        if status.total:
            parts.append(f"frame {status.done}/{status.total}")
        if status.fps is not None:
            parts.append(f"{status.fps:.2f} fps")
        if status.ate_rmse is not None:
            parts.append(f"ATE {100 * status.ate_rmse:.2f} cm")
        if status.message:
            parts.append(first_line(status.message))
        print("  ".join(parts), flush=True)


def _table(statuses: Sequence[JobStatus]) -> Any:
    from rich.table import Table
    from rich.text import Text

    table = Table()
    for number, column in enumerate(COLUMNS):
        table.add_column(column, justify="right" if 2 <= number <= 7 else "left", overflow="fold")
    for status in statuses:
        style = "" if status.status in (RUNNING, WAITING) else "green" if is_good(status) else "red"
        first, state, *rest = map(Text, cells(status))
        state.stylize(style)
        table.add_row(first, state, *rest)
    return table


def _print_table(statuses: Sequence[JobStatus]) -> None:
    from rich.console import Console

    # Where there is no terminal rich assumes 80 columns, which would fold every cell.
    Console(width=None if sys.stdout.isatty() else 160).print(_table(statuses))
    seconds = sum(status.seconds or 0.0 for status in statuses)
    print(f"{len(statuses)} sequences, {duration(seconds)} of work")
