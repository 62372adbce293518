"""What has become of the jobs of a batch, in memory and in batch.json."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from warpslam.batch.jobs import Job
from warpslam.errors import DatasetError
from warpslam.runs.folder import RunFolder
from warpslam.storage.json_files import read_json, write_json

STATE_FILE = "batch.json"
FINISHED, FAILED, MEMORY, INTERRUPTED, CRASHED = "finished", "failed", "out of memory", "interrupted", "crashed"
RUNNING, WAITING, SKIPPED = "running", "waiting", "done before"
ENDED = (FINISHED, FAILED, MEMORY, INTERRUPTED, CRASHED, SKIPPED)


@dataclass(frozen=True)
class JobStatus:
    """Where a job stands.

    status: "waiting", "running", "done before", "finished", "failed", "out of memory", "interrupted" or "crashed".
    done, total: Frames. ate_rmse: So far, or of the end [m]. fps: Frames a second. seconds: Time it took.
    message: Why it is not finished, or why it could not go on from its checkpoint. attempt: From 1; more than 1 if a
    worker was lost. resumed_after: Frames that were taken over from a checkpoint.
    """

    name: str
    status: str = WAITING
    done: int = 0
    total: int = 0
    ate_rmse: float | None = None
    fps: float | None = None
    seconds: float | None = None
    lost: int = 0
    peak_memory_mib: float | None = None
    message: str = ""
    attempt: int = 0
    resumed_after: int = 0


Update = Callable[[JobStatus], None]


@dataclass
class BatchState:
    """State file of one job: what it was started with and how it ended."""

    path: Path
    fields: dict[str, Any] = field(default_factory=dict)

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
        metrics = read_json(RunFolder(output / job.name).metrics)
    except DatasetError:  # it came to nothing
        return status
    frames = metrics.get("frames", {})
    return replace(
        status,
        done=frames.get("processed", 0) + frames.get("unreadable", 0),
        total=frames.get("selected", 0),
        ate_rmse=metrics.get("ate_m", {}).get("aligned", {}).get("rmse"),
        fps=metrics.get("fps"),
        lost=frames.get("LOST", 0),
        peak_memory_mib=metrics.get("peak_memory_mib"),
        resumed_after=metrics.get("resumed_after", 0),
    )
