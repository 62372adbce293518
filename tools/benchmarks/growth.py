"""Time of a mapping call against the size of the map, and what a map costs by what was seen.

    python -m tools.benchmarks.growth --factors 1 3 10 --repeats 5

One room is mapped as in `tools/benchmarks/iterations.py`; then the same call (60 iterations with selection, coarse
level and bundle adjustment) is timed in turns on maps of that room whose box is so many times
as large, as if the rest of a building had been mapped before. Memory is that of features, moments and gradient buffers.
"""

from __future__ import annotations

import argparse
import sys
import time

import numpy as np

from tools.benchmarks.iterations import CAMERA, Ours
from warpslam.synthetic import SyntheticSequence


def main(arguments: list[str] | None = None) -> int:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--factors", type=float, nargs="+", default=[1.0, 3.0, 10.0], help="volumes over the room's")
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args(arguments)
    sequence = SyntheticSequence(1_000_000, 40, intrinsics=CAMERA)
    maps = [Ours(sequence, []) for _ in options.factors]
    for ours, factor in zip(maps, options.factors, strict=True):
        grow(ours, factor)
    seconds: list[list[float]] = [[] for _ in maps]
    for repeat in range(options.repeats + 1):
        for ours, times in zip(maps, seconds, strict=True):
            start = time.perf_counter()
            ours.map_call(60, whole=True)
            if repeat:  # the first one records launches and makes room
                times.append(time.perf_counter() - start)
    base = float(np.median(seconds[0]))
    print("| volume [m^3] | vertices | grids and optimiser [MB] | call, median [ms] | over the first |")
    print("|---|---|---|---|---|")
    for ours, times in zip(maps, seconds, strict=True):
        scene = ours.slam.scene
        low, high = scene.bounds
        median = float(np.median(times))
        vertices = sum(grid.row_count for grid in scene.grids.values())
        megabytes = 1e3 * scene.gigabytes(low, high)
        sizes = f"{np.prod(high - low):.0f} | {vertices:,} | {megabytes:.0f}"
        print(f"| {sizes} | {1e3 * median:.0f} | {median / base:.3f} |")
    return 0


def grow(ours: Ours, factor: float) -> None:
    """Make the box of a map ``factor`` times as large, sideways."""
    scene = ours.slam.scene
    low, high = scene.bounds
    # `cover` adds the margin, which the box has.
    more = 0.5 * (high - low) * (np.sqrt(factor) - 1.0) * [1.0, 1.0, 0.0] - scene.config.margin - 1e-6
    scene.cover(low - more, high + more)


if __name__ == "__main__":
    sys.exit(main())
