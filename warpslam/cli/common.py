"""What the commands share: options, progress, and how figures are printed."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from warpslam.cli.examples import epilog
from warpslam.cli.exit_codes import EXIT_INTERRUPTED as EXIT_INTERRUPTED
from warpslam.config import Config
from warpslam.errors import ConfigError
from warpslam.pipeline.log import OneRecord
from warpslam.pipeline.methods import DEFAULT_METHOD, METHODS
from warpslam.pipeline.observer import Observer
from warpslam.runs.metrics import Reconstruction, Rendering
from warpslam.runs.request import ALL_FRAMES, Slice, parse_slice


def add_command(commands: Any, name: str, function: Callable[[argparse.Namespace], int], text: str) -> Any:
    """Add a command that ``function`` carries out; it returns the exit code."""
    description = text[0].upper() + text[1:] + "."
    parser = commands.add_parser(name, help=text, description=description, epilog=epilog(name))
    parser.set_defaults(command=function, parser=parser)
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    return parser


def add_sequence_options(parser: argparse.ArgumentParser) -> None:
    """How to read a folder, and which frames and settings to use."""
    add_format_options(parser)
    parser.add_argument("--preset", help="settings to start from (default: the dataset's)")
    parser.add_argument("--frames", type=parse_frames, metavar="A:B:STEP", help="frames to use, as in a Python slice")


def add_format_options(parser: argparse.ArgumentParser) -> None:
    """How to read a folder."""
    parser.add_argument("--dataset", default="auto", help="format of the folder (default: told from its file names)")
    parser.add_argument(
        "--topics", metavar="COLOR,DEPTH[,POSES]", help="topics of a bag (default: told from their names)"
    )
    parser.add_argument("--camera", metavar="FX,FY,CX,CY,WIDTH,HEIGHT,DEPTH_SCALE", help="camera, not the dataset's")


def add_device_option(parser: argparse.ArgumentParser) -> None:
    """Where Warp computes."""
    parser.add_argument("--device", help="cpu, cuda:0, ... (default: a GPU if there is one)")


def add_view_address(parser: argparse.ArgumentParser, name: str) -> None:
    """Where a page is served."""
    parser.add_argument(
        name, dest="address", default="", metavar="HOST:PORT",
        help="where the page is served (localhost:8080); 0.0.0.0:8080 lets the whole network look on",
    )  # fmt: skip


def add_view_options(parser: argparse.ArgumentParser) -> None:
    """Looking on while a run goes on."""
    parser.add_argument("--view", action="store_true", help="look on in the browser (pip install viser)")
    add_view_address(parser, "--view-at")
    parser.add_argument("--record", metavar="FILE.rrd", help="record it for Rerun (pip install rerun-sdk)")
    add_log_option(parser)


def add_log_option(parser: argparse.ArgumentParser) -> None:
    """Figures for other tools."""
    parser.add_argument("--log", metavar="WHERE", help="figures to tensorboard:FOLDER or wandb:PROJECT")


def viewers(options: argparse.Namespace) -> list[Observer]:
    """Those that the options ask for."""
    found: list[Observer] = []
    if options.view or options.address:
        from warpslam.viewer.live import LiveView
        from warpslam.viewer.page import Address, require_viser

        require_viser()
        found.append(LiveView(Address.parse(options.address), lambda url: print(f"view        {url}", flush=True)))
    if options.record:
        from warpslam.viewer.recording import RerunRecording

        found.append(RerunRecording(options.record))
    if options.log:
        from warpslam.viewer.figures import FigureLog

        found.append(FigureLog(options.log))
    return found


def add_run_options(parser: argparse.ArgumentParser, output: str = "run folder (default: runs/NAME/TIME)") -> None:
    """Options of everything that writes a run folder."""
    add_slam_options(parser)
    parser.add_argument("-o", "--output", metavar="DIR", help=output)


class Overrides(argparse.Action):
    """Takes KEY=VALUE words; one that is none is most likely the folder, which this option must not swallow."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
        """Add them to those that are there."""
        takes_a_folder = any(action.dest in ("folder", "folders") for action in parser._actions)
        for value in values:
            if "=" not in value and takes_a_folder:
                parser.error(
                    f"{option_string} {value}: is no KEY=VALUE; if it is the folder, name it before {option_string}"
                )
        setattr(namespace, self.dest, [*getattr(namespace, self.dest), *values])


def add_set_option(parser: argparse.ArgumentParser) -> None:
    """Single settings."""
    parser.add_argument(
        "--set", dest="overrides", nargs="+", action=Overrides, default=[], metavar="KEY=VALUE",
        help="settings, such as mapping.iterations=30",
    )  # fmt: skip


def add_slam_options(parser: argparse.ArgumentParser) -> None:
    """Options of everything that runs SLAM."""
    add_set_option(parser)
    parser.add_argument("--decoders", metavar="FILE", help="decoder checkpoint (default: the package's own)")
    add_device_option(parser)
    parser.add_argument("--seed", type=int, default=0, help="seed of every random choice (0)")


def add_method_option(parser: argparse.ArgumentParser) -> None:
    """Which method runs."""
    parser.add_argument("--method", choices=METHODS, default=DEFAULT_METHOD, help=f"what runs ({DEFAULT_METHOD})")


def add_config_option(parser: argparse.ArgumentParser) -> None:
    """A file of settings in place of a preset."""
    parser.add_argument("--config", metavar="FILE", help="settings to start from, such as the config.yaml of a run")


def read_config(options: argparse.Namespace) -> Config | None:
    """The settings of ``--config``; None without.

    Raises:
        ConfigError: The file can't be read, a field of it does not fit, or there is a preset as well.
    """
    if options.config is None:
        return None
    if options.preset:
        raise ConfigError("--config does not go with --preset: the file has all settings; use --set on top of it")
    return Config.load(options.config)


def slice_of(frames: slice | None) -> Slice:
    """The parts of ``--frames``; None is for all."""
    return ALL_FRAMES if frames is None else (frames.start, frames.stop, frames.step)


def parse_frames(text: str) -> slice:
    """A slice of frames from A:B or A:B:STEP."""
    try:
        return slice(*parse_slice(text))
    except ConfigError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


@contextmanager
def warnings_on_stderr() -> Iterator[None]:
    """Show the package's warnings on standard error."""
    handler = logging.StreamHandler()
    handler.setLevel(logging.WARNING)
    handler.setFormatter(OneRecord("%(levelname)s: %(message)s"))
    # An error that ends the run is printed once, by main.
    handler.addFilter(lambda record: record.exc_info is None)
    logger = logging.getLogger("warpslam")
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)


def print_reconstruction(*protocols: Reconstruction) -> None:
    """Print a table of reconstruction metrics, a line for each protocol."""
    columns = ("accuracy", "completion", "< 5 cm", "F-score", "normals", "depth L1", "missed")
    print(f"{'surface':26}" + "".join(f"{name:>12}" for name in columns))
    for figures in protocols:
        cells = [
            _scaled(figures.accuracy_m, 100, "cm"),
            _scaled(figures.completion_m, 100, "cm"),
            _scaled(figures.completion_ratio_5cm, 100, "%"),
            _scaled(figures.f_score_5cm, 100, "%"),
            _scaled(figures.normal_consistency, 1, ""),
            _scaled(figures.depth_l1_m, 100, "cm"),
            _scaled(figures.virtual_views.missed_share, 100, "%"),
        ]
        print(f"{figures.protocol or '-':26}" + "".join(f"{cell:>12}" for cell in cells))


def print_rendering(figures: Rendering) -> None:
    """Print how alike renderings and input are."""
    print(
        f"rendering   depth L1 {_scaled(figures.depth_l1_m, 100, 'cm')}, PSNR {figures.psnr_db:.1f} dB, "
        f"SSIM {_scaled(figures.ssim, 1, '')}, {len(figures.frames)} frames"
    )


def _scaled(value: float | None, scale: float, unit: str) -> str:
    return "-" if value is None or value != value else f"{scale * value:.2f} {unit}".rstrip()


def quiet_warp() -> None:
    """Keep Warp's lines about devices and modules out of the output; its warnings stay."""
    import warp as wp

    wp.config.log_level = wp.LOG_WARNING
