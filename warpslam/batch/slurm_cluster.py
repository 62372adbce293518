"""The jobs of a batch under Slurm, one job of an array a sequence, by submitit.

Sequences and the output folder have to be reachable under the same paths on every machine (a shared file system). A job
whose time is up, or that is pre-empted, is queued again and goes on from its last checkpoint.
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from warpslam.batch.jobs import Job, check_jobs
from warpslam.batch.status import CRASHED, INTERRUPTED, RUNNING, WAITING, BatchState, JobStatus, Update, ended_status
from warpslam.batch.status import initial_status as _initial_status
from warpslam.errors import ConfigError, DatasetError, MissingDependencyError
from warpslam.storage.json_files import read_json, write_json

SLURM = "slurm"
"""What ``--cluster`` takes for it, alone or with a partition: "slurm:gpu"."""
NEWS_FILE = "news.json"
_CORES = 8  # more than that a run does not use
_MINUTES = 24 * 60  # after which Slurm ends a job, which is queued again
_POLL_SECONDS = 1.0
_NEWS_SECONDS = 2.0
_MEMORY_GB = 16.0


def run_on_slurm(
    jobs: Sequence[Job],
    output: str | Path,
    *,
    address: str = SLURM,
    workers: int | None = None,
    memory_gb: float | None = None,
    on_update: Update | None = None,
    backend: str = "slurm",
) -> list[JobStatus]:
    """Run jobs as an array of Slurm, and wait for them; ctrl-C cancels those that are not done.

    Args:
        jobs: The jobs; see `warpslam.batch.with_free_names`.
        output: Folder that gets a folder for each job, on a file system that all machines share.
        address: "slurm", or "slurm:PARTITION". A GPU is asked for where a job names a device "cuda...".
        workers: Sequences at a time; by default as many as Slurm lets run.
        memory_gb: A worker that takes more memory than this [GB] is stopped; that is also what Slurm is asked for.
        on_update: Called on every news of a job.
        backend: Of submitit: "slurm", or "local" for processes of this machine.

    Returns:
        How each job ended, in the order of ``jobs``.

    Raises:
        MissingDependencyError: submitit is not installed.
        ConfigError: A setting can't work, or there is no Slurm here.
    """
    try:
        import submitit
    except ImportError as error:
        raise MissingDependencyError(
            "--cluster slurm needs the package submitit; type: pip install submitit"
        ) from error
    if workers is not None and workers < 1:
        raise ConfigError(f"workers = {workers} must be at least 1")
    check_jobs(jobs)
    output, on_update = Path(output).resolve(), on_update or (lambda status: None)
    try:
        executor = submitit.AutoExecutor(folder=output / "slurm", cluster=backend)
    except RuntimeError as error:
        raise ConfigError(f"--cluster {address}: no Slurm here ({error}); type it where sbatch can be typed") from error
    on_gpu = any((job.request.device or "").startswith("cuda") for job in jobs)
    options: dict[str, Any] = {
        "name": "warpslam", "timeout_min": _MINUTES, "cpus_per_task": _CORES, "mem_gb": memory_gb or _MEMORY_GB,
        "gpus_per_node": 1 if on_gpu else 0,
    }  # fmt: skip
    partition = address.partition(":")[2]
    if partition:
        options["slurm_partition"] = partition
    if workers is not None:
        options["slurm_array_parallelism"] = workers
    executor.update_parameters(**options)
    statuses = {job.name: _initial_status(job, output) for job in jobs}
    for status in statuses.values():
        on_update(status)
    waiting = [job for job in jobs if statuses[job.name].status == WAITING]
    with executor.batch():
        running = {
            job.name: (job, executor.submit(_Task(job.to_dict(), str(output), memory_gb)), time.monotonic())
            for job in waiting
        }
    return _watch(running, statuses, output, on_update)


class _Task:
    """What a machine of the cluster runs."""

    def __init__(self, job: dict[str, Any], output: str, memory_gb: float | None) -> None:
        self.job, self.output, self.memory_gb = job, output, memory_gb

    def __call__(self) -> str:
        # Slurm tells how many cores are this job's; set before Warp is loaded.
        cores = os.environ.get("SLURM_CPUS_PER_TASK")
        if cores:
            os.environ.setdefault("WARPSLAM_THREADS", cores)
        from warpslam.batch.worker import execute

        path = Path(self.output) / self.job["name"] / NEWS_FILE
        news: dict[str, Any] = {"status": RUNNING}
        written = -_NEWS_SECONDS

        def report(fields: dict[str, Any]) -> None:
            nonlocal written
            news.update({key: value for key, value in fields.items() if key != "compiled"})
            if time.monotonic() - written >= _NEWS_SECONDS:
                written = time.monotonic()
                path.parent.mkdir(parents=True, exist_ok=True)
                write_json(path, news)

        return execute(Job.from_dict(self.job), Path(self.output), report, self.memory_gb)

    def checkpoint(self) -> Any:
        """Called by submitit before Slurm ends the job: queue it again, to go on from the last checkpoint."""
        import submitit

        return submitit.helpers.DelayedSubmission(_Task(self.job, self.output, self.memory_gb))


def _watch(
    running: dict[str, tuple[Job, Any, float]], statuses: dict[str, JobStatus], output: Path, on_update: Update
) -> list[JobStatus]:
    try:
        while running:
            time.sleep(_POLL_SECONDS)
            for name in list(running):
                job, task, start = running[name]
                if task.done():
                    del running[name]
                    _collect(job, task, output, time.monotonic() - start)
                    statuses[name] = ended_status(job, output, statuses[name])
                else:
                    statuses[name] = _with_news(statuses[name], output / name / NEWS_FILE)
                on_update(statuses[name])
    except KeyboardInterrupt:
        for name, (_, task, _) in running.items():
            task.cancel()
            statuses[name] = replace(statuses[name], status=INTERRUPTED)
            on_update(statuses[name])
    for name in statuses:
        (output / name / NEWS_FILE).unlink(missing_ok=True)
    return list(statuses.values())


def _collect(job: Job, task: Any, output: Path, seconds: float) -> None:
    """Where the process ended without a word of its own, write what Slurm says."""
    error = task.exception()
    if error is not None:
        message = " ".join(str(error).split())[:300]
        BatchState.of(job, output).write(settings=job.settings_hash, status=CRASHED, message=message, seconds=seconds)


def _with_news(status: JobStatus, path: Path) -> JobStatus:
    try:
        return replace(status, **read_json(path))
    except (DatasetError, TypeError):  # none yet
        return status
