"""``warpslam run`` and ``warpslam demo``."""

from __future__ import annotations

import argparse
import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from warpslam.cli.common import (
    EXIT_INTERRUPTED,
    add_command,
    add_config_option,
    add_method_option,
    add_run_options,
    add_sequence_options,
    add_view_options,
    print_reconstruction,
    print_rendering,
    quiet_warp,
    read_config,
    slice_of,
    viewers,
    warnings_on_stderr,
)
from warpslam.cli.progress import run_display
from warpslam.errors import ConfigError
from warpslam.pipeline.checkpoints import read_checkpoint
from warpslam.pipeline.finished import is_finished
from warpslam.pipeline.observer import Observer, Observers
from warpslam.pipeline.run import run
from warpslam.report.text import duration
from warpslam.runs.folder import RunFolder
from warpslam.runs.record import INTERRUPTED
from warpslam.runs.request import RunRequest, Source
from warpslam.synthetic import demo

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from warpslam.runs.record import RunResult


def add(commands: Any) -> None:
    """Add both commands."""
    parser = add_command(commands, "run", _run, "trajectory and coloured mesh of a folder of RGB-D frames")
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("folder", nargs="?", metavar="FOLDER", help="folder of one sequence")
    what.add_argument("--resume", metavar="RUN", help="go on with a run that was stopped, from its last checkpoint")
    add_sequence_options(parser)
    add_config_option(parser)
    parser.add_argument(
        "--gt-mesh", "--truth-mesh", dest="truth_mesh", metavar="FILE", help="true surface, for reconstruction metrics"
    )
    parser.add_argument("--map", metavar="FILE", help="start from the map of another run (its folder, or the file)")
    parser.add_argument(
        "--localize", action="store_true", help="with --map: only track the camera, leave the map alone"
    )
    parser.add_argument("--no-check", action="store_true", help="run even if the checks of the input find an error")
    _add_overwrite_option(parser)
    add_method_option(parser)
    _add_poses_option(parser)
    _add_checkpoint_option(parser)
    add_run_options(parser)
    add_view_options(parser)

    parser = add_command(commands, "demo", _demo, "SLAM in a small rendered room; needs no data")
    _add_overwrite_option(parser)
    add_method_option(parser)
    _add_poses_option(parser)
    _add_checkpoint_option(parser)
    add_run_options(parser)
    add_view_options(parser)


def _add_overwrite_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--overwrite", action="store_true",
        help="-o may hold a run: its results stay until the new ones are whole, and then give way to them",
    )  # fmt: skip


def _add_poses_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--poses", metavar="FILE", help="take the poses of this TUM trajectory, such as an earlier run's, as given"
    )


def _add_checkpoint_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--checkpoint-every", type=int, metavar="N", help="write a checkpoint every N frames, for --resume"
    )


def _run(options: argparse.Namespace) -> int:
    if options.resume is not None:
        return _resume(options)
    config, map_ = read_config(options), options.map
    if map_ is not None:
        if options.preset or options.config or options.decoders:
            raise ConfigError("--preset, --config and --decoders do not go with --map, which has all three; use --set")
        path = Path(map_).expanduser().resolve()
        map_ = str(RunFolder(path).map if path.is_dir() else path)
    folder = os.path.abspath(Path(options.folder).expanduser())  # a link keeps its name, which may tell the camera
    request = replace(
        _common(options),
        source=Source(folder, options.dataset, options.camera, options.command_line, options.topics),
        frames=slice_of(options.frames),
        config=config,
        preset=options.preset,
        map=map_,
        localize_only=options.localize,
        truth_mesh=options.truth_mesh,
    )
    return _execute(request, options, check_input=not options.no_check)


def _demo(options: argparse.Namespace) -> int:
    request = _common(options)
    request = replace(
        request,
        source=Source.demo(options.command_line),
        preset=demo.PRESET,
        overrides=(*demo.OVERRIDES, *request.overrides),
    )
    return _execute(request, options)


def _resume(options: argparse.Namespace) -> int:
    """Everything is as the checkpoint says; an option that says otherwise is refused by the run."""
    for name in ("preset", "config", "map", "localize", "output", "camera", "decoders", "overwrite"):
        if getattr(options, name):
            raise ConfigError(f"--{name} does not go with --resume: it is as when the run was started")
    folder = RunFolder(options.resume)
    with warnings_on_stderr():
        if not folder.is_unfinished:
            if folder.successor.is_unfinished:
                folder = folder.successor
            elif is_finished(folder):
                print(f"nothing to do: the run in {options.resume} is finished")
                return 0
        saved = read_checkpoint(folder)
    was = saved.request
    request = replace(
        was,
        source=saved.source,
        frames=was.frames if options.frames is None else slice_of(options.frames),
        overrides=tuple(options.overrides),
        device=options.device or was.device,
        seed=options.seed or was.seed,
        method=options.method,
        poses=options.poses or was.poses,
        checkpoint_every=options.checkpoint_every or was.checkpoint_every,
        truth_mesh=options.truth_mesh or was.truth_mesh,
    )
    options.output = str(folder.path)
    return _execute(request, options, saved=saved)


def _common(options: argparse.Namespace) -> RunRequest:
    """What ``run`` and ``demo`` have in common."""
    return RunRequest(
        overrides=tuple(options.overrides),
        decoders=options.decoders,
        device=options.device,
        seed=options.seed,
        method=options.method,
        poses=options.poses,
        checkpoint_every=options.checkpoint_every,
    )


def _execute(request: RunRequest, options: argparse.Namespace, **keywords: Any) -> int:
    quiet_warp()
    with warnings_on_stderr():
        return show_run(
            lambda observer: run(request, options.output, observer=observer, overwrite=options.overwrite, **keywords),
            viewers(options),
        )


def show_run(start: Callable[[Observer], RunResult], others: Sequence[Observer] = ()) -> int:
    """Start a run, show how it goes and what came of it; returns the exit code.

    Args:
        start: Does the run.
        others: Look on as well.
    """
    try:
        with run_display() as display:
            result = start(Observers(display, *others))
        _print_summary(result)
    finally:
        for other in others:
            other.close()
    return EXIT_INTERRUPTED if result.status == INTERRUPTED else 0


def _print_summary(result: RunResult) -> None:
    metrics = result.metrics
    frames, seconds = metrics.frames, metrics.seconds
    counts = ", ".join(f"{count} {name}" for name, count in frames.by_status)
    print(f"frames      {frames.processed} of {frames.selected} ({counts or 'none'}), {result.status}")
    fps = f", {metrics.fps:.2f} frames/s" if metrics.fps else ""
    print(f"time        {duration(seconds.run)}{fps}; compiling kernels {duration(seconds.kernel_compile)}")
    if result.ate is not None:
        unaligned = metrics.ate_m.unaligned.rmse
        print(f"ATE RMSE    {100 * result.ate.rmse:.2f} cm aligned, {100 * (unaligned or 0):.2f} cm unaligned")
    if metrics.has("found_timing"):
        print(f"timing      {metrics.found_timing.text}; for camera.yaml")
    if metrics.has("loops"):
        print(f"loops       {metrics.loops.text}")
    size, mesh = metrics.map, metrics.mesh
    if size.bytes is not None:
        cost = f", {size.flops_per_point:,} FLOP a point" if size.flops_per_point is not None else ""
        print(f"map         {size.bytes / 1e6:.2f} MB{cost}")
    if mesh.faces is not None:
        print(f"mesh        {mesh.vertices} vertices, {mesh.faces} faces")
    if result.reconstruction is not None:
        print_reconstruction(metrics.reconstruction)
    if metrics.has("rendering"):
        print_rendering(metrics.rendering)
    print(f"written to  {result.folder.path}")
