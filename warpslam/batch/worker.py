"""One job of a batch, in the process that carries it out: a worker of `warpslam.batch` or a task on Ray."""

from __future__ import annotations

import json
import logging
import os
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from warpslam.batch.jobs import Job
from warpslam.batch.status import FAILED, INTERRUPTED, MEMORY, RUNNING, BatchState
from warpslam.errors import MemoryBudgetError, WarpSlamError
from warpslam.pipeline.methods import has_checkpoints
from warpslam.pipeline.observer import Observer, Observers
from warpslam.runs.folder import RunFolder
from warpslam.runtime.environment import resident_bytes
from warpslam.runtime.stopping import terminable

if TYPE_CHECKING:
    from warpslam.runs.record import Progress
    from warpslam.runtime.compilation import ModuleProgress

log = logging.getLogger(__name__)
HARD_FACTOR = 1.25
"""A worker this far beyond its budget is not asked any more."""
_WATCH_SECONDS = 0.2
_EXIT_MEMORY = 77
Report = Callable[[dict[str, Any]], None]


def main() -> None:
    """Entry of a worker process: the order is JSON on standard input, news are lines of JSON on standard output."""
    order = json.load(sys.stdin)
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, order["cores"])
    # Where cores can't be pinned the count has to do; who set it before knows better.
    os.environ.setdefault("WARPSLAM_THREADS", str(len(order["cores"])))
    handler = logging.StreamHandler()
    # The run folder's log.txt has the rest.
    handler.setLevel(logging.WARNING)
    logging.basicConfig(format="%(levelname)s: %(message)s", handlers=[handler])
    with terminable():
        execute(Job.from_dict(order["job"]), Path(order["output"]), _print, order["memory_gb"], slot=order["slot"])


def _print(news: dict[str, Any]) -> None:
    try:
        sys.stdout.write(json.dumps(news) + "\n")
        sys.stdout.flush()
    except BrokenPipeError:
        # Nobody listens any more: the batch was ended. What is done is written, and the same batch goes on from there.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise KeyboardInterrupt from None


def execute(job: Job, output: Path, report: Report, memory_gb: float | None = None, *, slot: int = 0) -> str:
    """Run a job and keep its state file; returns its status. A job that was begun with the same settings goes on from
    its last checkpoint.

    Args:
        job: The job.
        output: Folder of the batch.
        report: Gets news: fields of `warpslam.batch.JobStatus`, and "compiled" when all kernels are there.
        memory_gb: Budget of this process [GB]. Beyond it the run ends after its current frame and keeps the trajectory
            so far; beyond a quarter more, the process ends at once.
        slot: Number of the worker, which picks a GPU where there are several.
    """
    start = time.monotonic()
    state = BatchState.of(job, output)
    has_same_settings = state.fields.get("settings") == job.settings_hash
    if not has_same_settings or state.fields.get("status") != RUNNING:
        state.fields.clear()
    elif state.fields.get("ending") == MEMORY:
        # Where the process before this one was ended, another one would be too.
        state.write(status=MEMORY)
        return MEMORY
    if not has_same_settings:
        # Before the state file says otherwise: the next process would take them for its own.
        RunFolder(output / job.name).set_checkpoints_aside()
    attempt = state.fields.get("attempt", 0) + 1
    state.write(settings=job.settings_hash, status=RUNNING, attempt=attempt, pid=os.getpid(), message="")
    report({"attempt": attempt})
    watch = MemoryWatch(memory_gb, state, start)
    status, message = FAILED, ""
    try:
        status, message = _run(job, output / job.name, report, watch, slot, go_on=has_same_settings)
    except MemoryBudgetError as error:
        status, message = MEMORY, str(error)
    except WarpSlamError as error:
        message = str(error)
    except KeyboardInterrupt:
        status = INTERRUPTED
    except Exception as error:
        log.exception("%s failed", job.name)
        message = f"{type(error).__name__}: {error}"
    finally:
        watch.stop()
        state.write(status=status, message=message, seconds=time.monotonic() - start)
    return status


def _run(job: Job, folder: Path, report: Report, watch: MemoryWatch, slot: int, *, go_on: bool) -> tuple[str, str]:
    """Status and message."""
    # Warp and torch are loaded once the cores of this process are set.
    from warpslam.pipeline.run import run

    request = job.request
    job = job.asking(
        device=request.device or _device_of(slot),
        checkpoint_every=request.checkpoint_every if has_checkpoints(request.method) else None,
    )
    observers: list[Observer] = [_Reporter(report, watch)]
    if job.log:
        from warpslam.viewer.figures import FigureLog

        observers.append(FigureLog(job.log, job.name))
    observer = Observers(*observers)
    try:
        result = run(job.request, folder, observer=observer, go_on=go_on, overwrite=True, discard=True)
    finally:
        observer.close()
    anew = result.metrics.started_anew
    message = f"started from the beginning: {anew}" if anew else ""
    return result.status, message


class _Reporter(Observer):
    """Passes on what the run tells of itself, and ends a run that takes too much memory."""

    def __init__(self, report: Report, watch: MemoryWatch) -> None:
        self.report, self.watch = report, watch

    def module(self, progress: ModuleProgress) -> None:
        if progress.done == progress.total:
            self.report({"compiled": True})

    def frame(self, progress: Progress) -> None:
        news = {"done": progress.done, "total": progress.total, "ate_rmse": progress.ate_rmse, "fps": progress.fps}
        self.report(news)
        self.watch.check()


def _device_of(slot: int) -> str | None:
    """Workers take the GPUs by turns; None where there is none."""
    import warp as wp

    wp.config.log_level = wp.LOG_WARNING
    devices = wp.get_cuda_devices()
    return str(devices[slot % len(devices)]) if devices else None


class MemoryWatch:
    """Looks at the memory of this process from a thread.

    RLIMIT_AS is no use here: compilers and CUDA reserve far more address space than they ever touch.
    """

    def __init__(self, budget_gb: float | None, state: BatchState, start: float) -> None:
        self.budget_gb, self.state, self.job_start = budget_gb, state, start
        self.worst_gb = 0.0
        self._end = threading.Event()
        if budget_gb is not None:
            threading.Thread(target=self._watch, daemon=True).start()

    def check(self) -> None:
        """Raise `MemoryBudgetError` if the budget was ever exceeded."""
        if self.budget_gb is not None and self.worst_gb > self.budget_gb:
            raise MemoryBudgetError(self._message())

    def stop(self) -> None:
        """End watching."""
        self._end.set()

    def _message(self) -> str:
        return (
            f"{self.worst_gb:.2f} GB of memory exceed the budget of {self.budget_gb:g} GB a worker: "
            "raise --memory-gb, or use larger grid spacings or fewer keyframes"
        )

    def _watch(self) -> None:
        assert self.budget_gb is not None
        while not self._end.wait(_WATCH_SECONDS):
            self.worst_gb = max(self.worst_gb, resident_bytes() / 1e9)
            if self.worst_gb > HARD_FACTOR * self.budget_gb:
                seconds = time.monotonic() - self.job_start
                self.state.write(ending=MEMORY, message=self._message(), seconds=seconds)
                os._exit(_EXIT_MEMORY)


if __name__ == "__main__":
    main()
