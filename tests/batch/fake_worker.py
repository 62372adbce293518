"""A worker process of a batch whose runs take a moment and end as the name of the sequence says."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

from warpslam.batch import worker as batch_worker
from warpslam.batch.status import FINISHED
from warpslam.batch.worker import HARD_FACTOR
from warpslam.errors import DatasetError
from warpslam.runs.folder import RunFolder
from warpslam.runtime.environment import resident_bytes
from warpslam.storage.json_files import write_json


def fake_run(job, folder: Path, report, watch, slot: int, **how: object) -> tuple[str, str]:
    """In place of `batch_worker._run`."""
    if "compiling" in job.name:
        time.sleep(0.5)
    report({"compiled": True})
    (folder / "cores.txt").write_text(repr(sorted(os.sched_getaffinity(0))))
    eaten = []
    for frame in range(4):
        if "slow" in job.name:
            time.sleep(0.3)
        if frame == 2:
            if "broken" in job.name:
                raise DatasetError("depth.png: truncated\nand more")
            if "bug" in job.name:
                raise ZeroDivisionError("by zero")
            if "killed" in job.name:
                os.kill(os.getpid(), signal.SIGKILL)
            if "hungry" in job.name:
                factor = 3 if "very" in job.name else 0.5 + HARD_FACTOR / 2
                eaten.append(bytearray(int(factor * 1e9 * watch.budget_gb) - resident_bytes()))
                eaten[-1][::1024] = b"\1" * len(range(0, len(eaten[-1]), 1024))  # touched, so that it counts
                time.sleep(0.8)
            if "exits" in job.name:
                print("last words", file=os.sys.stderr, flush=True)
                os._exit(3)
        report({"done": frame + 1, "total": 4, "fps": 2.0, "ate_rmse": 0.01 * frame})
        watch.check()
    run = RunFolder(folder)
    run.trajectory.write_text("# timestamp tx ty tz qx qy qz qw\n")
    frames = {"selected": 4, "processed": 4, "unreadable": 0, "LOST": 1}
    write_json(run.metrics, {"status": "finished", "frames": frames, "fps": 2.0, "ate_m": {"aligned": {"rmse": 0.03}}})
    return FINISHED, ""


if __name__ == "__main__":
    batch_worker._run = fake_run
    batch_worker.main()
