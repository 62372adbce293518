"""Checkpoints of a run: what it needs to go on after it was stopped, and whether it may.

A run folder holds the last two, ``checkpoint.safetensors`` and ``checkpoint.previous.safetensors``. A new one is
written beside them in full before the names move, so one good checkpoint is there at any moment.
"""

from __future__ import annotations

import hashlib
import logging
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from warpslam.config import Config
from warpslam.errors import CheckpointError, ConfigError, DatasetError, brief
from warpslam.runs.folder import RunFolder
from warpslam.runs.record import RunRecord
from warpslam.runs.request import RunRequest, SequenceFacts, Source, differences
from warpslam.runtime.cores import slice_count
from warpslam.slam import Slam
from warpslam.slam_state import state_arrays, state_from_arrays
from warpslam.storage.atomic import sync_folder
from warpslam.storage.state_file import StateFields, StateFormat, read_state, write_state

if TYPE_CHECKING:
    from warpslam.pipeline.methods import Method
    from warpslam.sequences.base import Frame, RgbdSequence

RUN_FORMAT = StateFormat("warpslam-run", 6)
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class SavedRun:
    """A checkpoint that was read."""

    path: str
    """File."""

    request: RunRequest
    """What the run was asked for, resolved."""

    facts: SequenceFacts
    """What its input was like."""

    record: RunRecord
    """What had become of it by then."""

    state: tuple[dict[str, Any], dict[str, np.ndarray]]
    """The SLAM object, as `warpslam.slam_state.state_arrays` gives it."""

    @property
    def source(self) -> Source:
        """How to open the input again.

        Raises:
            CheckpointError: The run was started from Python and did not say how.
        """
        if self.request.source is None:
            raise CheckpointError(f"{self.path}: does not say how to open the input; resume it from Python")
        return self.request.source

    def slam(self, config: Config | None = None) -> Slam:
        """The SLAM object as it was, with its settings or those given.

        Raises:
            CheckpointError: A field is damaged.
        """
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
                "the run was started with WARPSLAM_SLICES=%s and goes on with %d: sums are formed in another order, so "
                "the result will not be the same to the bit", slices, slice_count(slam.device),
            )  # fmt: skip
        return slam

    def check(self, request: RunRequest, sequence: RgbdSequence) -> None:
        """Refuse to go on with other settings or another input.

        Raises:
            ConfigError: Names what differs.
        """
        changes = self.request.differences(request) + differences(
            asdict(self.facts), asdict(SequenceFacts.of(sequence))
        )
        for index, digest in self.record.digests.items():
            try:
                if not changes and frame_digest(sequence[index]) != digest:
                    changes.append(f"frame {index} of {sequence.name} has changed")
            except DatasetError as error:
                changes.append(f"frame {index} of {sequence.name} can't be read any more ({error})")
        if changes:
            raise ConfigError(
                f"{self.path}: the run can't go on, because something else is asked for: {'; '.join(changes)}. "
                "Put that back, or start a new run"
            )


@dataclass(eq=False)
class Checkpoints:
    """Writes the checkpoints of a run when they are due; none where the request asks for none."""

    folder: RunFolder
    """Where they are."""

    request: RunRequest
    """What the run was asked for, resolved."""

    facts: SequenceFacts
    """What its input is like."""

    frame_count: int
    """Frames of the selection."""

    position: int | None = None
    """Frames that were done at the last one; None without any."""

    size: int | None = None
    """Of the last one that was written [bytes]."""

    def before_frames(self, record: RunRecord, slam: Method) -> None:
        """A run that is stopped in its first frame can be resumed as well."""
        if self.request.checkpoint_every is not None and self.position != record.position:
            self._write(record, slam)

    def after_frame(self, frame: Frame, record: RunRecord, slam: Method) -> None:
        """Write one, if it is due after this frame."""
        every = self.request.checkpoint_every
        if every is None:
            return
        first = next(iter(record.digests), frame.index)
        record.digests = {index: digest for index, digest in record.digests.items() if index == first}
        is_due = record.position % every == 0 or record.position == self.frame_count
        if is_due or not record.digests:
            record.digests[frame.index] = frame_digest(frame)
        if is_due and self.position != record.position:
            self._write(record, slam)

    def _write(self, record: RunRecord, slam: Method) -> None:
        assert isinstance(slam, Slam), "no other method has checkpoints"
        with record.clock("checkpoints"):
            self.size = write_checkpoint(self.folder, self.request, self.facts, record, slam)
        self.position = record.position


def write_checkpoint(
    folder: RunFolder, request: RunRequest, facts: SequenceFacts, record: RunRecord, slam: Slam
) -> int:
    """Write a checkpoint; the last one before it stays. Returns its size [bytes].

    Raises:
        CheckpointError: The file can't be written.
    """
    state, arrays = state_arrays(slam.state())
    account, poses = record.to_state()
    header = {"slam": state, "run": {"request": request.to_dict(), "input": asdict(facts), "record": account}}
    new = folder.checkpoint.with_name("checkpoint.next.safetensors")
    size = write_state(new, RUN_FORMAT, header, {**arrays, **poses})
    if folder.checkpoint.exists():
        folder.checkpoint.replace(folder.previous_checkpoint)
    new.replace(folder.checkpoint)
    sync_folder(folder.path)
    return size


def read_checkpoint(folder: RunFolder) -> SavedRun:
    """The last good checkpoint of a run.

    Raises:
        CheckpointError: There is none; says what is wrong with each.
    """
    folder.finish_taking_place()
    found = [path for path in (folder.checkpoint, folder.previous_checkpoint) if path.exists()]
    if not found:
        remedy = "start the run again, with --checkpoint-every"
        if folder.has_results:
            remedy = f"the run can't go on, but warpslam report {folder.path} makes what is missing of what lies there"
        raise CheckpointError(f"{folder.path} holds no checkpoint: {remedy}")
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
        if all(str(one.device).startswith("cuda") for one in (saved.request, request)):
            saved = replace(saved, request=replace(saved.request, device=request.device))
        saved.check(request, sequence)
    except (CheckpointError, ConfigError) as error:
        return None, str(error)
    return saved, ""


def frame_digest(frame: Frame) -> str:
    """SHA-256 of a frame's images and times."""
    digest = hashlib.sha256(repr((frame.timestamp, frame.depth_timestamp)).encode())
    for image in (frame.rgb, frame.depth):
        digest.update(np.ascontiguousarray(image).data)
    return digest.hexdigest()


def _saved_run(path: str, header: dict[str, Any], arrays: dict[str, np.ndarray]) -> SavedRun:
    try:
        run = header["run"]
        request, facts = RunRequest.from_dict(run["request"]), SequenceFacts.from_dict(run["input"])
        record = RunRecord.from_state(run["record"], arrays)
        if request.config is None:
            raise ValueError("its request has no settings")
        record.check_frames(facts.frame_count)
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(f"{path}: field run is damaged ({brief(repr(error))}): use another copy") from None
    fields = StateFields(path, header, arrays)
    count, expected = len(fields.array("poses", np.float64, (None, 4, 4))), record.first_index + len(record.results)
    if count < expected:
        raise fields.damaged("poses", f"{count} of them, expected those of the {expected} frames of the run")
    return SavedRun(path, request, facts, record, (fields.mapping("slam"), arrays))
