"""Many sequences: what is to be done, what has been done, and worker processes that do it on one machine.

Every sequence has a folder of its own with the results of its run and a small state file. Running the same batch again
skips what is finished with the same settings and does the rest; a sequence that was begun goes on from its last
checkpoint, or starts again where its method has none. `warpslam.batch.ray_cluster` runs the same jobs on Ray.
"""

from __future__ import annotations

import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from warpslam.batch.jobs import Job, check_jobs
from warpslam.batch.status import (
    CRASHED,
    ENDED,
    INTERRUPTED,
    RUNNING,
    WAITING,
    BatchState,
    JobStatus,
    Update,
    ended_status,
    initial_status,
)
from warpslam.errors import ConfigError
from warpslam.runtime.cores import process_cores

WORKER_LOG = "worker.log"
WORKER_COMMAND = (sys.executable, "-m", "warpslam.batch.worker")
_POLL_SECONDS = 0.2


def run_batch(
    jobs: Sequence[Job],
    output: str | Path,
    *,
    workers: int = 1,
    memory_gb: float | None = None,
    on_update: Update | None = None,
) -> list[JobStatus]:
    """Run jobs in worker processes, each on its share of this machine's cores.

    Args:
        jobs: The jobs; see `with_free_names`.
        output: Folder that gets a folder for each job.
        workers: Processes at a time.
        memory_gb: A worker that takes more memory than this [GB] is stopped.
        on_update: Called on every news of a job, in the calling thread.

    Returns:
        How each job ended, in the order of ``jobs``. After ctrl-C workers write what they have and are "interrupted".

    Raises:
        ConfigError: A setting can't work.
    """
    if workers < 1:
        raise ConfigError(f"workers = {workers} must be at least 1")
    if memory_gb is not None and not memory_gb > 0:
        raise ConfigError(f"memory_gb = {memory_gb} must be positive")
    check_jobs(jobs)
    return _Coordinator(jobs, Path(output), workers, memory_gb, on_update or (lambda status: None)).run()


def split_cores(workers: int) -> list[list[int]]:
    """Cores of each worker: equal shares of those that this process may use, and the same ones by turns if there are
    more workers than cores.
    """
    cores = process_cores()
    if workers > len(cores):
        return [[cores[slot % len(cores)]] for slot in range(workers)]
    bounds = [len(cores) * slot // workers for slot in range(workers + 1)]
    return [cores[start:stop] for start, stop in zip(bounds[:-1], bounds[1:], strict=True)]


@dataclass
class _Worker:
    job: Job
    process: subprocess.Popen[str]
    reader: threading.Thread
    start: float


class _Coordinator:
    """Keeps workers busy, and turns what they say and how they end into `JobStatus`."""

    def __init__(
        self, jobs: Sequence[Job], output: Path, workers: int, memory_gb: float | None, on_update: Update
    ) -> None:
        self.output, self.memory_gb, self.on_update = output, memory_gb, on_update
        self.statuses = {job.name: initial_status(job, output) for job in jobs}
        self.waiting = [job for job in jobs if self.statuses[job.name].status == WAITING]
        self.cores = split_cores(min(workers, max(len(self.waiting), 1)))
        self.slots: list[_Worker | None] = [None] * len(self.cores)
        self.news: queue.Queue[tuple[str, dict[str, Any]]] = queue.Queue()
        # Compiling once is enough: the others start when the first worker has all kernels.
        self.is_compiled = False

    def run(self) -> list[JobStatus]:
        for status in self.statuses.values():
            self.on_update(status)
        try:
            while self.waiting or any(self.slots):
                self._start_workers()
                self._take_news(_POLL_SECONDS)
                self._collect()
        except KeyboardInterrupt:
            self._interrupt()
        return list(self.statuses.values())

    def _start_workers(self) -> None:
        for slot, worker in enumerate(self.slots):
            if worker is None and self.waiting and (self.is_compiled or not any(self.slots)):
                self.slots[slot] = self._start(self.waiting.pop(0), slot)

    def _start(self, job: Job, slot: int) -> _Worker:
        folder = self.output / job.name
        folder.mkdir(parents=True, exist_ok=True)
        order = {
            "job": job.to_dict(), "output": str(self.output), "slot": slot, "cores": self.cores[slot],
            "memory_gb": self.memory_gb,
        }  # fmt: skip
        environment = {**os.environ, "OMP_NUM_THREADS": str(len(self.cores[slot]))}
        # The package as this process has it, wherever it was started from.
        root = str(Path(__file__).resolve().parents[2])
        environment["PYTHONPATH"] = os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH")]))
        with open(folder / WORKER_LOG, "w", encoding="utf-8") as log_file:
            process = subprocess.Popen(
                WORKER_COMMAND,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log_file,
                env=environment,
                text=True,
                # Ctrl-C reaches this process only, which passes it on once.
                start_new_session=True,
            )
        assert process.stdin is not None
        try:
            process.stdin.write(json.dumps(order))
            process.stdin.close()
        except OSError:  # died at once: how is told when it is collected
            pass
        reader = threading.Thread(target=self._read, args=(job.name, process), daemon=True)
        reader.start()
        self._update(job.name, status=RUNNING)
        return _Worker(job, process, reader, time.monotonic())

    def _read(self, name: str, process: subprocess.Popen[str]) -> None:
        """In a thread: lines of JSON that the worker prints."""
        assert process.stdout is not None
        for line in process.stdout:
            try:
                news = json.loads(line)
            except ValueError:  # a library that prints
                continue
            if isinstance(news, dict):
                self.news.put((name, news))

    def _take_news(self, timeout: float) -> None:
        try:
            name, news = self.news.get(timeout=timeout)
            while True:
                self.is_compiled |= bool(news.pop("compiled", False))
                if news:
                    self._update(name, **news)
                name, news = self.news.get_nowait()
        except queue.Empty:
            return

    def _collect(self) -> None:
        for slot, worker in enumerate(self.slots):
            if worker is None or worker.process.poll() is None:
                continue
            worker.reader.join(timeout=5)
            self._take_news(0.001)
            self.slots[slot] = None
            state = BatchState.of(worker.job, self.output)
            if state.fields.get("status") not in ENDED:
                # It never came to write how it ended, or only why it ended at once.
                end = _end_of(worker.process.returncode, state.path.with_name(WORKER_LOG))
                message = state.fields.get("message") or end
                status = state.fields.get("ending", CRASHED)
                seconds = time.monotonic() - worker.start
                state.write(settings=worker.job.settings_hash, status=status, message=message, seconds=seconds)
            self.statuses[worker.job.name] = ended_status(worker.job, self.output, self.statuses[worker.job.name])
            self.on_update(self.statuses[worker.job.name])

    def _interrupt(self) -> None:
        """Let workers write what they have; a second ctrl-C or SIGTERM ends them."""
        try:
            self._signal(signal.SIGINT)
            while any(self.slots):
                self._take_news(_POLL_SECONDS)
                self._collect()
        except KeyboardInterrupt:
            self._signal(signal.SIGKILL if hasattr(signal, "SIGKILL") else signal.SIGTERM)
            for worker in filter(None, self.slots):
                worker.process.wait()
            self._collect()
        for name, status in self.statuses.items():
            if status.status == WAITING:
                self._update(name, status=INTERRUPTED, message="not started")

    def _signal(self, number: int) -> None:
        for worker in filter(None, self.slots):
            if worker.process.poll() is None:
                worker.process.send_signal(number)

    def _update(self, name: str, **fields: Any) -> None:
        self.statuses[name] = replace(self.statuses[name], **fields)
        self.on_update(self.statuses[name])


def _end_of(return_code: int, log_file: Path) -> str:
    """Why a worker is gone, from its exit code and the last line it wrote."""
    if return_code < 0:
        try:
            name = signal.Signals(-return_code).name
        except ValueError:
            name = f"signal {-return_code}"
        hint = " (the kernel kills so when memory runs out)" if name == "SIGKILL" else ""
        return f"the worker was ended by {name}{hint}"
    try:
        lines = log_file.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    except OSError:
        lines = []
    return f"the worker ended with code {return_code}" + (f": {lines[-1]}" if lines else "")
