"""``warpslam run`` and ``warpslam demo``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from warpslam.cli.common import (
    EXIT_INTERRUPTED,
    add_command,
    add_method_option,
    add_run_options,
    add_sequence_options,
    print_reconstruction,
    print_rendering,
    quiet_warp,
    warnings_on_stderr,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

    from warpslam.config import Config
    from warpslam.runs.record import Progress, RunResult
    from warpslam.runs.request import Source
    from warpslam.runtime.compilation import ModuleProgress
    from warpslam.sequences.base import RgbdSequence

_PLAIN_LINES = 20


def add(commands: Any) -> None:
    """Add both commands."""
    run = add_command(commands, "run", _run, "trajectory and coloured mesh of a folder of RGB-D frames")
    what = run.add_mutually_exclusive_group(required=True)
    what.add_argument("folder", nargs="?", metavar="FOLDER", help="folder of one sequence")
    what.add_argument("--resume", metavar="RUN", help="go on with a run that was stopped, from its last checkpoint")
    add_sequence_options(run)
    run.add_argument(
        "--gt-mesh", "--truth-mesh", dest="truth_mesh", metavar="FILE", help="true surface, for reconstruction metrics"
    )
    run.add_argument("--map", metavar="FILE", help="start from the map of another run (its folder, or the file)")
    run.add_argument("--localize", action="store_true", help="with --map: only track the camera, leave the map alone")
    run.add_argument("--no-check", action="store_true", help="run even if the checks of the input find an error")
    add_method_option(run)
    _add_poses_option(run)
    _add_checkpoint_option(run)
    add_run_options(run)

    demo = add_command(commands, "demo", _demo, "SLAM in a small rendered room; needs no data")
    add_method_option(demo)
    _add_poses_option(demo)
    _add_checkpoint_option(demo)
    add_run_options(demo)


def _add_poses_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--poses", metavar="FILE", help="take the poses of this TUM trajectory, such as an earlier run's, as given"
    )


def _add_checkpoint_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--checkpoint-every", type=int, metavar="N", help="write a checkpoint every N frames, for --resume"
    )


def _run(options: argparse.Namespace) -> int:
    from warpslam.config import Config
    from warpslam.errors import ConfigError
    from warpslam.evaluation import load_mesh
    from warpslam.pipeline.finished import open_source
    from warpslam.runs.folder import RunFolder
    from warpslam.runs.request import Source
    from warpslam.slam_state import saved_config

    quiet_warp()
    if options.resume is not None:
        return _resume(options)
    path = str(Path(options.folder).expanduser().resolve())
    source = Source(path, options.dataset, options.camera, options.command_line)
    sequence = open_source(source)
    map_path = None
    if options.map is not None:
        if options.preset or options.decoders:
            raise ConfigError("--preset and --decoders do not go with --map, which has both; use --set")
        map_path = Path(options.map).expanduser().resolve()
        map_path = RunFolder(map_path).map if map_path.is_dir() else map_path
        config = saved_config(map_path).updated(options.overrides)
    else:
        config = Config.from_preset(options.preset or sequence.preset, options.overrides)
    truth_mesh = load_mesh(options.truth_mesh) if options.truth_mesh else None
    return _execute(
        sequence,
        config,
        source,
        options,
        frames=options.frames,
        truth_mesh=truth_mesh,
        map_path=map_path,
        localize_only=options.localize,
        check_input=not options.no_check,
    )


def _resume(options: argparse.Namespace) -> int:
    """Everything is as the checkpoint says; an option that says otherwise is refused by the run."""
    from warpslam.config import Config
    from warpslam.errors import ConfigError
    from warpslam.evaluation import load_mesh
    from warpslam.pipeline.checkpoints import read_checkpoint
    from warpslam.pipeline.finished import open_source
    from warpslam.runs.folder import RunFolder

    for name in ("preset", "map", "localize", "output", "camera", "decoders"):
        if getattr(options, name):
            raise ConfigError(f"--{name} does not go with --resume: it is as when the run was started")
    with warnings_on_stderr():
        saved = read_checkpoint(RunFolder(options.resume))
    request = saved.request
    sequence = open_source(saved.source)
    if options.truth_mesh:
        truth_mesh = load_mesh(options.truth_mesh)
    else:
        truth_mesh = sequence.mesh if saved.source.path is None else None
    options.output = options.resume
    options.device = options.device or request.device
    options.seed = options.seed or request.seed
    options.poses = options.poses or request.poses
    options.checkpoint_every = options.checkpoint_every or saved.checkpoint_every
    return _execute(
        sequence,
        Config.from_dict(request.config).updated(options.overrides),
        saved.source,
        options,
        frames=options.frames or slice(*request.frames),
        truth_mesh=truth_mesh,
        map_path=request.map,
        localize_only=request.localize_only,
        saved=saved,
    )


def _demo(options: argparse.Namespace) -> int:
    from warpslam.config import Config
    from warpslam.runs.request import Source
    from warpslam.synthetic import demo

    quiet_warp()
    config = Config.from_preset(demo.PRESET, [*demo.OVERRIDES, *options.overrides])
    sequence = demo.demo_sequence()
    return _execute(sequence, config, Source(None, command=options.command_line), options, truth_mesh=sequence.mesh)


def _execute(
    sequence: RgbdSequence, config: Config, source: Source, options: argparse.Namespace, **keywords: Any
) -> int:
    from warpslam.pipeline.run import run

    config = config.with_files(options.decoders, options.poses)
    with warnings_on_stderr(), _progress(sequence.name) as (on_frame, on_module):
        result = run(
            sequence,
            config,
            options.output,
            device=options.device,
            seed=options.seed,
            source=source,
            on_frame=on_frame,
            on_module=on_module,
            method=options.method,
            poses=options.poses,
            checkpoint_every=options.checkpoint_every,
            **keywords,
        )
    _print_summary(result)
    return EXIT_INTERRUPTED if result.status == "interrupted" else 0


@contextmanager
def _progress(name: str) -> Iterator[tuple[Callable[[Progress], None], Callable[[ModuleProgress], None]]]:
    """What shows frames, and modules that are compiled: a progress bar on a terminal, about twenty lines anywhere
    else.
    """
    if not sys.stdout.isatty():
        print(f"{name}: loading kernels, then mapping the first frame", flush=True)
        yield _print_line, _print_module
        return
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    columns = (
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(),
        TextColumn("{task.fields[figures]}"), TextColumn("left"), TimeRemainingColumn(),
    )  # fmt: skip
    # rich redirects stdout and stderr while the bar is up, so warnings appear above it.
    with Bar(*columns) as bar:
        task = bar.add_task(name, total=None, figures="loading kernels")

        def show(progress: Progress) -> None:
            if progress.done >= progress.total:
                figures = f"{_figures(progress)}  writing results"
            else:
                figures = _figures(progress)
            bar.update(task, total=progress.total, completed=progress.done, figures=figures)

        def show_module(module: ModuleProgress) -> None:
            figures = _compiling(module) if module.compiled else "loading kernels"
            if module.done == module.total:
                figures = "mapping the first frame"
            bar.update(task, total=module.total, completed=module.done, figures=figures)

        yield show, show_module


def _print_module(module: ModuleProgress) -> None:
    if module.compiled and module.seconds is None:
        print(_compiling(module), flush=True)


def _compiling(module: ModuleProgress) -> str:
    return f"compiling {module.name} (once a machine), {module.done} of {module.total} modules ready"


def _print_line(progress: Progress) -> None:
    from warpslam.report.text import duration

    every = max(1, progress.total // _PLAIN_LINES)
    if progress.done % every == 0 or progress.done in (1, progress.total):
        left = (progress.total - progress.done) / progress.fps
        print(f"frame {progress.done}/{progress.total}  {_figures(progress)}  {duration(left)} left", flush=True)


def _figures(progress: Progress) -> str:
    result = progress.result
    parts = [f"{progress.fps:.2f} fps", *(f"{name} {value:.3g}" for name, value in result.losses.items())]
    if progress.ate_rmse is not None:
        parts.append(f"ATE {100 * progress.ate_rmse:.2f} cm")
    if result.status != "OK":
        parts.append(result.status)
    return "  ".join(parts)


def _print_summary(result: RunResult) -> None:
    from warpslam.report.text import duration

    metrics = result.metrics
    frames, seconds = metrics["frames"], metrics["seconds"]
    counts = ", ".join(f"{frames[name]} {name}" for name in ("OK", "LOST", "SKIPPED", "unreadable") if frames[name])
    print(f"frames      {frames['processed']} of {frames['selected']} ({counts or 'none'}), {result.status}")
    fps = f", {metrics['fps']:.2f} frames/s" if metrics["fps"] else ""
    print(f"time        {duration(seconds['run'])}{fps}; compiling kernels {duration(seconds['kernel_compile'])}")
    if result.ate is not None:
        unaligned = metrics["ate_m"]["unaligned"]["rmse"]
        print(f"ATE RMSE    {100 * result.ate.rmse:.2f} cm aligned, {100 * unaligned:.2f} cm unaligned")
    mesh = metrics.get("mesh", {})
    size = metrics.get("map")
    if size:
        flops = size["flops_per_point"]
        cost = f", {flops:,} FLOP a point" if flops is not None else ""
        print(f"map         {size['bytes'] / 1e6:.2f} MB{cost}")
    if "faces" in mesh:
        print(f"mesh        {mesh['vertices']} vertices, {mesh['faces']} faces")
    if result.reconstruction is not None:
        print_reconstruction(metrics["reconstruction"])
    rendering = metrics.get("rendering")
    if rendering:
        print_rendering(rendering)
    print(f"written to  {result.folder.path}")
