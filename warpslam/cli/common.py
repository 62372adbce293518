"""What the commands share: options, progress, and how figures are printed."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Callable
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterator

EXIT_ERROR = 2
EXIT_INTERRUPTED = 130


def add_command(commands: Any, name: str, function: Callable[[argparse.Namespace], int], text: str) -> Any:
    """Add a command that ``function`` carries out; it returns the exit code."""
    parser = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
    parser.set_defaults(command=function)
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    return parser


def add_run_options(parser: argparse.ArgumentParser, output: str = "run folder (default: runs/NAME/TIME)") -> None:
    """Options of everything that runs SLAM."""
    parser.add_argument(
        "--set", dest="overrides", nargs="+", action="extend", default=[], metavar="KEY=VALUE",
        help="settings, such as mapping.iterations=30",
    )  # fmt: skip
    parser.add_argument("--decoders", metavar="FILE", help="decoder checkpoint (default: the package's own)")
    parser.add_argument("--device", help="cpu, cuda:0, ... (default: a GPU if there is one)")
    parser.add_argument("--seed", type=int, default=0, help="seed of every random choice (0)")
    parser.add_argument("-o", "--output", metavar="DIR", help=output)


def parse_frames(text: str) -> slice:
    """A slice of frames from A:B or A:B:STEP."""
    from warpslam.batch_manifest import parse_slice
    from warpslam.errors import ConfigError

    try:
        return slice(*parse_slice(text))
    except ConfigError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


@contextmanager
def warnings_on_stderr() -> Iterator[None]:
    """Show the package's warnings on standard error."""
    handler = logging.StreamHandler()
    handler.setLevel(logging.WARNING)
    handler.setFormatter(logging.Formatter("%(levelname)s: %(message)s"))
    # An error that ends the run is printed once, by main.
    handler.addFilter(lambda record: record.exc_info is None)
    logger = logging.getLogger("warpslam")
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)


def print_reconstruction(figures: dict[str, Any]) -> None:
    """Print reconstruction metrics, as `warpslam.pipeline.reconstruction_metrics` gives them."""
    print(
        f"surface     accuracy {100 * figures['accuracy_m']:.2f} cm, "
        f"completion {100 * figures['completion_m']:.2f} cm, "
        f"{100 * figures['completion_ratio_5cm']:.1f} % within 5 cm"
    )


def quiet_warp() -> None:
    """Keep Warp's lines about devices and modules out of the output; its warnings stay."""
    import warp as wp

    wp.config.log_level = wp.LOG_WARNING


def duration(seconds: float) -> str:
    """Seconds as text."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes else f"{seconds:.1f} s"
