"""``warpslam run`` in a process of its own that is killed at a chosen point, for the tests of checkpoints.

    python -m tests.stopped_run POINT COUNT ARGUMENTS...

kills itself (SIGKILL) when POINT is reached for the COUNT-th time: "map" (a frame), "write" (before a
checkpoint is on the disk), "rename" (of a checkpoint), "refine" (after the last frame); "never" lets it run.
Without ARGUMENTS it is a worker of a batch.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from warpslam import cli
from warpslam.batch import worker as batch_worker
from warpslam.mapping.direct_mapper import DirectMapper
from warpslam.pipeline import run as pipeline


def kill_at(owner: Any, name: str, count: int) -> None:
    """Kill this process instead of the ``count``-th call of a function."""
    function: Callable = getattr(owner, name)
    calls = 0

    def counted(*arguments: Any, **keywords: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == count:
            os.kill(os.getpid(), signal.SIGKILL)
        return function(*arguments, **keywords)

    setattr(owner, name, counted)


def main() -> int | None:
    point, count, arguments = sys.argv[1], int(sys.argv[2]), sys.argv[3:]
    targets = {
        "map": (DirectMapper, "start_frame"),
        "write": (os, "fsync"),
        "rename": (Path, "replace"),
        "refine": (DirectMapper, "refine"),
    }
    if point != "never":
        kill_at(*targets[point], count)
    pipeline.draw_plots = pipeline.draw_panels = lambda *arguments: None  # figures take longer than all else
    return cli.main(arguments) if arguments else batch_worker.main()


if __name__ == "__main__":
    sys.exit(main())
