"""SLAM on a camera of one's own that is running: what it must do, and the run. Here it is a rendered room."""

from __future__ import annotations

import time
from pathlib import Path

from warpslam.pipeline.live import run_live
from warpslam.sequences.live import LiveCamera, LiveImages
from warpslam.synthetic import demo


class RoomCamera(LiveCamera):
    """Twenty images a second, whoever listens."""

    def __init__(self, count: int) -> None:
        self._room, self._next, self._count = demo.demo_sequence(), 0, count
        self.intrinsics = self._room.intrinsics

    def read(self) -> LiveImages | None:
        """The next images; None ends the run."""
        if self._next == self._count:
            return None
        time.sleep(0.05)
        frame, self._next = self._room[self._next], self._next + 1
        return LiveImages(frame.rgb, frame.depth, frame.timestamp)


def main(count: int = 60, output: str | Path = "runs/live_example", overrides: tuple[str, ...] = ()) -> int:
    """Run it; returns the number of frames that could be used in time."""
    result = run_live(RoomCamera(count), output, overrides=overrides)
    print(f"{result.metrics.frames.processed} of {count} frames were used, see {result.folder.path}")
    return result.metrics.frames.processed or 0


if __name__ == "__main__":
    main()
