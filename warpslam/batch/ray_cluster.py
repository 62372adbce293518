"""The jobs of a batch on a Ray cluster, one task a sequence; Ray is the optional extra ``warpslam[cluster]``.

Sequences and the output folder have to be reachable under the same paths on every machine (a shared file system). A
task whose worker or machine is lost is started again elsewhere, where it goes on from its last checkpoint.
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from warpslam.batch.jobs import Job, check_jobs
from warpslam.batch.status import (
    CRASHED,
    INTERRUPTED,
    RUNNING,
    WAITING,
    BatchState,
    JobStatus,
    Update,
    ended_status,
    initial_status,
)
from warpslam.errors import ConfigError, MissingDependencyError
from warpslam.runtime.cores import process_cores

RETRIES = 3
"""How often a sequence is started again after its worker was lost."""
_POLL_SECONDS = 0.5
_MAX_CORES = 8  # more than that a run does not use


def run_on_ray(
    jobs: Sequence[Job],
    output: str | Path,
    *,
    address: str = "local",
    workers: int | None = None,
    memory_gb: float | None = None,
    on_update: Update | None = None,
) -> list[JobStatus]:
    """Run jobs on a Ray cluster.

    Args:
        jobs: The jobs; see `warpslam.batch.with_free_names`.
        output: Folder that gets a folder for each job, on a file system that all machines share.
        address: "local" for a cluster of this machine alone, else what `ray.init` takes, such as "ray://host:10001".
        workers: Sequences at a time, over all machines; one a GPU, or one for every eight cores, by default.
        memory_gb: A worker that takes more memory than this [GB] is stopped; machines are chosen that have it.
        on_update: Called on every news of a job.

    Returns:
        How each job ended, in the order of ``jobs``.

    Raises:
        MissingDependencyError: Ray is not installed.
        ConfigError: A setting can't work, or there is no cluster at ``address``.
    """
    if address == "local":
        # A cluster of this machine alone listens to this machine alone, unless the environment says otherwise: it is by
        # this variable, read when Ray is imported, that Ray tells the two apart.
        os.environ.setdefault("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")
    try:
        import ray
    except ImportError as error:
        raise MissingDependencyError("--cluster needs the package ray; type: pip install 'ray>=2.59'") from error
    if workers is not None and workers < 1:
        raise ConfigError(f"workers = {workers} must be at least 1")
    check_jobs(jobs)
    was_running = ray.is_initialized()
    if not was_running:
        _connect(ray, address)
    try:
        return _Tasks(ray, jobs, Path(output).resolve(), workers, memory_gb, on_update or (lambda status: None)).run()
    finally:
        if not was_running:
            ray.shutdown()


def _connect(ray: Any, address: str) -> None:
    options: dict[str, Any] = {"log_to_driver": False, "logging_level": "warning"}
    if address == "local":
        options |= {"address": "local", "num_cpus": len(process_cores()), "include_dashboard": False}
    else:
        options["address"] = address
    try:
        ray.init(**options)
    except Exception as error:  # Ray lets those of its transport through
        raise ConfigError(f"cluster {address}: can't connect ({error}); is Ray running there?") from error


def _task(job: dict[str, Any], output: str, memory_gb: float | None, threads: int, news: Any) -> str:
    """Runs on a worker."""
    # Ray counts cores and leaves it to the task to use no more of them; set before Warp is loaded.
    os.environ["WARPSLAM_THREADS"] = str(threads)
    from warpslam.batch.worker import execute

    name = job["name"]

    def report(fields: dict[str, Any]) -> None:
        fields = {key: value for key, value in fields.items() if key != "compiled"}
        if fields:
            news.put.remote(name, fields)

    report({"status": RUNNING})
    # Ray shows a task the GPUs that are its own, so the first one is the right one.
    return execute(Job.from_dict(job), Path(output), report, memory_gb)


class _News:
    """Actor that keeps the latest news of every job until the driver asks."""

    def __init__(self) -> None:
        self.fields: dict[str, dict[str, Any]] = {}

    def put(self, name: str, fields: dict[str, Any]) -> None:
        self.fields.setdefault(name, {}).update(fields)

    def take(self) -> dict[str, dict[str, Any]]:
        fields, self.fields = self.fields, {}
        return fields


class _Tasks:
    """Submits all jobs at once, and lets Ray decide where and when each one runs."""

    def __init__(
        self,
        ray: Any,
        jobs: Sequence[Job],
        output: Path,
        workers: int | None,
        memory_gb: float | None,
        on_update: Update,
    ) -> None:
        self.ray, self.jobs, self.output, self.memory_gb, self.on_update = ray, jobs, output, memory_gb, on_update
        self.statuses = {job.name: initial_status(job, output) for job in jobs}
        self.resources = share_of_cluster(
            ray.cluster_resources(), [node["Resources"] for node in ray.nodes() if node["Alive"]], workers
        )

    def run(self) -> list[JobStatus]:
        ray = self.ray
        for status in self.statuses.values():
            self.on_update(status)
        news = ray.remote(num_cpus=0)(_News).remote()
        options: dict[str, Any] = {**self.resources, "max_calls": 1, "max_retries": RETRIES}
        if self.memory_gb is not None:
            options["memory"] = int(self.memory_gb * 1e9)
        # One process a task (max_calls), so that a run leaves nothing behind for the next one.
        task = ray.remote(**options)(_task)
        threads = max(1, int(self.resources["num_cpus"]))
        waiting = [job for job in self.jobs if self.statuses[job.name].status == WAITING]
        running = {
            task.remote(job.to_dict(), str(self.output), self.memory_gb, threads, news): (job, time.monotonic())
            for job in waiting
        }
        try:
            while running:
                done, _ = ray.wait(list(running), timeout=_POLL_SECONDS)
                for name, fields in ray.get(news.take.remote()).items():
                    self._update(name, **fields)
                for reference in done:
                    self._collect(reference, *running.pop(reference))
        except KeyboardInterrupt:
            self._interrupt(running)
        return list(self.statuses.values())

    def _collect(self, reference: Any, job: Job, start: float) -> None:
        try:
            self.ray.get(reference)
        except self.ray.exceptions.RayError as error:
            # The worker was lost once too often, or could not even start.
            message = " ".join(str(error).split())[:300]
            seconds = time.monotonic() - start
            BatchState.of(job, self.output).write(
                settings=job.settings_hash, status=CRASHED, message=message, seconds=seconds
            )
        self.statuses[job.name] = ended_status(job, self.output, self.statuses[job.name])
        self.on_update(self.statuses[job.name])

    def _interrupt(self, running: dict[Any, tuple[Job, float]]) -> None:
        """Cancelling raises KeyboardInterrupt in the tasks, which then write what they have."""
        for reference in running:
            self.ray.cancel(reference, force=False)
        done, _ = self.ray.wait(list(running), num_returns=len(running), timeout=60)
        for reference, (job, _) in running.items():
            state = BatchState.of(job, self.output).fields
            if reference in done and state.get("settings") == job.settings_hash:
                self.statuses[job.name] = ended_status(job, self.output, self.statuses[job.name])
            self._update(job.name, status=INTERRUPTED)

    def _update(self, name: str, **fields: Any) -> None:
        self.statuses[name] = replace(self.statuses[name], **fields)
        self.on_update(self.statuses[name])


def share_of_cluster(
    total: dict[str, float], nodes: Sequence[dict[str, float]], workers: int | None
) -> dict[str, float]:
    """``num_cpus`` and ``num_gpus`` of a task, such that ``workers`` of them share the cluster.

    Args:
        total: Resources of the cluster, by Ray's names.
        nodes: Resources of each machine; a task has to fit on one of them.
        workers: Tasks at a time; None for one a GPU, or one for every eight cores.

    Raises:
        ConfigError: The cluster has no cores.
    """
    cores, gpus = total.get("CPU", 0.0), total.get("GPU", 0.0)
    largest = max((node.get("CPU", 0.0) for node in nodes), default=0.0)
    if largest < 1:
        raise ConfigError("the cluster offers no CPU cores; start its machines with ray start --num-cpus")
    if workers is None:
        workers = int(gpus) or max(1, int(cores // _MAX_CORES))
    share = {"num_cpus": float(max(1, int(min(cores / workers, largest, _MAX_CORES)))), "num_gpus": 0.0}
    if gpus:
        # Ray takes whole GPUs or parts of one.
        share["num_gpus"] = 1.0 if gpus >= workers else max(0.01, int(100 * gpus / workers) / 100)
    return share
