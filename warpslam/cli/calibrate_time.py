"""``warpslam calibrate-time``."""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import warp as wp

from warpslam.cli.common import add_command, add_device_option, add_format_options, parse_frames
from warpslam.errors import ConfigError, DatasetError
from warpslam.pipeline.setup import check_device, select_frames
from warpslam.sequences import open_sequence
from warpslam.sequences.calibration import CAMERA_FILE
from warpslam.sequences.files import FileSequence
from warpslam.storage.atomic import replacing
from warpslam.tracking.time_calibration import AlignmentCost, Estimate, TimingEstimate, find_timing


def add(commands: Any) -> None:
    """Add the command."""
    text = "delay of depth and readout time of a camera, from a recording in which it moves"
    calibrate = add_command(commands, "calibrate-time", _calibrate, text)
    calibrate.add_argument("folder", metavar="FOLDER", help="folder of one sequence")
    add_format_options(calibrate)
    calibrate.add_argument(
        "--frames", type=parse_frames, metavar="A:B:STEP", help="frames to use, as in a Python slice"
    )
    calibrate.add_argument("--write", action="store_true", help="write what was found into the folder's camera.yaml")
    add_device_option(calibrate)


def _calibrate(options: argparse.Namespace) -> int:
    check_device(options.device)
    sequence = open_sequence(options.folder, dataset=options.dataset, camera=options.camera, topics=options.topics)
    if not isinstance(sequence, FileSequence):
        raise ConfigError(f"{sequence.name} is no recording on disk")
    selected = select_frames(sequence, options.frames)
    cost = AlignmentCost(sequence, selected, wp.get_device(options.device))
    speed, turn = cost.speed
    stamps = "with stamps of depth" if sequence.depth_timestamps is not None else "without stamps of depth"
    print(
        f"{sequence.name}: {len(cost.pairs)} pairs of frames, {stamps}, {speed:.2f} m/s and {turn:.2f} rad/s on average"
    )
    estimate = find_timing(cost, sequence.timing, _report if sys.stderr.isatty() else None)
    print(describe(estimate))
    calibration = sequence.calibration
    stored = calibration.timing_as_stored(estimate.timing)
    stored = replace(stored, readout=round(stored.readout, 3))
    print(f"\n# {CAMERA_FILE}\ndepth_delay: {stored.depth_delay:g}\nreadout: {stored.readout:g}")
    if options.write:
        if not (estimate.depth_delay.is_determined or estimate.readout.is_determined):
            raise DatasetError(f"{sequence.name}: nothing was determined, so nothing is written; move the camera more")
        path = Path(options.folder) / CAMERA_FILE
        with replacing(path) as new:
            new.write_text(replace(calibration, stored_timing=stored).to_yaml(), encoding="utf-8")
        print(f"written to {path}")
    return 0


def describe(estimate: TimingEstimate) -> str:
    """What was found, and how far it can be believed, in lines."""
    gain = 1.0 - estimate.cost / estimate.uncorrected if estimate.uncorrected > 0 else 0.0
    return "\n".join(
        [
            f"cost         {estimate.uncorrected:.4f} uncorrected, {estimate.cost:.4f} at its lowest ({gain:.0%} less)",
            f"depth delay  {_value(estimate.depth_delay)}",
            f"readout      {_value(estimate.readout)}",
        ]
    )


def _value(one: Estimate) -> str:
    if one.at_edge:
        return f"not determined: the cost still falls at {1000 * one.seconds:.0f} ms"
    spread = f"{1000 * one.spread:.1f} ms to either side raise the cost by 1 %"
    if not one.is_determined:
        return f"not determined: the recording moves too little to tell ({spread})"
    return f"{1000 * one.seconds:.1f} ms ({spread})"


def _report(count: int) -> None:
    print(f"\r{count} hypotheses tried", end="", file=sys.stderr, flush=True)
