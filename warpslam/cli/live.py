"""``warpslam live``."""

from __future__ import annotations

import argparse
from datetime import datetime
from pathlib import Path
from typing import Any

from warpslam.cli.common import add_command, add_run_options, add_view_options, quiet_warp, viewers, warnings_on_stderr
from warpslam.errors import ConfigError

CAMERAS = ("realsense", "record3d")


def add(commands: Any) -> None:
    """Add the command."""
    live = add_command(commands, "live", _live, "SLAM on a camera that is plugged in; ctrl-C ends it and writes all")
    add_view_options(live)
    live.add_argument("camera", choices=CAMERAS, metavar="CAMERA", help=" or ".join(CAMERAS))
    live.add_argument("--size", default="640x480", metavar="WxH", help="images of a RealSense (640x480)")
    live.add_argument("--rate", type=int, default=30, metavar="HZ", help="images a second of a RealSense (30)")
    live.add_argument("--max-frames", type=int, metavar="N", help="end after so many frames")
    live.add_argument("--preset", help="settings to start from (default)")
    add_run_options(
        live, "run folder (default: runs/live/TIME); the frames that are used are kept beside it, in DIR-recording"
    )


def _live(options: argparse.Namespace) -> int:
    from warpslam.cli.run import show_run
    from warpslam.pipeline.live import run_live
    from warpslam.sequences.live import MAX_FRAMES

    quiet_warp()
    output = Path(options.output or Path("runs") / "live" / datetime.now().strftime("%Y%m%d-%H%M%S"))
    with warnings_on_stderr():
        camera = _camera(options)
        return show_run(
            lambda observer: run_live(
                camera,
                output,
                preset=options.preset,
                overrides=tuple(options.overrides),
                decoders=options.decoders,
                device=options.device,
                seed=options.seed,
                max_frames=options.max_frames or MAX_FRAMES,
                observer=observer,
            ),
            viewers(options),
        )


def _camera(options: argparse.Namespace) -> Any:
    if options.camera == "record3d":
        from warpslam.sequences.live_record3d import Record3dCamera

        return Record3dCamera()
    from warpslam.sequences.live_realsense import RealSenseCamera

    try:
        width, height = (int(part) for part in options.size.lower().split("x"))
    except ValueError as error:
        raise ConfigError(f"--size {options.size}: give WIDTHxHEIGHT, for example 640x480") from error
    return RealSenseCamera((width, height), options.rate)
