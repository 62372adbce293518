"""Checkpoints of a run: what it needs to go on after it was stopped, and whether it may.

A run folder holds the last two, ``checkpoint.safetensors`` and ``checkpoint.previous.safetensors``. A new one is
written beside them in full before the names move, so one good checkpoint is there at any moment.
"""

from __future__ import annotations

import dataclasses
import hashlib
import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from warpslam.config import Config
from warpslam.errors import CheckpointError, ConfigError, DatasetError
from warpslam.runs.folder import RunFolder
from warpslam.runs.record import RunProgress, result_row
from warpslam.runs.request import RunRequest, Source
from warpslam.slam import Slam
from warpslam.slam_state import state_arrays, state_from_arrays
from warpslam.storage.atomic import sync_folder
from warpslam.storage.state_file import StateFormat, read_state, write_state

if TYPE_CHECKING:
    from warpslam.sequences.base import Frame, RgbdSequence

RUN_FORMAT = StateFormat("warpslam-run", 3)
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class SavedRun:
    """A checkpoint that was read."""

    path: str
    request: RunRequest
    checkpoint_every: int
    progress: RunProgress
    state: tuple[dict[str, Any], dict[str, np.ndarray]]

    @property
    def source(self) -> Source:
        """How to open the input again.

        Raises:
            CheckpointError: the run was started from Python and did not say how.
        """
        if self.request.source is None:
            raise CheckpointError(f"{self.path}: does not say how to open the input; resume it from Python")
        return Source(**self.request.source)

    def slam(self, config: Config | None = None) -> Slam:
        """The SLAM object as it was, with its settings or those given.

        Raises:
            CheckpointError: a field is damaged.
        """
        from warpslam.runtime.cores import slice_count

        state = state_from_arrays(self.path, *self.state, config=config)
        slam = Slam.from_state(state, self.request.device)
        slam.config.mapping.enabled &= not self.request.localize_only
        if slam.config.schedule == "overlapped":
            log.warning(
                "the schedule overlapped does not repeat to the bit: the run goes on from a whole map, but its result "
                "will differ from that of a run that was not stopped; with schedule=strict it would be the same"
            )
        slices = self.state[0].get("slices")
        if slices != slice_count(slam.device):
            log.warning(
                "the run was started on %s CPU cores and goes on with %d: sums are formed in another order, so the "
                "result will not be the same to the bit", slices, slice_count(slam.device),
            )  # fmt: skip
        return slam

    def check(self, request: RunRequest, sequence: RgbdSequence) -> None:
        """Refuse to go on with other settings or another input.

        Raises:
            ConfigError: names what differs.
        """
        differences = self.request.differences(request)
        for index, digest in self.progress.digests.items():
            try:
                if not differences and frame_digest(sequence[index]) != digest:
                    differences.append(f"frame {index} of {sequence.name} has changed")
            except DatasetError as error:
                differences.append(f"frame {index} of {sequence.name} can't be read any more ({error})")
        if differences:
            raise ConfigError(
                f"{self.path}: the run can't go on, because something else is asked for: {'; '.join(differences)}. "
                "Put that back, or start a new run"
            )


def write_checkpoint(
    folder: RunFolder, request: RunRequest, checkpoint_every: int, progress: RunProgress, slam: Slam
) -> int:
    """Write a checkpoint; the last one before it stays. Returns its size [bytes].

    Raises:
        CheckpointError: the file can't be written.
    """
    header, arrays = state_arrays(slam.state())
    run = {
        "request": dataclasses.asdict(request),
        "checkpoint_every": checkpoint_every,
        "position": progress.position,
        "frame_indices": progress.frame_indices,
        "left_out": progress.left_out,
        "seconds": progress.seconds,
        "first_index": progress.first_index,
        "digests": list(progress.digests.items()),
        "results": [result_row(result) for result in progress.results],
    }
    poses = [result.T_world_camera for result in progress.results]
    arrays["run_truth_poses"] = np.array(progress.truth_poses, np.float64).reshape(-1, 4, 4)
    arrays["run_poses"] = np.array(poses, np.float64).reshape(-1, 4, 4)
    new = folder.checkpoint.with_name("checkpoint.next.safetensors")
    size = write_state(new, RUN_FORMAT, {"slam": header, "run": run}, arrays)
    if folder.checkpoint.exists():
        folder.checkpoint.replace(folder.previous_checkpoint)
    new.replace(folder.checkpoint)
    sync_folder(folder.path)
    return size


def read_checkpoint(folder: RunFolder) -> SavedRun:
    """The last good checkpoint of a run.

    Raises:
        CheckpointError: there is none; says what is wrong with each.
    """
    found = [path for path in (folder.checkpoint, folder.previous_checkpoint) if path.exists()]
    if not found:
        finished = folder.map.exists() and folder.metrics.exists()
        raise CheckpointError(
            f"{folder.path} holds no checkpoint: "
            + ("the run is over" if finished else "start the run again, with --checkpoint-every")
        )
    problems = []
    for path in found:
        try:
            header, arrays = read_state(path, RUN_FORMAT)
            saved = _saved_run(str(path), header, arrays)
        except CheckpointError as error:
            problems.append(str(error))
            continue
        for problem in problems:
            log.warning("%s; going on from the checkpoint before", problem)
        return saved
    raise CheckpointError("; ".join(problems))


def find_checkpoint(folder: RunFolder, request: RunRequest, sequence: RgbdSequence) -> tuple[SavedRun | None, str]:
    """The checkpoint that an unfinished run in ``folder`` can go on from, where there is one, and why it can't if
    there is one of no use: damaged, or of a run that was asked for something else.

    A run that was on one GPU goes on on another.
    """
    if not (folder.checkpoint.exists() or folder.previous_checkpoint.exists()):
        return None, ""
    try:
        saved = read_checkpoint(folder)
        if saved.request.device.startswith("cuda") and request.device.startswith("cuda"):
            saved = dataclasses.replace(saved, request=dataclasses.replace(saved.request, device=request.device))
        saved.check(request, sequence)
    except (CheckpointError, ConfigError) as error:
        return None, str(error)
    return saved, ""


def remove_checkpoints(folder: RunFolder) -> None:
    """Once a run is over, its map holds all that they do."""
    for path in (folder.checkpoint, folder.previous_checkpoint):
        path.unlink(missing_ok=True)


def frame_digest(frame: Frame) -> str:
    """SHA-256 of a frame's images and time."""
    digest = hashlib.sha256(repr(float(frame.timestamp)).encode())
    for image in (frame.rgb, frame.depth):
        digest.update(np.ascontiguousarray(image).data)
    return digest.hexdigest()


def _saved_run(path: str, header: dict[str, Any], arrays: dict[str, np.ndarray]) -> SavedRun:
    from warpslam.frames import FrameResult

    try:
        run = header["run"]
        request = RunRequest(**{**run["request"], "frames": tuple(run["request"]["frames"])})
        Config.from_dict(request.config)
        poses, truth = arrays.pop("run_poses"), arrays.pop("run_truth_poses")
        progress = RunProgress(
            position=int(run["position"]),
            frame_indices=[int(index) for index in run["frame_indices"]],
            truth_poses=list(truth.reshape(-1, 4, 4)),
            results=[FrameResult(T_world_camera=pose, **row) for pose, row in zip(poses, run["results"], strict=True)],
            left_out=[{"index": int(one["index"]), "message": str(one["message"])} for one in run["left_out"]],
            seconds={str(name): float(seconds) for name, seconds in run["seconds"].items()},
            first_index=int(run["first_index"]),
            digests={int(index): str(digest) for index, digest in run["digests"]},
        )
        if not len(progress.results) == len(progress.frame_indices) == len(progress.truth_poses):
            raise ValueError("its lists have different lengths")
        return SavedRun(path, request, int(run["checkpoint_every"]), progress, (header["slam"], arrays))
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise CheckpointError(f"{path}: field run is damaged ({error!r}): use another copy") from None
