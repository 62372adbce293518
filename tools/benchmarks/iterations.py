"""Time warpslam against plain torch on the same inputs, both on two threads, alternating in one process.

    python -m tools.benchmarks.iterations --repeats 5 --out benchmark.json

A room is rendered (640x480), its first frame mapped, and then each phase is timed: a tracking iteration (200 rays; the
paper's Adam, and Gauss-Newton), mapping iterations by stage (1000 rays, five frames), a whole mapping call (60
iterations with selection, coarse level and bundle adjustment) and a part of the first frame. `torch` is
`tools/benchmarks/torch_slam.py`: the same iteration, built as the original is. Medians of the repeats; the last
column is theirs over ours. Also measured: the machine's peak for single-precision matrix products, and what a tracking
iteration takes when its kernels have no thread, which is the time of launching and of Python.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal
from unittest import mock

import numpy as np
import torch
import warp as wp

from tools.benchmarks.torch_slam import Level, TorchSlam
from warpslam.camera import Intrinsics
from warpslam.config import Config
from warpslam.mapping.frustum import measured_extent
from warpslam.mapping.mapper import Mapper
from warpslam.poses import vector_from_pose
from warpslam.runtime.launching import Launcher
from warpslam.slam import Slam
from warpslam.synthetic import SyntheticSequence

CAMERA = Intrinsics(fx=525.0, fy=525.0, cx=319.5, cy=239.5, width=640, height=480)
PAPER = ["sampling.jitter=false", "tracking.use_given_poses=true", "mapping.coarse=false", "keyframes.every=1"]
STAGES = {"middle": (1.0, 1.0), "fine": (0.0, 1.0), "color": (0.0, 0.0)}
SPACING = 4  # frames between those of the window


class Ours:
    """The package at the point where frame 5 of a walk is to be mapped, four frames lying behind it."""

    def __init__(self, sequence: SyntheticSequence, overrides: list[str]) -> None:
        """Map the first frame, then take in the others as keyframes."""
        self.frames = [sequence[SPACING * i] for i in range(6)]
        self.poses = sequence.ground_truth()[: 6 * SPACING : SPACING]
        first = ["mapping.first_iterations=200", "mapping.every=1000"]
        self.slam = Slam(CAMERA, Config.from_preset("default", [*PAPER, *first, *overrides]), device=None)
        for frame in self.frames[:5]:
            self.slam.step(frame.rgb, frame.depth, T_world_camera=frame.T_world_camera)
        last = self.frames[5]
        self.slam.scene.cover(*measured_extent(last.depth, self.poses[5], self.slam.intrinsics))
        self.slam.images.set(0, last.rgb, last.depth)
        self.vector = vector_from_pose(self.poses[5])

    def map_call(self, iterations: int, stage: str | None = None, *, whole: bool = False) -> None:
        """A mapping call; with a stage, all iterations are of that stage (but for the first)."""
        config = self.slam.mapper.config
        config.iterations = iterations
        config.middle_share, config.fine_share = STAGES[stage] if stage else (0.4, 0.6)
        config.coarse, config.bundle_adjustment = whole, whole
        keyframes = self.slam.keyframes
        self.slam.mapper.start_frame(self.slam.images, 5, self.poses[5], keyframes)()

    def map_first(self, iterations: int) -> None:
        """Iterations of the first frame, at its rates."""
        config = self.slam.mapper.config
        config.first_iterations, config.coarse = iterations, False
        config.middle_share, config.fine_share = 0.4, 0.6
        self.slam.mapper.start_first(self.slam.images, 5, self.poses[5])()

    def track(self, optimizer: Literal["adam", "gauss_newton"], iterations: int) -> None:
        """Tracking with a number of iterations, 200 rays."""
        config = self.slam.tracker.config
        config.optimizer, config.iterations, config.keep_best = optimizer, iterations, "last"
        self.slam.tracker.track(self.slam.scene.arrays(), self.slam.images, 5, self.poses[5])


def torch_twin(ours: Ours) -> tuple[TorchSlam, dict[str, np.ndarray], TorchSlam]:
    """The torch state with the same map, the masks of the frustum, and one that has the last frame alone."""
    scene = ours.slam.scene
    levels = {}
    for level in ("middle", "fine", "color"):
        grid = scene.grids[level]
        table = torch.from_numpy(grid.features.numpy().reshape(*grid.shape, 32))
        low = grid.first * grid.spacing
        high = low + (np.array(grid.shape) - 1) * grid.spacing
        corners = [torch.tensor(corner, dtype=torch.float32) for corner in (low, high)]
        levels[level] = Level(table.permute(3, 0, 1, 2)[None].contiguous(), *corners)
    ours.map_call(1)  # selects the vertices
    mapper = ours.slam.mapper
    assert isinstance(mapper, Mapper), "vertices are selected by the rendering loss"
    masks = {}
    for level in levels:
        mask = np.zeros(scene.grids[level].row_count, bool)
        mask[mapper._grids[level].rows.numpy()] = True
        masks[level] = mask
    decoders = {weights.level: weights for weights in scene.decoder_weights}
    chosen = (5, 1, 2, 3, 4)
    images = [(ours.frames[n].rgb, ours.frames[n].depth) for n in chosen]
    poses = np.stack([vector_from_pose(ours.poses[n]) for n in chosen])
    whole = TorchSlam(levels, decoders, scene.bounds, CAMERA, images, poses)
    alone = TorchSlam(dict(levels), decoders, scene.bounds, CAMERA, images[:1], poses[:1])
    return whole, masks, alone


@dataclass(frozen=True)
class Phase:
    """A part of the algorithm in both implementations."""

    ours: Callable[[], object]
    """The package's."""
    theirs: Callable[[], object]
    """torch's."""
    count: int = 1
    """Iterations in one call."""


def phases_of(ours: Ours, count: int = 10) -> dict[str, Phase]:
    """What is compared, by name, with ``count`` iterations in a call where single iterations are."""
    theirs, masks, alone = torch_twin(ours)

    def torch_mapping(stage: str) -> Callable[[], None]:
        def run() -> None:
            theirs.start_mapping(masks)
            for _ in range(count):
                theirs.map_once(stage, 1000)

        return run

    def torch_call(problem: TorchSlam, iterations: int, factor: float, *, adjust: bool) -> Callable[[], None]:
        def run() -> None:
            problem.start_mapping(masks, adjust=adjust)
            for j in range(iterations):
                stage = "middle" if j <= 0.4 * iterations else "fine" if j <= 0.6 * iterations else "color"
                problem.map_once(stage, 1000, factor=factor)

        return run

    def torch_tracking() -> None:
        alone.start_tracking()
        for _ in range(count):
            alone.track_once(200)

    ours.slam.tracker.config.pixels = 200
    ours.slam.tracker._batch = ours.slam.tracker._new_batch(200)
    phases = {
        "tracking, Adam": Phase(lambda: ours.track("adam", count), torch_tracking, count),
        "tracking, Gauss-Newton": Phase(lambda: ours.track("gauss_newton", count), torch_tracking, count),
    }
    for stage in STAGES:
        phases[f"mapping, {stage}"] = Phase(partial(ours.map_call, count, stage), torch_mapping(stage), count)
    call, first = torch_call(theirs, 60, 1.0, adjust=True), torch_call(alone, 60, 5.0, adjust=False)
    phases["mapping call"] = Phase(lambda: ours.map_call(60, whole=True), call)
    phases["first frame, 60 iterations"] = Phase(lambda: ours.map_first(60), first)
    return phases


def alternate(
    pairs: dict[str, tuple[Callable[[], object], Callable[[], object]]], repeats: int
) -> dict[str, tuple[float, float]]:
    """Median seconds of both functions of each pair, run in turns."""
    result = {}
    for name, (ours, theirs) in pairs.items():
        ours(), theirs()
        times: list[list[float]] = [[], []]
        for _ in range(repeats):
            for column, function in zip(times, (ours, theirs), strict=True):
                start = time.perf_counter()
                function()
                column.append(time.perf_counter() - start)
        result[name] = (float(np.median(times[0])), float(np.median(times[1])))
    return result


def launching_share(ours: Ours, optimizer: Literal["adam", "gauss_newton"], repeats: int) -> float:
    """Time of 100 tracking iterations whose kernels have no thread over that of whole ones: medians, in turns."""
    commands: list[wp.Launch] = []
    original = Launcher.command

    def command(launcher: Launcher, kernel: wp.Kernel, dim: Any, inputs: list) -> wp.Launch:
        commands.append(original(launcher, kernel, dim, inputs))
        return commands[-1]

    def run() -> None:
        ours.track(optimizer, 100)

    ours.slam.tracker._launcher.forget()
    with mock.patch.object(Launcher, "command", command):
        run()  # records the launches
    whole = [recorded.bounds for recorded in commands]

    def without_threads() -> None:
        for recorded in commands:
            recorded.set_dim((0,) * max(recorded.kernel.adj.kernel_dim, 1))
        try:
            run()
        finally:
            for recorded, bounds in zip(commands, whole, strict=True):
                recorded.bounds = recorded.params[0] = bounds

    launching, full = alternate({"": (without_threads, run)}, repeats)[""]
    return launching / full


def matrix_peak(size: int = 1024, repeats: int = 20) -> float:
    """GFLOP/s of single-precision matrix products on all threads, best of the repeats."""
    a, b = torch.randn(2, size, size)
    best = np.inf
    for _ in range(repeats):
        start = time.perf_counter()
        a @ b
        best = min(best, time.perf_counter() - start)
    return 2e-9 * size**3 / best


def main(arguments: list[str] | None = None) -> int:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--threads", type=int, default=2, help="threads of torch; warpslam takes all cores")
    parser.add_argument("--set", nargs="+", default=[], help="settings of warpslam, group.field=value")
    parser.add_argument("--out", type=Path, help="JSON file")
    options = parser.parse_args(arguments)
    torch.set_num_threads(options.threads)
    torch.manual_seed(0)
    sequence = SyntheticSequence(1_000_000, 40, intrinsics=CAMERA)
    ours = Ours(sequence, options.set)
    phases = phases_of(ours)
    pairs = {name: (phase.ours, phase.theirs) for name, phase in phases.items()}
    times = alternate(pairs, options.repeats)
    peak = matrix_peak()
    shares = {
        "adam": launching_share(ours, "adam", options.repeats),
        "gauss_newton": launching_share(ours, "gauss_newton", options.repeats),
    }
    rows = {}
    print("| phase | warpslam [ms] | torch [ms] | ratio |\n|---|---|---|---|")
    for name, (a, b) in times.items():
        each = 1e3 / phases[name].count
        rows[name] = {"warpslam_ms": each * a, "torch_ms": each * b, "ratio": b / a}
        print("| {} | {:.1f} | {:.1f} | {:.1f} |".format(name, *rows[name].values()))
    print(
        f"matrix products: {peak:.0f} GFLOP/s on {options.threads} threads; kernels compiled in "
        f"{ours.slam.compile_seconds:.1f} s"
    )
    for optimizer, share in shares.items():
        print(f"launching and Python in a tracking iteration, {optimizer}: {share:.1%}")
    if options.out:
        result = {"phases": rows, "matrix_gflops": peak, "launching_share": shares}
        options.out.write_text(json.dumps(result, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
