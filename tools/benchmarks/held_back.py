"""Views of frames that no map saw: every tenth of a sequence is held back, from our map and from TSDF fusion.

    python -m tools.benchmarks.held_back DATA/tum_fr1_xyz
    python -m tools.benchmarks.held_back HOUSE/house --frames 0:240:2 --preset live --preset rendering

TSDF fusion gets the poses that the preset's run found. The pose of a frame that is held back lies half-way between
those of its neighbours, so that errors are a map's and not those of the alignment with a ground truth. Views are
rendered from the map alone; where the mesh of TSDF fusion shows nothing, its depth counts as missed and its colour is
black.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Mapping

import numpy as np

from warpslam.baselines.tsdf import Tsdf
from warpslam.cli.common import parse_frames
from warpslam.config import Config
from warpslam.evaluation import psnr
from warpslam.field.rendering import RenderedImage
from warpslam.pipeline.methods import Method
from warpslam.poses import inverse, motion_of, twist_of
from warpslam.sequences import Frame, RgbdSequence, open_sequence
from warpslam.slam import Slam

EVERY = 10


def main(arguments: list[str] | None = None) -> int:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequence")
    parser.add_argument("--frames", type=parse_frames, default=slice(None), help="a:b:step; every tenth is held back")
    parser.add_argument("--preset", action="append", help="default, if none is given")
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="GROUP.FIELD=VALUE")
    parser.add_argument("--stride", type=int, default=2, help="render every n-th pixel")
    options = parser.parse_args(arguments)
    sequence = open_sequence(options.sequence)
    indices = range(len(sequence))[options.frames]
    held = indices[EVERY // 2 : -1 : EVERY]
    print("| map | depth L1 [cm] | missed | PSNR [dB] |")
    print("|---|---|---|---|")
    for name in options.preset or ["default"]:
        slam = Slam(sequence.intrinsics, Config.from_preset(name, options.overrides), timing=sequence.timing)
        feed(slam, sequence, (index for index in indices if index not in held))
        slam.finish()
        poses = iter(slam.trajectory.poses)
        known = {index: next(poses) for index in indices if index not in held}
        fusion = Tsdf(sequence.intrinsics, slam.config)
        feed(fusion, sequence, known, known)
        for label, method in ((name, slam), (f"TSDF fusion at the poses of {name}", fusion)):
            errors = []
            for index in held:
                pose = half_way(known[index - indices.step], known[index + indices.step])
                view = method.render(pose, stride=options.stride)
                errors.append(view_errors(view, sequence[index], options.stride))
            depth, missed, decibels = np.nanmean(errors, axis=0)
            print(f"| {label} | {depth:.2f} | {missed:.1%} | {decibels:.1f} |", flush=True)
    return 0


def feed(
    method: Method, sequence: RgbdSequence, indices: Iterable[int], poses: Mapping[int, np.ndarray] | None = None
) -> None:
    """Take in frames of a sequence, with poses if these are given."""
    for index in indices:
        frame = sequence[index]
        pose = None if poses is None else poses[index]
        method.step(frame.rgb, frame.depth, frame.timestamp, pose, depth_timestamp=frame.depth_timestamp)


def half_way(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The pose (4, 4) between two."""
    return a @ motion_of(0.5 * twist_of(inverse(a) @ b))


def view_errors(view: RenderedImage, frame: Frame, stride: int) -> tuple[float, float, float]:
    """Mean depth error [cm] where something was measured and rendered, share of what was measured and was not rendered,
    and PSNR [dB].
    """
    depth = frame.depth[::stride, ::stride]
    measured = depth > 0
    shown = measured & (view.depth > 0)
    error = 100 * np.abs(view.depth - depth)[shown]
    return float(error.mean()), float(1 - shown.sum() / measured.sum()), psnr(view.rgb, frame.rgb[::stride, ::stride])


if __name__ == "__main__":
    sys.exit(main())
