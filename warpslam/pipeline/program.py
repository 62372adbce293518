"""What `warpslam run` does, as one call for programs."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from warpslam.errors import InputError
from warpslam.pipeline.observer import Observer
from warpslam.pipeline.run import run as run_request
from warpslam.runs.request import DEFAULT_METHOD, RunRequest, Source
from warpslam.sequences.base import RgbdSequence

if TYPE_CHECKING:
    import trimesh

    from warpslam.config import Config
    from warpslam.runs.record import RunResult


def run(
    sequence: RgbdSequence | str | os.PathLike[str],
    output: str | Path | None = None,
    *,
    config: Config | None = None,
    preset: str | None = None,
    overrides: Sequence[str] = (),
    frames: slice | None = None,
    poses: str | os.PathLike[str] | None = None,
    device: str | None = None,
    seed: int = 0,
    method: str = DEFAULT_METHOD,
    truth_mesh: trimesh.Trimesh | None = None,
    observer: Observer | None = None,
    check_input: bool = True,
) -> RunResult:
    """Run SLAM over a sequence and write a run folder.

    Args:
        sequence: A sequence, or the path of one in any format that `warpslam.open_sequence` tells by itself. Only what
            has a path can be opened again by ``warpslam eval`` and its like.
        output: Folder to write; None for ``runs/<sequence>/<time>``.
        config: All settings, in place of a preset.
        preset: Settings to start from; None for the dataset's.
        overrides: Single settings on top, such as "mapping.every=2".
        frames: Frames to use, a slice; all by default.
        poses: File of poses that are taken as given.
        device: Warp device; None for Warp's preferred one.
        seed: Seed of every random choice.
        method: One of `warpslam.pipeline.methods.METHODS`.
        truth_mesh: True surface in the world frame of the sequence.
        observer: Told of every frame: see `warpslam.pipeline.observer.Observer`.
        check_input: Refuse an input that can't work.

    Returns:
        Figures, and the folder with all that was written.

    Raises:
        WarpSlamError: The input or a setting can't be used, or a result can't be written.
    """
    if not isinstance(sequence, RgbdSequence | str | os.PathLike):
        raise InputError(f"sequence is {type(sequence).__name__}: pass an RgbdSequence, or the path of one")
    handed = sequence if isinstance(sequence, RgbdSequence) else None
    source = None if isinstance(sequence, RgbdSequence) else Source(os.path.abspath(Path(sequence).expanduser()))
    parts = frames or slice(None)
    request = RunRequest(
        source=source,
        frames=(parts.start, parts.stop, parts.step),
        config=config,
        preset=preset,
        overrides=tuple(overrides),
        poses=None if poses is None else os.fspath(poses),
        device=device,
        seed=seed,
        method=method,
    )
    return run_request(
        request, output, sequence=handed, truth_mesh=truth_mesh, observer=observer, check_input=check_input
    )
