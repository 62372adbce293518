"""``warpslam render``."""

from __future__ import annotations

import argparse
from typing import Any

from warpslam.cli.common import add_command, add_device_option, quiet_warp


def add(commands: Any) -> None:
    """Add the command."""
    render = add_command(commands, "render", _render, "a frame beside what the map renders at its pose, as PNG")
    render.add_argument("run", metavar="RUN", help="run folder")
    render.add_argument("--frame", type=int, required=True, metavar="N", help="number of the frame in its sequence")
    add_device_option(render)
    render.add_argument("-o", "--output", metavar="FILE", help="PNG file (default: RUN/render_N.png)")


def _render(options: argparse.Namespace) -> int:
    from warpslam.pipeline.finished import render_frame
    from warpslam.runs.folder import RunFolder

    quiet_warp()
    print(render_frame(RunFolder.open(options.run), options.frame, options.output, options.device))
    return 0
