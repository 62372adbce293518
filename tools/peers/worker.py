"""One peer on one folder, in a process of its own; `python -m tools.peers` starts it."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from tools.peers.recording import Account, Recording
from tools.peers.systems import PEERS
from warpslam.errors import WarpSlamError


def main(arguments: list[str] | None = None) -> int:
    """Run and write the run's folder."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("system", choices=tuple(PEERS))
    parser.add_argument("folder", help="sequence")
    parser.add_argument("out", type=Path, help="folder to write")
    parser.add_argument("--frames", metavar="A:B:STEP")
    parser.add_argument("--depth-range", type=float, metavar="M", help="depth beyond is not used [m]")
    parser.add_argument("--no-mesh", action="store_true")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    try:
        recording = Recording(options.folder, options.frames, options.depth_range)
    except WarpSlamError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    account = Account(recording, options.out)
    PEERS[options.system].load()(recording, account, not options.no_mesh)
    account.write()
    return 0


if __name__ == "__main__":
    sys.exit(main())
