"""``warpslam report``."""

from __future__ import annotations

import argparse
from typing import Any

from warpslam.cli.common import add_command, quiet_warp, warnings_on_stderr
from warpslam.cli.progress import working
from warpslam.pipeline.finished import complete
from warpslam.report import write_comparison, write_report
from warpslam.runs.folder import RunFolder


def add(commands: Any) -> None:
    """Add the command."""
    report = add_command(commands, "report", _report, "HTML report of a run, or a comparison of several")
    report.add_argument("runs", nargs="+", metavar="RUN", help="run folder; several make a comparison")
    report.add_argument(
        "-o", "--output", metavar="FILE", help="HTML file (default: RUN/report.html; comparison.html for several)"
    )


def _report(options: argparse.Namespace) -> int:
    quiet_warp()
    folders = [RunFolder.open(run) for run in options.runs]
    with warnings_on_stderr():
        for folder in folders:
            with working("making what is missing"):
                made = complete(folder)
            for name in made:
                print(f"{folder.path}: {name} was missing and is made")
    if len(folders) == 1:
        with working("drawing the report"):
            path = write_report(folders[0], options.output)
    else:
        with working("drawing the comparison"):
            path = write_comparison(options.output or "comparison.html", folders)
    print(path)
    return 0
