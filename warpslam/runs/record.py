"""What has become of a run so far."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from warpslam.evaluation import AteResult, ReconstructionResult
from warpslam.runs.folder import RunFolder

if TYPE_CHECKING:
    from warpslam.frames import FrameResult


@dataclass(frozen=True)
class Progress:
    """State of a run after a frame.

    done, total: Frames processed so far and selected.
    ate_rmse: ATE RMSE so far, aligned [m]; None without ground truth.
    fps: Frames a second so far, set-up left out.
    """

    done: int
    total: int
    result: FrameResult
    ate_rmse: float | None
    fps: float


@dataclass(frozen=True)
class RunResult:
    """What a run came to.

    status: "finished", "interrupted" (by ctrl-C; everything up to then is written) or "failed".
    metrics: Content of metrics.json.
    """

    folder: RunFolder
    status: str
    metrics: dict[str, Any]
    ate: AteResult | None
    reconstruction: ReconstructionResult | None


@dataclass
class RunProgress:
    """How far a run has come.

    position: Frames of the selection that are done, unreadable ones included. frame_indices, truth_poses (4, 4; NaN
    where unknown), results: Of each processed frame. left_out: Index and message of each unreadable one. seconds: By
    stage. first_index: Frames that the map had seen before. digests: SHA-256 of the first and the last frame, by frame
    number.
    """

    position: int = 0
    frame_indices: list[int] = field(default_factory=list)
    truth_poses: list[np.ndarray] = field(default_factory=list)
    results: list[FrameResult] = field(default_factory=list)
    left_out: list[dict[str, Any]] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)
    first_index: int = 0
    digests: dict[int, str] = field(default_factory=dict)


def result_row(result: FrameResult) -> dict[str, Any]:
    """A result without its pose, as JSON takes it."""
    return {f.name: getattr(result, f.name) for f in dataclasses.fields(result) if f.name != "T_world_camera"}
