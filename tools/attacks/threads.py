"""One `Slam` in several threads, and in forked processes."""

from __future__ import annotations

import multiprocessing
import threading
from typing import Any

import numpy as np

from tools.attacks import scene
from tools.attacks.isolation import Attempt

THREADS = 4


def prepare(name: str) -> Attempt:
    """``name`` is "threads" or "forks"."""
    return _threads if name == "threads" else _fork


def _threads(rng: np.random.Generator) -> str:
    slam, errors = scene.small_slam(count=2), []
    frames = scene.frames()

    def work(seed: int) -> None:
        own = np.random.default_rng(seed)
        try:
            for _ in range(4):
                kind = own.integers(0, 4)
                if kind == 0:
                    frame = frames[int(own.integers(0, len(frames)))]
                    slam.step(frame.rgb, frame.depth)
                elif kind == 1:
                    slam.render(slam.trajectory.poses[0], stride=8)
                elif kind == 2:
                    slam.scene.query_occupancy(own.normal(size=(500, 3)))
                else:
                    slam.mesh(0.4)
        except Exception as error:
            errors.append(error)

    threads = [threading.Thread(target=work, args=(int(seed),)) for seed in rng.integers(0, 1 << 30, THREADS)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()  # one that waits for ever is a try that hangs
    for error in errors:
        raise error
    return "all threads came back"


def _fork(rng: np.random.Generator) -> str:
    slam = scene.small_slam(count=2)
    frame = scene.frames()[3]
    context: Any = multiprocessing.get_context("fork")
    queue = context.Queue()

    def work() -> None:
        try:
            own = scene.small_slam(count=1) if rng.random() < 0.5 else slam
            queue.put(str(own.step(frame.rgb, frame.depth).status))
        except Exception as error:
            queue.put(f"{type(error).__name__}: {error}")

    process = context.Process(target=work)
    process.start()
    process.join()
    assert process.exitcode == 0, f"a forked process ended with {process.exitcode}"
    assert slam.step(frame.rgb, frame.depth).status, "the parent goes on"
    return f"child: {queue.get(timeout=5)[:60]}"
