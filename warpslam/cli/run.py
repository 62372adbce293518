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
    add_run_options,
    duration,
    parse_frames,
    print_reconstruction,
    quiet_warp,
    warnings_on_stderr,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

    from warpslam.config import Config
    from warpslam.pipeline import Progress, RunResult
    from warpslam.run_folder import Source
    from warpslam.sequences.base import RgbdSequence

_PLAIN_LINES = 20


def add(commands: Any) -> None:
    """Add both commands."""
    run = add_command(commands, "run", _run, "trajectory and coloured mesh of a folder of RGB-D frames")
    run.add_argument("folder", metavar="FOLDER", help="folder of one sequence")
    run.add_argument("--dataset", default="auto", help="format of the folder (default: told from its file names)")
    run.add_argument("--camera", metavar="FX,FY,CX,CY,WIDTH,HEIGHT,DEPTH_SCALE", help="camera, not the dataset's")
    run.add_argument("--preset", help="settings to start from (default: the dataset's)")
    run.add_argument("--frames", type=parse_frames, metavar="A:B:STEP", help="frames to use, as in a Python slice")
    run.add_argument("--truth-mesh", metavar="FILE", help="true surface, for the reconstruction metrics")
    run.add_argument("--no-check", action="store_true", help="run even if the checks of the input find an error")
    add_run_options(run)

    demo = add_command(commands, "demo", _demo, "SLAM in a small rendered room; needs no data")
    add_run_options(demo)


def _run(options: argparse.Namespace) -> int:
    from warpslam.config import Config
    from warpslam.pipeline import load_mesh
    from warpslam.revisit import open_source
    from warpslam.run_folder import Source

    quiet_warp()
    source = Source(str(Path(options.folder).expanduser().resolve()), options.dataset, options.camera)
    sequence = open_source(source)
    config = Config.from_preset(options.preset or sequence.preset, options.overrides)
    truth_mesh = load_mesh(options.truth_mesh) if options.truth_mesh else None
    return _execute(
        sequence,
        config,
        source,
        options,
        frames=options.frames,
        truth_mesh=truth_mesh,
        check_input=not options.no_check,
    )


def _demo(options: argparse.Namespace) -> int:
    from warpslam import demo
    from warpslam.config import Config
    from warpslam.run_folder import Source

    quiet_warp()
    config = Config.from_preset(demo.PRESET, [*demo.OVERRIDES, *options.overrides])
    sequence = demo.demo_sequence()
    return _execute(sequence, config, Source(None), options, truth_mesh=sequence.mesh)


def _execute(
    sequence: RgbdSequence, config: Config, source: Source, options: argparse.Namespace, **keywords: Any
) -> int:
    from warpslam.pipeline import run

    if options.decoders:
        config = config.model_copy(update={"decoders": options.decoders})
    with warnings_on_stderr(), _progress(sequence.name) as on_frame:
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
    if "faces" in mesh:
        print(f"mesh        {mesh['vertices']} vertices, {mesh['faces']} faces")
    if result.reconstruction is not None:
        print_reconstruction(metrics["reconstruction"])
    rendering = metrics.get("rendering")
    if rendering:
        print(f"rendering   depth L1 {100 * rendering['depth_l1_m']:.2f} cm, PSNR {rendering['psnr_db']:.1f} dB")
    print(f"written to  {result.folder.path}")
