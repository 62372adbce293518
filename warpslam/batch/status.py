"""What has become of the jobs of a batch, in memory and in batch.json."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from warpslam.batch.jobs import Job
from warpslam.errors import DatasetError
from warpslam.runs import record
from warpslam.runs.folder import RunFolder
from warpslam.runs.metrics import RunMetrics
from warpslam.storage.json_files import read_json, write_json

STATE_FILE = "batch.json"
FINISHED, FAILED, INTERRUPTED = record.FINISHED, record.FAILED, record.INTERRUPTED
MEMORY, CRASHED = "out of memory", "crashed"
RUNNING, WAITING, SKIPPED = "running", "waiting", "done before"
ENDED = (FINISHED, FAILED, MEMORY, INTERRUPTED, CRASHED, SKIPPED)


@dataclass(frozen=True)
class JobStatus:
    """Where a job stands."""

    name: str
    """Of the job."""

    status: str = WAITING
    """One of "waiting", "running", "done before", "finished", "failed", "out of memory", "interrupted" or "crashed"."""

    done: int = 0
    """Frames so far."""

    total: int = 0
    """Frames that were selected."""

    ate_rmse: float | None = None
    """So far, or of the end [m]."""

    fps: float | None = None
    """Frames a second."""

    seconds: float | None = None
    """Time it took."""

    lost: int = 0
    """Frames whose pose was not found."""

    peak_memory_mib: float | None = None
    """The most memory that the process has held [MiB]."""

    message: str = ""
    """Why it is not finished, or why it could not go on from its checkpoint."""

    attempt: int = 0
    """From 1; more than 1 if a worker was lost."""

    resumed_after: int = 0
    """Frames that were taken over from a checkpoint."""

    completion_ratio: float | None = None
    """Share of the true surface within 5 cm of the mesh, 0..1; where that surface is known."""

    psnr_db: float | None = None
    """Of the frames that are shown beside what the map renders [dB]."""


Update = Callable[[JobStatus], None]


@dataclass
class BatchState:
    """State file of one job: what it was started with and how it ended."""

    path: Path
    """The file."""

    fields: dict[str, Any] = field(default_factory=dict)
    """Its content."""

    @classmethod
    def of(cls, job: Job, output: Path) -> BatchState:
        """State of a job in the folder ``output`` of a batch; empty if it never ran or its file is damaged."""
        path = output / job.name / STATE_FILE
        try:
            return cls(path, read_json(path))
        except DatasetError:
            return cls(path)

    def write(self, **fields: Any) -> None:
        """Set fields and write the file."""
        self.fields.update(fields)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        write_json(self.path, self.fields)

    def is_finished(self, job: Job) -> bool:
        """Whether the job has been done with these settings and its results are there."""
        if self.fields.get("status") != FINISHED or self.fields.get("settings") != job.settings_hash:
            return False
        folder = RunFolder(self.path.parent)
        return folder.metrics.is_file() and folder.trajectory.is_file()


def initial_status(job: Job, output: Path) -> JobStatus:
    """Waiting, or done before, then with the figures."""
    if not BatchState.of(job, output).is_finished(job):
        return JobStatus(job.name)
    return replace(ended_status(job, output, JobStatus(job.name)), status=SKIPPED)


def ended_status(job: Job, output: Path, known: JobStatus) -> JobStatus:
    """How a job ended, from its state file and the metrics of its run."""
    fields = BatchState.of(job, output).fields
    status = replace(
        known, status=fields.get("status", CRASHED), message=fields.get("message", ""), seconds=fields.get("seconds"),
        attempt=fields.get("attempt", 0),
    )  # fmt: skip
    try:
        metrics = RunMetrics.read(RunFolder(output / job.name).metrics)
    except DatasetError:  # it came to nothing
        return status
    frames = metrics.frames
    return replace(
        status,
        done=(frames.processed or 0) + (frames.unreadable or 0),
        total=frames.selected or 0,
        ate_rmse=metrics.ate_m.aligned.rmse,
        fps=metrics.fps,
        lost=frames.LOST or 0,
        peak_memory_mib=metrics.peak_memory_mib,
        resumed_after=metrics.resumed_after or 0,
        completion_ratio=metrics.reconstruction.completion_ratio_5cm,
        psnr_db=metrics.rendering.psnr_db,
    )
