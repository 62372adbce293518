"""A run, or several side by side, as one HTML file that needs nothing else."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from warpslam.report.comparison import write_comparison as write_comparison
from warpslam.report.data import RunData as RunData
from warpslam.report.page import write_page
from warpslam.report.sections import run_page

if TYPE_CHECKING:
    from warpslam.runs.folder import RunFolder


def write_report(folder: RunFolder, output: str | Path | None = None) -> Path:
    """Write the report of a run.

    Args:
        folder: Run, finished or not; what is missing is said in its place.
        output: File to write; None for ``report.html`` in the run folder.

    Raises:
        DatasetError: A file of the run is damaged.
        ConfigError: The report can't be written there.
    """
    path = Path(output) if output is not None else folder.report
    return write_page(run_page(RunData.gather(folder), path.parent), path)
