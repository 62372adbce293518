"""The ``warpslam`` command. Reads arguments, calls the library, prints; nothing else happens here."""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Callable, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from warpslam import __version__
from warpslam.errors import WarpSlamError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from warpslam.config import Config
    from warpslam.pipeline import Progress, RunResult
    from warpslam.run_folder import Source
    from warpslam.sequences.base import RgbdSequence

EXIT_ERROR = 2
EXIT_INTERRUPTED = 130
_PLAIN_LINES = 20


def entry_point() -> None:
    """Console script."""
    sys.exit(main())


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code: 0, 2 after an error in the input, 130 after ctrl-C."""
    options = _parser().parse_args(arguments)
    try:
        return options.command(options)
    except WarpSlamError as error:
        if options.debug:
            raise
        print(f"warpslam: {error}", file=sys.stderr)
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

    run = _command(commands, "run", _run, "trajectory and coloured mesh of a folder of RGB-D frames")
    run.add_argument("folder", metavar="FOLDER", help="folder of one sequence")
    run.add_argument("--dataset", default="auto", help="format of the folder (default: told from its file names)")
    run.add_argument("--camera", metavar="FX,FY,CX,CY,WIDTH,HEIGHT,DEPTH_SCALE", help="camera, not the dataset's")
    run.add_argument("--preset", help="settings to start from (default: the dataset's)")
    run.add_argument("--frames", type=parse_frames, metavar="A:B:STEP", help="frames to use, as in a Python slice")
    run.add_argument("--truth-mesh", metavar="FILE", help="true surface, for the reconstruction metrics")
    _add_run_options(run)

    demo = _command(commands, "demo", _demo, "SLAM in a small rendered room; needs no data")
    _add_run_options(demo)

    evaluate = _command(commands, "eval", _eval, "trajectory and reconstruction errors of a run")
    evaluate.add_argument("run", metavar="RUN", help="run folder")
    evaluate.add_argument("--truth", metavar="FILE", help="TUM trajectory to compare with (default: the run's own)")
    evaluate.add_argument("--max-difference", type=float, default=0.02, metavar="S", help="for pairing [s] (0.02)")
    evaluate.add_argument("--truth-mesh", metavar="FILE", help="true surface to compare the mesh with")
    evaluate.add_argument("--json", action="store_true", help="print JSON")

    render = _command(commands, "render", _render, "a frame beside what the map renders at its pose, as PNG")
    render.add_argument("run", metavar="RUN", help="run folder")
    render.add_argument("--frame", type=int, required=True, metavar="N", help="number of the frame in its sequence")
    render.add_argument("--device", help="cpu, cuda:0, ... (default: a GPU if there is one)")
    render.add_argument("-o", "--output", metavar="FILE", help="PNG file (default: RUN/render_N.png)")

    mesh = _command(commands, "mesh", _mesh, "extract the mesh of a run again")
    mesh.add_argument("run", metavar="RUN", help="run folder")
    mesh.add_argument("--voxel", type=float, metavar="M", help="edge of a marching-cubes cell [m]")
    mesh.add_argument("--device", help="cpu, cuda:0, ... (default: a GPU if there is one)")
    mesh.add_argument("-o", "--output", metavar="FILE", help="PLY file (default: RUN/mesh.ply)")

    info = _command(commands, "info", _info, "versions, devices, decoders, dataset formats and presets")
    info.add_argument("--decoders", metavar="FILE", help="decoder checkpoint (default: the package's own)")
    return parser


def _command(commands: Any, name: str, function: Callable[[argparse.Namespace], int], text: str) -> Any:
    parser = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
    parser.set_defaults(command=function)
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    return parser


def _add_run_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--set", dest="overrides", nargs="+", action="extend", default=[], metavar="KEY=VALUE",
        help="settings, such as mapping.iterations=30",
    )  # fmt: skip
    parser.add_argument("--decoders", metavar="FILE", help="decoder checkpoint (default: the package's own)")
    parser.add_argument("--device", help="cpu, cuda:0, ... (default: a GPU if there is one)")
    parser.add_argument("--seed", type=int, default=0, help="seed of every random choice (0)")
    parser.add_argument("-o", "--output", metavar="DIR", help="run folder (default: runs/NAME/TIME)")


def parse_frames(text: str) -> slice:
    """A slice of frames from A:B or A:B:STEP."""
    try:
        parts = [int(part) if part.strip() else None for part in text.split(":")]
    except ValueError:
        parts = []
    if not 2 <= len(parts) <= 3:
        raise argparse.ArgumentTypeError(f"{text!r} is not A:B or A:B:STEP, for example 0:200 or ::2")
    return slice(*parts)


def _run(options: argparse.Namespace) -> int:
    from warpslam.config import Config
    from warpslam.pipeline import load_mesh
    from warpslam.revisit import open_source
    from warpslam.run_folder import Source

    _quiet_warp()
    source = Source(str(Path(options.folder).expanduser().resolve()), options.dataset, options.camera)
    sequence = open_source(source)
    config = Config.from_preset(options.preset or sequence.preset, options.overrides)
    truth_mesh = load_mesh(options.truth_mesh) if options.truth_mesh else None
    return _execute(sequence, config, source, options, frames=options.frames, truth_mesh=truth_mesh)


def _demo(options: argparse.Namespace) -> int:
    from warpslam import demo
    from warpslam.config import Config
    from warpslam.run_folder import Source

    _quiet_warp()
    config = Config.from_preset(demo.PRESET, [*demo.OVERRIDES, *options.overrides])
    sequence = demo.demo_sequence()
    return _execute(sequence, config, Source(None), options, truth_mesh=sequence.mesh)


def _execute(
    sequence: RgbdSequence, config: Config, source: Source, options: argparse.Namespace, **keywords: Any
) -> int:
    from warpslam.pipeline import run

    if options.decoders:
        config = config.model_copy(update={"decoders": options.decoders})
    with _warnings_on_stderr(), _progress(sequence.name) as on_frame:
        result = run(
            sequence,
            config,
            options.output,
            device=options.device,
            seed=options.seed,
            source=source,
            on_frame=on_frame,
            **keywords,
        )
    _print_summary(result)
    return EXIT_INTERRUPTED if result.status == "interrupted" else 0


@contextmanager
def _warnings_on_stderr() -> Iterator[None]:
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


@contextmanager
def _progress(name: str) -> Iterator[Callable[[Progress], None]]:
    """A progress bar on a terminal, about twenty lines anywhere else."""
    if not sys.stdout.isatty():
        print(f"{name}: compiling kernels (once a machine), then mapping the first frame", flush=True)
        yield _print_line
        return
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    columns = (
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(),
        TextColumn("{task.fields[figures]}"), TextColumn("left"), TimeRemainingColumn(),
    )  # fmt: skip
    # rich redirects stdout and stderr while the bar is up, so warnings appear above it.
    with Bar(*columns) as bar:
        task = bar.add_task(name, total=None, figures="compiling kernels (once), mapping the first frame")

        def show(progress: Progress) -> None:
            if progress.done >= progress.total:
                figures = f"{_figures(progress)}  writing results"
            else:
                figures = _figures(progress)
            bar.update(task, total=progress.total, completed=progress.done, figures=figures)

        yield show


def _print_line(progress: Progress) -> None:
    every = max(1, progress.total // _PLAIN_LINES)
    if progress.done % every == 0 or progress.done in (1, progress.total):
        left = (progress.total - progress.done) / progress.fps
        print(f"frame {progress.done}/{progress.total}  {_figures(progress)}  {_duration(left)} left", flush=True)


def _figures(progress: Progress) -> str:
    result = progress.result
    parts = [f"{progress.fps:.2f} fps", *(f"{name} {value:.3g}" for name, value in result.losses.items())]
    if progress.ate_rmse is not None:
        parts.append(f"ATE {100 * progress.ate_rmse:.2f} cm")
    if result.status != "OK":
        parts.append(result.status)
    return "  ".join(parts)


def _print_summary(result: RunResult) -> None:
    metrics = result.metrics
    frames, seconds = metrics["frames"], metrics["seconds"]
    counts = ", ".join(f"{frames[name]} {name}" for name in ("OK", "LOST", "SKIPPED", "unreadable") if frames[name])
    print(f"frames      {frames['processed']} of {frames['selected']} ({counts or 'none'}), {result.status}")
    fps = f", {metrics['fps']:.2f} frames/s" if metrics["fps"] else ""
    print(f"time        {_duration(seconds['run'])}{fps}; compiling kernels {_duration(seconds['kernel_compile'])}")
    if result.ate is not None:
        unaligned = metrics["ate_m"]["unaligned"]["rmse"]
        print(f"ATE RMSE    {100 * result.ate.rmse:.2f} cm aligned, {100 * unaligned:.2f} cm unaligned")
    mesh = metrics.get("mesh", {})
    if "faces" in mesh:
        print(f"mesh        {mesh['vertices']} vertices, {mesh['faces']} faces")
    if result.reconstruction is not None:
        _print_reconstruction(metrics["reconstruction"])
    rendering = metrics.get("rendering")
    if rendering:
        print(f"rendering   depth L1 {100 * rendering['depth_l1_m']:.2f} cm, PSNR {rendering['psnr_db']:.1f} dB")
    print(f"written to  {result.folder.path}")


def _print_reconstruction(figures: dict[str, Any]) -> None:
    print(
        f"surface     accuracy {100 * figures['accuracy_m']:.2f} cm, "
        f"completion {100 * figures['completion_m']:.2f} cm, "
        f"{100 * figures['completion_ratio_5cm']:.1f} % within 5 cm"
    )


def _eval(options: argparse.Namespace) -> int:
    from warpslam.revisit import evaluate_run
    from warpslam.run_folder import RunFolder, to_json

    metrics = evaluate_run(
        RunFolder.open(options.run),
        options.truth,
        max_difference=options.max_difference,
        truth_mesh=options.truth_mesh,
    )
    if options.json:
        print(to_json(metrics))
        return 0
    rows = [("ATE aligned", 100, "cm", metrics["ate_m"]["aligned"])]
    rows.append(("ATE unaligned", 100, "cm", metrics["ate_m"]["unaligned"]))
    if "rpe" in metrics:
        rows.append(("RPE translation", 100, "cm", metrics["rpe"]["translation_m"]))
        rows.append(("RPE rotation", 1, "deg", metrics["rpe"]["rotation_deg"]))
    for name, scale, unit, values in rows:
        rest = "  ".join(f"{key} {scale * values[key]:.3f}" for key in ("mean", "median", "max"))
        print(f"{name:16} RMSE {scale * values['rmse']:.3f} {unit}  {rest}")
    print(f"{'frames':16} {metrics['frames']['compared']} of {metrics['frames']['estimated']} compared")
    if "reconstruction" in metrics:
        _print_reconstruction(metrics["reconstruction"])
    return 0


def _render(options: argparse.Namespace) -> int:
    from warpslam.revisit import render_frame
    from warpslam.run_folder import RunFolder

    _quiet_warp()
    print(render_frame(RunFolder.open(options.run), options.frame, options.output, options.device))
    return 0


def _mesh(options: argparse.Namespace) -> int:
    from warpslam.revisit import extract_mesh
    from warpslam.run_folder import RunFolder

    _quiet_warp()
    mesh, path = extract_mesh(RunFolder.open(options.run), options.voxel, options.output, options.device)
    print(f"{path}: {len(mesh.vertices)} vertices, {len(mesh.faces)} faces")
    return 0


def _info(options: argparse.Namespace) -> int:
    import platform
    from importlib.metadata import PackageNotFoundError, version

    from warpslam.config import PRESETS
    from warpslam.decoders import DEFAULT_PATH, load_decoders
    from warpslam.sequences import DATASETS

    print(f"warpslam    {__version__}, Python {platform.python_version()}, {platform.platform()}")
    for package in ("warp-lang", "torch", "numpy", "trimesh", "opencv-python-headless", "open3d"):
        try:
            print(f"{package:11} {version(package)}")
        except PackageNotFoundError:
            print(f"{package:11} not installed")
    print(f"devices     {', '.join(_device_names())}")
    widths = {weights.level: weights.hidden for weights in load_decoders(options.decoders)}
    print(f"decoders    {options.decoders or DEFAULT_PATH}, hidden width {widths}")
    print(f"datasets    {', '.join(DATASETS)}")
    print(f"presets     {', '.join(PRESETS)}")
    return 0


def _device_names() -> list[str]:
    import warp as wp

    _quiet_warp()
    return [f"{device} ({device.name})" for device in wp.get_devices()]


def _quiet_warp() -> None:
    """Keep Warp's lines about devices and modules out of the output; its warnings stay."""
    import warp as wp

    wp.config.log_level = wp.LOG_WARNING


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes else f"{seconds:.1f} s"
