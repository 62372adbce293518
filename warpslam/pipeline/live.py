"""A run on a camera that is running."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING

from warpslam.pipeline.observer import Observer
from warpslam.pipeline.run import run
from warpslam.runs.request import RunRequest, Source
from warpslam.sequences.live import MAX_FRAMES, LiveCamera, LiveSequence

if TYPE_CHECKING:
    from warpslam.runs.record import RunResult

RECORDING = "recording"
log = logging.getLogger(__name__)


def run_live(
    camera: LiveCamera,
    output: str | Path,
    *,
    preset: str | None = None,
    overrides: tuple[str, ...] = (),
    decoders: str | None = None,
    device: str | None = None,
    seed: int = 0,
    max_frames: int = MAX_FRAMES,
    observer: Observer | None = None,
) -> RunResult:
    """Run SLAM on a camera until it ends, or ctrl-C is pressed, and write a run folder.

    Frames that come while the engine is busy are dropped and counted; the newest is used. Frames that are used are kept
    beside the run, in a folder of the same name with "-recording" at its end, so that the run can be evaluated, and
    run again.

    Args:
        camera: Closed in the end.
        output: Folder to write.
        preset: Settings to start from.
        overrides: Single settings on top.
        decoders: Decoder checkpoint.
        device: Warp device.
        seed: Seed of every random choice.
        max_frames: Frames to use at most.
        observer: Told of every frame.

    Raises:
        WarpSlamError: The camera fails, a setting can't be used, or a result can't be written.
    """
    output = Path(output)
    folder = output.with_name(f"{output.name}-{RECORDING}")
    sequence = LiveSequence(camera, folder, max_frames)
    request = RunRequest(
        Source(str(folder.resolve()), "azure"),
        preset=preset,
        overrides=overrides,
        decoders=decoders,
        device=device,
        seed=seed,
    )
    try:
        result = run(request, output, sequence=sequence, observer=observer)
    finally:
        sequence.close()
    used = len(sequence.timestamps)
    log.warning("%d frames used, %d dropped that came while the engine was busy", used, sequence.dropped)
    return result
