"""What a map takes by layout and spacing: features, state per observed cubic metre, peak of memory, time of a frame.

    python -m tools.benchmarks.large_map HOUSE/walk --frames 0:720:3
    python -m tools.benchmarks.large_map HOUSE/walk --frames 0:720:3 --layouts blocks --spacings 0.08

Poses are those of the sequence, the preset is `live`, and what is not said is its. Each row is a process of its own, so
that its peak is that of one map. Times are CPU times of mapping, which other jobs on the machine harm least, without
reading images; those of the first tenth and of the last tenth of the frames show what the size of the map costs.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time

import numpy as np

from warpslam.cli.common import parse_frames
from warpslam.config import Config
from warpslam.errors import WarpSlamError
from warpslam.runtime.environment import peak_memory_mib
from warpslam.sequences import open_sequence
from warpslam.slam import Slam

HEAD = (
    "| layout | fine [m] | box [m3] | features [MB] | state [MB] | observed [m3] | state per observed m3 [kB] | "
    "peak [MiB] | CPU ms a frame, first tenth | last tenth | most |"
)


def measure(folder: str, frames: slice, layout: str, spacing: float, settings: list[str]) -> str:
    """Map a sequence; returns its row."""
    sequence = open_sequence(folder)
    overrides = [f"grid.layout={layout}", f"grid.fine_spacing={spacing}", "tracking.use_given_poses=true", *settings]
    slam = Slam(sequence.intrinsics, Config.from_preset("live", overrides), "cpu", timing=sequence.timing)
    times = []
    for index in range(len(sequence))[frames]:
        frame = sequence[index]
        start = time.process_time()
        slam.step(frame.rgb, frame.depth, frame.timestamp, frame.T_world_camera)
        times.append(1000 * (time.process_time() - start))
    figures, peak = slam.inventory(), peak_memory_mib()
    low, high = slam.scene.bounds
    memory, observed = figures["memory"], figures["observed_volume_m3"]
    tenth = max(len(times[1:]) // 10, 1)
    first, last = np.mean(times[1 : 1 + tenth]), np.mean(times[-tenth:])
    return (
        f"| {layout} | {spacing:g} | {np.prod(high - low):.0f} | {memory['grid_bytes'] / 1e6:.0f} | "
        f"{memory['state_bytes'] / 1e6:.0f} | {observed:.0f} | {memory['state_bytes_per_observed_m3'] / 1e3:.0f} | "
        f"{peak:.0f} | {first:.0f} | {last:.0f} | {max(times[1:]):.0f} |"
    )


def main(arguments: list[str] | None = None) -> int:
    """Print a table; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", help="a sequence with poses")
    parser.add_argument("--frames", type=parse_frames, default=slice(None), metavar="A:B:STEP")
    parser.add_argument("--layouts", nargs="+", default=["dense", "blocks"], choices=["dense", "blocks"])
    parser.add_argument("--spacings", nargs="+", type=float, default=[0.16, 0.08], help="of the fine level [m]")
    parser.add_argument("--set", nargs="+", default=[], metavar="GROUP.FIELD=VALUE", help="further settings")
    options = parser.parse_args(arguments)
    cases = [(layout, spacing) for spacing in options.spacings for layout in options.layouts]
    try:
        if len(cases) == 1:
            print(measure(options.folder, options.frames, *cases[0], options.set), flush=True)
            return 0
    except WarpSlamError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(HEAD)
    print("|---" * HEAD.count(" | ") + "|---|", flush=True)
    chosen = options.frames.start, options.frames.stop, options.frames.step
    frames = ":".join("" if n is None else str(n) for n in chosen)
    for layout, spacing in cases:
        command = [sys.executable, "-m", "tools.benchmarks.large_map", options.folder, f"--frames={frames}"]
        command += ["--layouts", layout, "--spacings", str(spacing), *(["--set", *options.set] if options.set else [])]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True)
        print(*(line for line in done.stdout.splitlines() if line.startswith("|")), sep="\n", flush=True)
        if done.returncode:
            return done.returncode
    return 0


if __name__ == "__main__":
    sys.exit(main())
