"""Strict against overlapped mapping: frames a second, how long a frame takes, and what that does to the trajectory.

    python -m tools.benchmarks.schedules --frames 60 --repeats 3
    python -m tools.benchmarks.schedules --frames 60 --rate 5

The schedules take turns on the sequence of `warpslam demo`, so that a machine that is busy with other things harms both
alike. The first frame and the final refinement are left out of all times. With `--rate`, frames come from a camera that
does not wait: the time of a frame then counts from when it was taken until its pose is known.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass

import numpy as np

from warpslam.config import Config
from warpslam.errors import WarpSlamError
from warpslam.evaluation import ate
from warpslam.field.decoder_files import load_decoders
from warpslam.sequences.base import Frame
from warpslam.slam import Slam
from warpslam.synthetic.demo import INTRINSICS, PRESET, demo_sequence

SCHEDULES = ("strict", "overlapped")


@dataclass(frozen=True)
class Measurement:
    """A run: seconds in all and of each frame after the first, and the ATE [m]."""

    seconds: float
    frame_seconds: np.ndarray
    ate_rmse: float

    def row(self) -> str:
        """Frames a second; mean, median, 95th percentile and largest time of a frame [ms]; ATE [cm]."""
        ms = 1000 * self.frame_seconds
        times = (ms.mean(), np.median(ms), np.percentile(ms, 95), ms.max())
        fps = len(ms) / self.seconds
        return f"{fps:.2f} | " + " | ".join(f"{t:.0f}" for t in times) + f" | {100 * self.ate_rmse:.2f}"


def measure(frames: list[Frame], config: Config, rate: float | None) -> Measurement:
    """Run over the frames, which come at ``rate`` [Hz], or each as soon as the one before is done."""
    slam = Slam(INTRINSICS, config, decoders=load_decoders())
    times = []
    start = 0.0
    for n, frame in enumerate(frames):
        taken = time.perf_counter()
        if rate is not None and n > 0:
            taken = start + n / rate
            time.sleep(max(taken - time.perf_counter(), 0.0))
        slam.step(frame.rgb, frame.depth, frame.timestamp, frame.T_world_camera)
        times.append(time.perf_counter() - taken)
        if n == 0:
            start = time.perf_counter()
    slam.wait()
    seconds = time.perf_counter() - start
    truth = np.array([frame.T_world_camera for frame in frames])
    return Measurement(seconds, np.array(times[1:]), ate(slam.trajectory.poses, truth).rmse)


def main(arguments: list[str] | None = None) -> int:
    """Print a table; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=60, help="frames of the sequence that are used")
    parser.add_argument("--repeats", type=int, default=1, help="runs of each schedule")
    parser.add_argument("--rate", type=float, help="frames a second of the camera; by default it waits")
    parser.add_argument("--set", action="append", default=[], metavar="GROUP.FIELD=VALUE", help="a setting")
    options = parser.parse_args(arguments)
    try:
        configs = {s: Config.from_preset(PRESET, [*options.set, f"schedule={s}"]) for s in SCHEDULES}
        sequence = demo_sequence()
        frames = [sequence[n] for n in range(min(options.frames, len(sequence)))]
        print("| schedule | frames/s | mean [ms] | median [ms] | 95 % [ms] | max [ms] | ATE [cm] |")
        print("|---|---|---|---|---|---|---|")
        for _ in range(options.repeats):
            for schedule, config in configs.items():
                print(f"| {schedule} | {measure(frames, config, options.rate).row()} |", flush=True)
    except WarpSlamError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
