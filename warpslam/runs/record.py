"""What has become of a run: held once, by the run, its checkpoints and its report."""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import BaseModel, Field, field_validator

from warpslam.frames import FrameResult, FrameStatus
from warpslam.poses import are_rigid
from warpslam.storage.json_files import Finite, Index, Number, Seconds, checked

if TYPE_CHECKING:
    from warpslam.evaluation import AteResult, ReconstructionResult
    from warpslam.runs.folder import RunFolder
    from warpslam.runs.metrics import RunMetrics
    from warpslam.sequences.base import Frame

UNREADABLE = "unreadable"
FINISHED, INTERRUPTED, FAILED = "finished", "interrupted", "failed"
"""How a run ended. After ctrl-C everything up to then is written."""
UNFINISHED = "unfinished"
"""Figures of a run that has not come to its end, or was ended before it could say how."""

# Beside its number in the sequence; the other fields of a result are in timing.json and trajectory.tum.
_ROW_FIELDS = ("timestamp", "status", "message", "inliers", "depth_error", "correlation", "covariance", "losses")
# A report says what a file has, even if that is no status of ours.
_STATUSES = {str(status): status for status in FrameStatus}


_Row6 = Annotated[list[Annotated[float, Field(ge=-1e30, le=1e30)]], Field(min_length=6, max_length=6)]
_Covariance = Annotated[list[_Row6], Field(min_length=6, max_length=6)]
_FARTHEST = 1e12
_TIMING_FIELDS = {"depth_delay", "readout", "depth_delay_sigma", "readout_sigma"}


class _LeftOut(BaseModel, extra="forbid"):
    index: Index
    message: str


class _Row(BaseModel):
    """A frame in frames.json. Early files have not all of it, and others may have more."""

    index: Index
    timestamp: Number
    status: str
    message: str
    inliers: Number
    losses: dict[str, Number]
    depth_error: Number = None
    correlation: Number = None
    covariance: _Covariance | None = None


class _Rows(BaseModel):
    """Content of frames.json."""

    frames: list[_Row]
    left_out: list[_LeftOut]


class _Result(BaseModel, extra="forbid"):
    """A `FrameResult` in a checkpoint, all but its pose. JSON of checkpoints knows NaN and infinity."""

    index: Index
    timestamp: Finite
    status: FrameStatus
    losses: dict[str, float]
    inliers: float
    depth_error: float
    correlation: float | None
    covariance: _Covariance | None
    timings: dict[str, Seconds]
    message: str
    reference: Index | None
    sensor_timing: dict[str, float]

    @field_validator("sensor_timing")
    @classmethod
    def _is_whole(cls, value: dict[str, float]) -> dict[str, float]:
        if value and value.keys() != _TIMING_FIELDS:
            raise ValueError(f"expected {', '.join(sorted(_TIMING_FIELDS))}, or nothing")
        return value


class _State(BaseModel, extra="forbid"):
    """A `RunRecord` in a checkpoint, all but its poses."""

    position: Index
    frame_indices: list[Index]
    left_out: list[_LeftOut]
    seconds: dict[str, Seconds]
    first_index: Index
    digests: list[tuple[Index, str]]
    results: list[_Result]


@dataclass(frozen=True)
class LeftOut:
    """A frame that did not get as far as the method: it can't be read, or has no pose where it must have one."""

    index: int
    """Number in the sequence."""

    message: str
    """Why."""


@dataclass
class RunRecord:
    """One account of a run."""

    frame_indices: list[int] = field(default_factory=list)
    """Number in the sequence of each frame that was processed."""

    truth_poses: list[np.ndarray] = field(default_factory=list)
    """True T_world_camera of each of them, (4, 4); NaN where unknown."""

    results: list[FrameResult] = field(default_factory=list)
    """What the method made of each of them."""

    left_out: list[LeftOut] = field(default_factory=list)
    """The others, in their order."""

    seconds: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    """Time by stage [s], without what is still going on; see `seconds_so_far`."""

    first_index: int = 0
    """Frames that the map had seen before the run."""

    position: int = 0
    """Frames of the selection that are done, those left out included."""

    digests: dict[int, str] = field(default_factory=dict)
    """SHA-256 of the first frame and of that of the last checkpoint, by their numbers in the sequence."""

    _running: dict[str, float] = field(default_factory=dict, repr=False, compare=False)

    def add(self, frame_index: int, truth: np.ndarray, result: FrameResult) -> None:
        """A frame was processed."""
        self.frame_indices.append(frame_index)
        self.truth_poses.append(truth)
        self.results.append(result)

    def leave_out(self, frame_index: int, message: str) -> None:
        """A frame could not be used."""
        self.left_out.append(LeftOut(frame_index, message))

    @property
    def frames(self) -> list[tuple[int, FrameResult]]:
        """Number in the sequence and result of each processed frame."""
        return list(zip(self.frame_indices, self.results, strict=True))

    @property
    def statuses(self) -> list[FrameStatus]:
        """Status of each processed frame."""
        return [result.status for result in self.results]

    @property
    def counts(self) -> dict[str, int]:
        """Processed frames by status, and those left out."""
        counts = Counter(self.statuses)
        return {
            "processed": len(self.results),
            UNREADABLE: len(self.left_out),
            **{status: counts.get(status, 0) for status in FrameStatus},
        }

    @property
    def usable(self) -> list[int]:
        """Positions of the processed frames that were not skipped."""
        return [position for position, result in enumerate(self.results) if result.status != FrameStatus.SKIPPED]

    @property
    def truth(self) -> np.ndarray:
        """True poses, shape (N, 4, 4), NaN where unknown."""
        return np.array(self.truth_poses, np.float64).reshape(-1, 4, 4)

    @property
    def found_timing(self) -> tuple[int, dict[str, float]] | None:
        """Number in the sequence of the frame that completed the last estimate of the camera's timing, and that
        estimate as `FrameResult.sensor_timing` has it; None where there is none.
        """
        found = [(index, result.sensor_timing) for index, result in self.frames if result.sensor_timing]
        return found[-1] if found else None

    @property
    def has_truth(self) -> bool:
        """Whether the true pose of a frame is known."""
        return bool(np.isfinite(self.truth).all(axis=(1, 2)).any())

    @property
    def losses(self) -> dict[str, np.ndarray]:
        """Values of each loss, shape (N,), NaN where a frame has none."""
        names = sorted({name for result in self.results for name in result.losses})
        return {name: np.array([result.losses.get(name, np.nan) for result in self.results]) for name in names}

    @contextmanager
    def clock(self, stage: str) -> Iterator[None]:
        """Add the time of a block to a stage."""
        start = self._running[stage] = time.perf_counter()
        try:
            yield
        finally:
            self._running.pop(stage, None)
            self.seconds[stage] += time.perf_counter() - start

    def seconds_so_far(self) -> dict[str, float]:
        """Time by stage [s], with what is still going on."""
        now = time.perf_counter()
        going_on = {stage: self.seconds.get(stage, 0.0) + now - start for stage, start in self._running.items()}
        return {**self.seconds, **going_on}

    def to_rows(self) -> dict[str, Any]:
        """Content of frames.json: what became of each frame."""
        rows = [
            {"index": index, **{name: _plain(getattr(result, name)) for name in _ROW_FIELDS}}
            for index, result in self.frames
        ]
        return {"frames": rows, "left_out": [vars(frame) for frame in self.left_out]}

    @classmethod
    def from_rows(cls, content: dict[str, Any], poses: np.ndarray, truth: np.ndarray | None) -> RunRecord:
        """What frames.json and the trajectories of a run tell of it.

        Args:
            content: See `to_rows`; JSON has null for NaN.
            poses: Estimated poses, shape (N, 4, 4).
            truth: True ones, NaN where unknown; None where there are none at all.

        Raises:
            ValueError: A field is missing or not of its kind, or the number of frames is not that of the poses.
        """
        rows = checked(_Rows, content)
        record = cls(left_out=[LeftOut(frame.index, frame.message) for frame in rows.left_out])
        truth = np.full((len(poses), 4, 4), np.nan) if truth is None else truth
        for position, (row, pose, true_pose) in enumerate(zip(rows.frames, poses, truth, strict=True)):
            values = {name: _known(getattr(row, name)) for name in _ROW_FIELDS}
            values |= {"correlation": row.correlation, "covariance": _matrix(row.covariance)}
            values["status"] = _STATUSES.get(row.status, row.status)
            values["losses"] = {name: _known(value) for name, value in row.losses.items()}
            record.add(row.index, true_pose, FrameResult(index=position, T_world_camera=pose, **values))
        return record

    def to_state(self) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """Header and arrays for a checkpoint."""
        header = {
            "position": self.position,
            "frame_indices": self.frame_indices,
            "left_out": [vars(frame) for frame in self.left_out],
            "seconds": self.seconds_so_far(),
            "first_index": self.first_index,
            "digests": list(self.digests.items()),
            "results": [
                {f.name: _plain(getattr(result, f.name)) for f in fields(FrameResult) if f.name != "T_world_camera"}
                for result in self.results
            ],
        }
        poses = np.array([result.T_world_camera for result in self.results], np.float64).reshape(-1, 4, 4)
        return header, {"run_truth_poses": self.truth, "run_poses": poses}

    @classmethod
    def from_state(cls, header: dict[str, Any], arrays: dict[str, np.ndarray]) -> RunRecord:
        """What `to_state` gave; takes its arrays out of ``arrays``.

        Raises:
            KeyError: An array is missing.
            ValueError: A field is missing, unknown or not of its kind, or lists have different lengths.
        """
        state = checked(_State, header)
        poses, truth = arrays.pop("run_poses"), arrays.pop("run_truth_poses")
        if not len(state.results) == len(state.frame_indices) == len(truth) == len(poses):
            raise ValueError("its lists have different lengths")
        if state.position != len(state.results) + len(state.left_out):
            raise ValueError(
                f"position: {state.position} frames are done, expected the {len(state.results)} that were processed "
                f"and the {len(state.left_out)} left out"
            )
        for name, array in (("run_poses", poses), ("run_truth_poses", truth)):
            if array.dtype != np.float64 or array.shape[1:] != (4, 4):
                raise ValueError(f"{name} is {array.dtype} {array.shape}, expected float64 (any, 4, 4)")
        if not are_rigid(poses):
            raise ValueError("run_poses: they are no rigid transforms, or too far from the origin")
        if (np.abs(truth) > _FARTHEST).any():  # NaN is not: it stands for unknown ones
            raise ValueError(f"run_truth_poses: a number beyond {_FARTHEST:g}")
        record = cls(
            position=state.position,
            frame_indices=state.frame_indices,
            truth_poses=list(truth),
            results=[
                FrameResult(T_world_camera=pose, **{**dict(row), "covariance": _matrix(row.covariance)})
                for pose, row in zip(poses, state.results, strict=True)
            ],
            left_out=[LeftOut(frame.index, frame.message) for frame in state.left_out],
            first_index=state.first_index,
            digests=dict(state.digests),
        )
        record.seconds.update(state.seconds)
        return record

    def check_frames(self, count: int) -> None:
        """Whether all frames that it names are among the ``count`` of a sequence.

        Raises:
            ValueError: Names the field and the frame.
        """
        named = {
            "frame_indices": self.frame_indices,
            "left_out": [frame.index for frame in self.left_out],
            "digests": self.digests,
        }
        for name, indices in named.items():
            for index in indices:
                if index >= count:
                    raise ValueError(f"{name}: frame {index} is none of the {count} of the sequence")


def _known(value: Any) -> Any:
    return np.nan if value is None else value


@dataclass(frozen=True)
class Progress:
    """State of a run after a frame."""

    done: int
    """Frames done so far, those left out included."""

    total: int
    """Frames that were selected."""

    result: FrameResult
    """Of the last frame."""

    ate_rmse: float | None
    """ATE RMSE so far, aligned [m], asked anew with every twentieth more frames; None without ground truth."""

    fps: float
    """Frames a second, of the last frames."""

    seconds_left: float = 0.0
    """Until everything is written, as far as can be told [s]; 0 where nobody knows: with a live camera, and after the
    first frame.
    """

    frame: Frame | None = None
    """What the method was given last."""


@dataclass(frozen=True)
class RunResult:
    """What a run came to."""

    folder: RunFolder
    """Where everything is written."""

    status: str
    """`FINISHED` or `INTERRUPTED`; a run that fails raises."""

    metrics: RunMetrics
    """Content of metrics.json."""

    ate: AteResult | None
    """Trajectory error after alignment; None without ground truth."""

    reconstruction: ReconstructionResult | None
    """Surface errors; None without a true surface or a mesh."""


def _plain(value: Any) -> Any:
    """A field as JSON takes it."""
    return value.tolist() if isinstance(value, np.ndarray) else value


def _matrix(rows: Any) -> np.ndarray | None:
    """A covariance (6, 6) from its rows; None where there is none."""
    if rows is None:
        return None
    return np.array(rows, np.float64)
