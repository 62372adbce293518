"""``warpslam export``."""

from __future__ import annotations

import argparse
from typing import Any

from warpslam.cli.common import add_command, quiet_warp
from warpslam.cli.progress import working
from warpslam.storage.trajectory_files import TRAJECTORY_FORMATS


def add(commands: Any) -> None:
    """Add the command."""
    export = add_command(commands, "export", _export, "the trajectory of a run in the format of another tool")
    export.add_argument("run", metavar="RUN", help="run folder")
    export.add_argument(
        "format", choices=TRAJECTORY_FORMATS, metavar="FORMAT",
        help=f"{', '.join(TRAJECTORY_FORMATS)}; transforms (nerfstudio) and colmap come with the images",
    )  # fmt: skip
    export.add_argument("-o", "--output", metavar="PATH", help="file or folder (default: in RUN, named by the format)")


def _export(options: argparse.Namespace) -> int:
    from warpslam.pipeline.export import export_run
    from warpslam.runs.folder import RunFolder

    quiet_warp()
    with working("exporting"):
        path = export_run(RunFolder.open(options.run), options.format, options.output)
    print(path)
    return 0
