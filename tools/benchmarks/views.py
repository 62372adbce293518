"""Render views that a run never saw from its map, and compare them with the sequence's own images and true poses.

Example, for a run over the even frames: python -m tools.benchmarks.views runs/house/latest house --frames 13:240:24
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from warpslam.cli.common import parse_frames
from warpslam.errors import WarpSlamError
from warpslam.evaluation import psnr
from warpslam.sequences import Frame, open_sequence
from warpslam.slam import Slam


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="run folder")
    parser.add_argument("sequence", help="sequence folder with true poses")
    parser.add_argument("--frames", type=parse_frames, default=slice(None), help="a:b:step, frames to render")
    parser.add_argument("--stride", type=int, default=2, help="render every n-th pixel")
    options = parser.parse_args(arguments)
    try:
        slam, sequence = Slam.load(options.run / "map.safetensors"), open_sequence(options.sequence)
    except WarpSlamError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    stride = options.stride
    rows = []
    print("|rendered - true depth| [cm] and PSNR [dB]; samples placed by the true depth, then by the map alone")
    print("frame    mean  median   PSNR  |  mean  median   PSNR")
    for index in range(len(sequence))[options.frames]:
        frame = sequence[index]
        row = [*view_errors(slam, frame, stride, guided=True), *view_errors(slam, frame, stride, guided=False)]
        rows.append(row)
        print(f"{index:5d}  {_text(row)}", flush=True)
    print(f" mean  {_text(np.mean(rows, axis=0))}")
    return 0


def view_errors(slam: Slam, frame: Frame, stride: int, *, guided: bool) -> tuple[float, float, float]:
    """Mean and median depth error [cm] and PSNR [dB] of every `stride`-th pixel of the frame's view.

    `guided`: samples are placed by the frame's depth, else by the map alone.
    """
    image = slam.render(frame.T_world_camera, depth=frame.depth if guided else None, stride=stride)
    depth = frame.depth[::stride, ::stride]
    error = 100 * np.abs(image.depth - depth)[depth > 0]
    return float(error.mean()), float(np.median(error)), psnr(image.rgb, frame.rgb[::stride, ::stride])


def _text(row) -> str:
    return "{:6.2f}  {:6.2f}  {:5.1f}  |{:6.2f}  {:6.2f}  {:5.1f}".format(*row)


if __name__ == "__main__":
    sys.exit(main())
