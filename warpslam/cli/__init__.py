"""The ``warpslam`` command: a module for each command, which reads arguments, calls the library and prints.

The module of a command is imported when that command is asked for, so that ``warpslam --help`` and the light commands
wait for neither torch nor Warp.
"""

from __future__ import annotations

import argparse
import importlib
import io
import os
import shlex
import sys
from collections.abc import Sequence

from warpslam import __version__
from warpslam.cli.exit_codes import EXIT_ERROR, EXIT_INTERRUPTED, EXIT_TERMINATED, EXIT_UNEXPECTED
from warpslam.cli.parsing import Parser, nearest
from warpslam.errors import WarpSlamError, brief, printable
from warpslam.runtime.stopping import Terminated, terminable, was_terminated

COMMANDS = {
    "run": ("run", "trajectory and coloured mesh of a folder of RGB-D frames"),
    "live": ("live", "SLAM on a camera that is plugged in; ctrl-C ends it and writes all"),
    "demo": ("run", "SLAM in a small rendered room; needs no data"),
    "batch": ("batch", "run many sequences, and go on where an earlier batch stopped"),
    "bench": ("bench", "the paper's studies on your sequences: tables, plots and a page"),
    "check": (
        "check",
        "whether a folder of RGB-D frames can be used, before a run; or whether that of a run is as the run left it",
    ),
    "eval": ("evaluate", "trajectory and reconstruction errors of a run"),
    "report": ("report", "HTML report of a run, or a comparison of several"),
    "view": ("view", "a finished run in the browser: its mesh, path and images over time"),
    "render": ("render", "a frame beside what the map renders at its pose, or the mesh along a path as a film"),
    "mesh": ("mesh", "extract the mesh of a run again"),
    "export": ("export", "the trajectory of a run in the format of another tool"),
    "calibrate-time": (
        "calibrate_time",
        "delay of depth and readout time of a camera, from a recording in which it moves",
    ),
    "profile": ("profile", "time of every kernel of a run; writes no run folder"),
    "render-room": ("render_room", "rendered rooms: RGB-D sequences with their truth, and pictures"),
    "warmup": ("warmup", "compile all kernels ahead of the first run"),
    "info": ("info", "versions, devices, decoders, dataset formats, presets and settings"),
    "completion": ("completion", "a script that completes commands in your shell"),
}
"""Commands in the order of ``warpslam --help``: the module here whose ``add(commands)`` adds them, and what they do."""


_EPILOG = """\
first steps:
  warpslam demo                 a run without data
  warpslam check FOLDER         whether a recording can be used
  warpslam run FOLDER --view    trajectory and mesh, watched in the browser

exit codes:
  0 done, 1 done with something to look at (check, batch, bench), 2 something
  that you can put right, 70 an error of the program, 130 ctrl-C, 143 SIGTERM"""


def entry_point() -> None:
    """Console script."""
    sys.exit(main())


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code: 0, 2 after an error in the input, 130 after ctrl-C, 143 after SIGTERM, 70
    after an error that nobody expected.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    # A name that is not UTF-8 is shown by its bytes; it must not end the program.
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    with terminable():
        code = _main(arguments)
        return EXIT_TERMINATED if code == EXIT_INTERRUPTED and was_terminated() else code


def _main(arguments: Sequence[str]) -> int:
    is_debugging = False
    try:
        options = _parser(arguments).parse_args(arguments)  # imports for seconds, in which ctrl-C may come
        options.command_line = shlex.join(["warpslam", *arguments])
        is_debugging = options.debug
        code: int = options.command(options)
        sys.stdout.flush()
        return code
    except BrokenPipeError:  # the reader of our output has gone, as in "| head"
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_ERROR
    except KeyboardInterrupt as error:
        print(f"warpslam: {'terminated' if isinstance(error, Terminated) else 'interrupted'}", file=sys.stderr)
        return EXIT_INTERRUPTED
    except Exception as error:
        if is_debugging:
            raise
        code, text = _told(error)
        print(f"warpslam: {printable(text)}", file=sys.stderr)
        return code


def _told(error: Exception) -> tuple[int, str]:
    """Exit code, and what is said in place of a traceback."""
    if isinstance(error, WarpSlamError):
        return EXIT_ERROR, str(error)
    if isinstance(error, MemoryError):
        return EXIT_ERROR, "out of memory: close other programs, or use smaller images or a coarser map"
    if isinstance(error, OSError) and (error.strerror or error.filename):
        return EXIT_ERROR, f"{error.filename or 'output'}: {error.strerror or error}"
    return EXIT_UNEXPECTED, f"unexpected {type(error).__name__}: {brief(error)} (--debug shows where it comes from)"


def _parser(arguments: Sequence[str]) -> argparse.ArgumentParser:
    """The parser with the options of the command that is asked for, and of the others their names alone."""
    parser = Parser(
        prog="warpslam",
        description="Dense RGB-D SLAM with a neural implicit map (NICE-SLAM) in NVIDIA Warp.",
        epilog=_EPILOG,
    )
    parser.add_argument("--version", action="version", version=f"warpslam {__version__}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    word = next((word for word in arguments if not word.startswith("-")), "")
    if word and word not in COMMANDS:
        meant = nearest(word, COMMANDS)
        hint = f"; did you mean {meant}?" if meant else "; all of them: warpslam --help"
        parser.exit(EXIT_ERROR, f"warpslam: there is no command {brief(word)!r}{hint}\n")
    wanted, _ = COMMANDS.get(word, ("", ""))
    for name, (module, text) in COMMANDS.items():
        if name in commands.choices:
            continue  # a module may add several commands
        if module == wanted:
            importlib.import_module(f"{__name__}.{module}").add(commands)
        else:
            commands.add_parser(name, help=text)
    return parser
