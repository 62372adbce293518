"""What a report says about a run, gathered from its folder; whatever the run did not write is None or empty."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from warpslam.errors import DatasetError
from warpslam.evaluation import AteResult, ate
from warpslam.runs.folder import RunFolder
from warpslam.runs.request import Source
from warpslam.storage.json_files import read_json
from warpslam.storage.tum import associate, read_tum

if TYPE_CHECKING:
    from warpslam.runs.panels import Panel

SAME_TIME = 1e-6  # [s]


@dataclass(frozen=True)
class FrameRecord:
    """What became of a frame.

    index: Number in the sequence. timestamp: [s]. status: "OK", "LOST", "SKIPPED". message: Why it is not OK.
    inliers: See `warpslam.slam.FrameResult`. losses: Mean loss per ray by name. depth_error: Mean error of
    those rays [m].
    """

    index: int
    timestamp: float
    status: str
    message: str
    inliers: float | None
    losses: dict[str, float | None]
    depth_error: float | None = None


@dataclass(frozen=True)
class RunData:
    """One run.

    folder: Where it lies.
    metrics, timing: Content of the files of these names; timing is empty where there is none.
    config: Text of the settings, None without.
    frames: One a pose, in order; empty where the run did not record them.
    left_out: Frames that could not be read, {"index", "message"} each.
    timestamps: [s], shape (N,). poses: T_world_camera, shape (N, 4, 4). N = 0 without a trajectory.
    truth: Ground truth of the same frames, shape (N, 4, 4), NaN where unknown; None where there is none at all.
    panels: Frames beside their renderings.
    source: How the input was opened; None where that is not known.
    """

    folder: RunFolder
    metrics: dict[str, Any]
    timing: dict[str, Any]
    config: str | None
    frames: list[FrameRecord]
    left_out: list[dict[str, Any]]
    timestamps: np.ndarray
    poses: np.ndarray
    truth: np.ndarray | None
    panels: list[Panel]
    source: Source | None

    @classmethod
    def gather(cls, folder: RunFolder) -> RunData:
        """Read a run folder.

        Raises:
            DatasetError: A file is damaged.
        """
        from warpslam.runs.panels import load_panels

        timestamps, poses = np.zeros(0), np.zeros((0, 4, 4))
        if folder.trajectory.is_file():
            timestamps, poses = read_tum(folder.trajectory)
        frames, left_out = _read_frames(folder)
        if frames and len(frames) != len(poses):
            raise DatasetError(f"{folder.frame_records} has {len(frames)} frames and the trajectory {len(poses)}")
        return cls(
            folder,
            read_json(folder.metrics),
            read_json(folder.timing) if folder.timing.is_file() else {},
            folder.config.read_text(encoding="utf-8") if folder.config.is_file() else None,
            frames,
            left_out,
            timestamps,
            poses,
            _read_truth(folder, timestamps),
            load_panels(folder.panel_images) if folder.panel_images.is_file() else [],
            folder.read_source() if folder.source.is_file() else None,
        )

    def figure(self, *names: str) -> Any:
        """The metric at a path of names, such as ("ate_m", "aligned", "rmse"); None where the run has none."""
        value: Any = self.metrics
        for name in names:
            value = value.get(name) if isinstance(value, dict) else None
        return value

    @property
    def name(self) -> str:
        """Name of the sequence."""
        return str(self.figure("sequence") or self.folder.path.name)

    @property
    def statuses(self) -> list[str]:
        """Status of each pose; OK where the run did not record it."""
        return [frame.status for frame in self.frames] or ["OK"] * len(self.poses)

    @property
    def frame_indices(self) -> list[int]:
        """Number in the sequence of each pose's frame; counted from 0 where the run did not record it."""
        return [frame.index for frame in self.frames] or list(range(len(self.poses)))

    @cached_property
    def ate(self) -> AteResult | None:
        """Trajectory error after alignment; None without ground truth."""
        return None if self.truth is None else ate(self.poses, self.truth)

    @property
    def aligned_poses(self) -> np.ndarray:
        """Poses in the frame of the ground truth, shape (N, 4, 4); as they are where there is none."""
        return self.poses if self.ate is None else self.ate.T_truth_estimate @ self.poses


def upright_axes(poses: np.ndarray) -> np.ndarray:
    """World axes as a viewer from above sees them: right, away and up, the rows of a rotation (3, 3).

    Up is the world axis nearest to the cameras' mean up, since people hold them upright; the seen plane is never
    mirrored.
    """
    from warpslam.report.plots import top_view_axes

    right, away = (np.eye(3)[axis] for axis in top_view_axes(poses))
    up = np.cross(right, away)
    if up @ -poses[:, :3, 1].mean(axis=0) < 0:
        right, up = -right, -up
    return np.stack([right, away, up])


def axis_name(direction: np.ndarray) -> str:
    """Name of a unit vector along a world axis, such as x or −z."""
    axis = int(np.argmax(np.abs(direction)))
    return ("−" if direction[axis] < 0 else "") + "xyz"[axis]


def _read_truth(folder: RunFolder, timestamps: np.ndarray) -> np.ndarray | None:
    if not folder.ground_truth.is_file():
        return None
    times, poses = read_tum(folder.ground_truth)
    partner = associate(timestamps, times, SAME_TIME)
    if not (partner >= 0).any():
        return None
    truth = np.full((len(timestamps), 4, 4), np.nan)
    truth[partner >= 0] = poses[partner[partner >= 0]]
    return truth


def _read_frames(folder: RunFolder) -> tuple[list[FrameRecord], list[dict[str, Any]]]:
    if not folder.frame_records.is_file():
        return [], []
    content = read_json(folder.frame_records)
    try:
        return [FrameRecord(**frame) for frame in content["frames"]], list(content["left_out"])
    except (KeyError, TypeError) as error:
        raise DatasetError(f"{folder.frame_records}: field {error} is missing or unknown; run again") from error
