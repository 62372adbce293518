"""``warpslam check``."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from warpslam.cli.common import add_command, add_format_options, add_set_option
from warpslam.cli.progress import working
from warpslam.config import Config
from warpslam.runs.folder import RunFolder
from warpslam.runs.given_poses import GivenPoses
from warpslam.runs.manifest import check_manifest
from warpslam.sequences.base import RgbdSequence
from warpslam.sequences.checking import THOROUGH_SAMPLES, check_folder
from warpslam.storage.json_files import to_json

EXIT_FINDINGS = 1


def _given(path: str, sequence: RgbdSequence) -> tuple[np.ndarray, Path]:
    """Poses of a file for all frames of a sequence, and its path."""
    frames = range(len(sequence))
    given = GivenPoses.read(path).fitted_to(sequence, frames)
    return given.of_frames(sequence, frames), given.path


def add(commands: Any) -> None:
    """Add the command."""
    check = add_command(
        commands,
        "check",
        _check,
        "whether a folder of RGB-D frames can be used, before a run; or whether that of a run is as the run left it",
    )
    check.add_argument("folder", metavar="FOLDER", help="folder of one sequence, or of a run")
    add_format_options(check)
    check.add_argument("--poses", metavar="FILE", help="poses that a run would be given, checked against depth")
    add_set_option(check)
    check.add_argument("--all", action="store_true", help="read every frame, not a sample of them")
    check.add_argument("--json", action="store_true", help="print JSON")


def _check(options: argparse.Namespace) -> int:
    run = RunFolder(options.folder)
    if run.metrics.is_file() or run.manifest.is_file():
        return _check_run(run, options.json)
    count = None if options.all else THOROUGH_SAMPLES
    max_depth = Config.from_preset("default", options.overrides).resolved().grid.max_depth
    with working("reading frames"):
        report = check_folder(
            options.folder,
            options.dataset,
            options.camera,
            sample_count=count,
            topics=options.topics,
            max_depth=max_depth,
            read_poses=None if options.poses is None else partial(_given, options.poses),
        )
    if options.json:
        print(to_json(report.to_dict()))
    else:
        if report.name:
            print(f"{report.name}: {report.frames} frames")
        for finding in report.findings:
            print(f"{finding.severity:8} {finding.check:16} {finding.message}")
            if finding.remedy:
                print(f"{'':8} {'':16} -> {finding.remedy}")
        counts = ((len(report.errors), "error"), (len(report.warnings), "warning"))
        print(", ".join(f"{count} {name}{'' if count == 1 else 's'}" for count, name in counts))
    return EXIT_FINDINGS if report.errors else 0


def _check_run(folder: RunFolder, as_json: bool) -> int:
    problems = check_manifest(folder)
    if as_json:
        print(to_json({"run": folder.path, "problems": problems}))
    else:
        for problem in problems:
            print(f"error    {problem}")
        print(
            f"{folder.path}: " + (f"{len(problems)} files differ" if problems else "all files are as the run left them")
        )
    return EXIT_FINDINGS if problems else 0
