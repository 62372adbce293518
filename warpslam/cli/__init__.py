"""The ``warpslam`` command: a module for each command, which reads arguments, calls the library and prints."""

from __future__ import annotations

import argparse
import os
import shlex
import sys
from collections.abc import Sequence

from warpslam import __version__
from warpslam.cli import batch, bench, check, evaluate, info, mesh, profile, render, report, run, warmup
from warpslam.cli.common import EXIT_ERROR, EXIT_INTERRUPTED
from warpslam.errors import WarpSlamError

COMMANDS = (run, batch, bench, check, evaluate, report, render, mesh, profile, warmup, info)
"""Modules with a function ``add(commands)``, in the order of ``warpslam --help``."""


def entry_point() -> None:
    """Console script."""
    sys.exit(main())


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code: 0, 2 after an error in the input, 130 after ctrl-C."""
    options = _parser().parse_args(arguments)
    options.command_line = shlex.join(["warpslam", *(sys.argv[1:] if arguments is None else arguments)])
    try:
        code = options.command(options)
        sys.stdout.flush()
        return code
    except WarpSlamError as error:
        if options.debug:
            raise
        print(f"warpslam: {error}", file=sys.stderr)
        return EXIT_ERROR
    except BrokenPipeError:  # the reader of our output has gone, as in "| head"
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_ERROR
    except OSError as error:
        if options.debug:
            raise
        print(f"warpslam: {error.filename or 'output'}: {error.strerror or error}", file=sys.stderr)
        return EXIT_ERROR
    except KeyboardInterrupt:
        print("warpslam: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="warpslam", description="Dense RGB-D SLAM with a neural implicit map (NICE-SLAM) in NVIDIA Warp."
    )
    parser.add_argument("--version", action="version", version=f"warpslam {__version__}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    for module in COMMANDS:
        module.add(commands)
    return parser
