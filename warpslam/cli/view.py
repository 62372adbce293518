"""``warpslam view``."""

from __future__ import annotations

import argparse
from typing import Any

from warpslam.cli.common import add_command, add_device_option, add_view_address, quiet_warp, warnings_on_stderr
from warpslam.cli.progress import working


def add(commands: Any) -> None:
    """Add the command."""
    view = add_command(commands, "view", _view, "a finished run in the browser: its mesh, path and images over time")
    view.add_argument("run", metavar="RUN", help="run folder")
    add_view_address(view, "--at")
    add_device_option(view)


def _view(options: argparse.Namespace) -> int:
    from warpslam.runs.folder import RunFolder
    from warpslam.viewer.finished import FinishedView
    from warpslam.viewer.page import Address

    quiet_warp()
    with warnings_on_stderr():
        address = Address.parse(options.address)
        with working("loading the run"):
            view = FinishedView(RunFolder.open(options.run), address, options.device)
        print(f"{view.page.url} (ctrl-C ends it)", flush=True)
        view.serve()
    return 0
