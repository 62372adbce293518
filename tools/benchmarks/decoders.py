"""The decoder kernels alone: operations a second over the machine's peak for matrix products.

    python -m tools.benchmarks.decoders --repeats 5

Iterations in the colour stage on a mapped frame of a rendered room, 1000 rays of 48 samples, on all cores, exactly: no
sample is left out. Once for each gradient that is asked for: the pose (tracking), the grids (refinement), and the grids
and the colour decoder's weights (mapping). Operations are counted as in the paper's Table 4, two a weight and one a
bias; embedding, lookup and scattering of features take time and do not count. Medians of the repeats, each of which
measures the peak anew.
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from functools import partial

import numpy as np
import warp as wp

import warpslam
from tools.benchmarks.iterations import CAMERA, SPACING, Ours
from warpslam.field.arrays import Gradients, GridGradient, gradient_buffers
from warpslam.field.objectives import mapping_loss
from warpslam.field.passes import render
from warpslam.field.ray_batch import RayBatch
from warpslam.kernels.decoder.layout import COLOR_WEIGHT_ROWS
from warpslam.poses import vector_from_pose
from warpslam.runtime.launching import Launcher
from warpslam.synthetic import SyntheticSequence

LEVELS = ("middle", "fine", "color")


def main(arguments: list[str] | None = None) -> int:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--iterations", type=int, default=12, help="iterations a repeat")
    options = parser.parse_args(arguments)
    ours = Ours(SyntheticSequence(1_000_000, 5 * SPACING + 1, intrinsics=CAMERA), [])
    device = ours.slam.device
    grids = {level: whole_grid(ours, level) for level in LEVELS}
    cases = {
        "pose": Gradients(points=True),
        "grids": Gradients(grids=grids),
        "grids and weights": Gradients(grids=grids, color_weights=gradient_buffers(COLOR_WEIGHT_ROWS, device)),
    }
    rates: dict[tuple[str, str], list[tuple[float, float]]] = defaultdict(list)
    for repeat in range(options.repeats + 1):
        for name, gradients in cases.items():
            with warpslam.profile() as profile:
                iterate(ours, gradients, options.iterations)
            if repeat == 0:  # kernels are loaded
                continue
            for row in profile.report.kernels:
                if row.peak_share is not None and row.kernel.endswith(("_forward", "_backward")):
                    rates[row.kernel, name].append((row.gflops or 0.0, row.peak_share))
    print("| kernel | gradient asked for | GFLOP/s | share of the peak |")
    print("|---|---|---|---|")
    for (kernel, name), measured in sorted(rates.items()):
        gflops, share = np.median(measured, axis=0)
        print(f"| {kernel} | {name} | {gflops:.0f} | {share:.0%} |")
    return 0


def whole_grid(ours: Ours, level: str) -> GridGradient:
    """Gradient of all rows of a level."""
    count, device = ours.slam.scene.grids[level].row_count, ours.slam.device
    place = wp.array(np.arange(count, dtype=np.int32), dtype=int, device=device)
    return GridGradient(gradient_buffers(count, device), place)


def iterate(ours: Ours, gradients: Gradients, count: int) -> None:
    """Iterations of the colour stage, without their optimiser."""
    slam = ours.slam
    pixels, sampling = slam.config.mapping.pixels, slam.config.sampling
    launcher = Launcher(slam.device)
    batch = RayBatch(pixels, sampling.stratified + sampling.surface, slam.device, launcher)
    batch.set_seeds([0])
    window = wp.zeros(1, dtype=int, device=slam.device)
    poses = wp.array(vector_from_pose(ours.poses[5])[None], dtype=float, device=slam.device, requires_grad=True)
    arrays = slam.scene.arrays()
    for _ in range(count):
        with launcher.tape() as tape:
            batch.draw(slam.images.arrays, window, pixels, CAMERA)
            batch.cast(poses, differentiate=gradients.points)
            batch.bound(arrays)
            batch.place_samples(sampling.stratified, sampling.surface, jitter=True)
            render(batch, arrays, "color", gradients, tape)
            mapping_loss(batch, 0.2)
        launcher.call(partial(tape.backward, batch.loss))


if __name__ == "__main__":
    sys.exit(main())
