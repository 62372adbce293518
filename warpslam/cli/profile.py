"""``warpslam profile``."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import Any

from rich.console import Console

from warpslam.cli.common import add_command, add_sequence_options, add_slam_options, quiet_warp, warnings_on_stderr
from warpslam.config import Config
from warpslam.errors import ConfigError, MeshError
from warpslam.pipeline.finished import open_source
from warpslam.pipeline.setup import as_configured, build_slam, load_kernels, select_frames
from warpslam.profiling.report import fitted
from warpslam.profiling.session import Profile
from warpslam.runs.request import Source
from warpslam.runtime.phases import phase
from warpslam.sequences.base import RgbdSequence
from warpslam.synthetic import demo

_MIN_SHARE = 0.002


def add(commands: Any) -> None:
    """Add the command."""
    profile = add_command(commands, "profile", _profile, "time of every kernel of a run; writes no run folder")
    profile.add_argument("folder", metavar="FOLDER|demo", help="folder of one sequence, or the built-in one")
    add_sequence_options(profile)
    add_slam_options(profile)
    profile.add_argument("--no-mesh", action="store_true", help="leave out the mesh")
    profile.add_argument("--all", action="store_true", help="show kernels with hardly any share of the time, too")
    profile.add_argument("--json", metavar="FILE", help="write the figures as JSON")
    profile.add_argument("--trace", metavar="FILE", help="write a trace for Perfetto or chrome://tracing")


def _profile(options: argparse.Namespace) -> int:
    quiet_warp()
    for option, file in (("--json", options.json), ("--trace", options.trace)):
        if file and not os.path.isdir(Path(file).resolve().parent):
            raise ConfigError(f"{option} {file}: there is no folder {Path(file).resolve().parent}; make it first")
    sequence, config = _input(options)
    if options.decoders:
        config = config.model_copy(update={"decoders": options.decoders})
    selected = select_frames(sequence, options.frames)
    print(f"profiling {len(selected)} frames of {sequence.name}", flush=True)
    with warnings_on_stderr():
        profile = _run(sequence, config, selected, options)
    console = Console()
    if not console.is_terminal:
        # Wide enough for every column, whoever reads it.
        console = Console(width=170)
    for table in profile.report.tables(0.0 if options.all else _MIN_SHARE):
        console.print(fitted(table, console.width))
    if options.json:
        Path(options.json).write_text(profile.to_json() + "\n", encoding="utf-8")
        print(f"figures     {options.json}")
    if options.trace:
        profile.write_trace(options.trace)
        print(f"trace       {options.trace} (open it at ui.perfetto.dev)")
    return 0


def _input(options: argparse.Namespace) -> tuple[RgbdSequence, Config]:
    if options.folder == "demo":
        return open_source(Source.demo()), Config.from_preset(options.preset or demo.PRESET, options.overrides)
    source = Source(
        os.path.abspath(Path(options.folder).expanduser()), options.dataset, options.camera, topics=options.topics
    )
    sequence = open_source(source)
    config = Config.from_preset(options.preset or sequence.preset, options.overrides)
    return as_configured(sequence, config), config


def _run(sequence: RgbdSequence, config: Config, selected: range, options: argparse.Namespace) -> Profile:
    with Profile() as result:
        with phase("setup"):
            load_kernels(sequence, options.device, config=config)
            slam = build_slam(sequence.intrinsics, config, options.device, options.seed, timing=sequence.timing)
        for index in selected:
            with phase("reading"):
                frame = sequence[index]
            slam.step(
                frame.rgb,
                frame.depth,
                frame.timestamp,
                frame.T_world_camera,
                depth_timestamp=frame.depth_timestamp,
            )
        slam.finish()
        if not options.no_mesh:
            try:
                slam.mesh()
            except MeshError as error:
                print(f"no mesh     {error}")
    return result
