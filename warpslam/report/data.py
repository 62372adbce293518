"""What a report says about a run, gathered from its folder; whatever the run did not write is None or empty."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from warpslam.errors import DatasetError
from warpslam.evaluation import AteResult, ate
from warpslam.frames import FrameStatus
from warpslam.report.plots import top_view_axes
from warpslam.runs.folder import RunFolder
from warpslam.runs.metrics import RunMetrics
from warpslam.runs.panels import Panel, load_panels
from warpslam.runs.record import RunRecord
from warpslam.runs.request import Source
from warpslam.runs.timing import RunTiming
from warpslam.storage.json_files import read_json
from warpslam.storage.tum import associate, read_tum

SAME_TIME = 1e-6  # [s]


@dataclass(frozen=True)
class RunData:
    """One run."""

    folder: RunFolder
    """Where it lies."""

    metrics: RunMetrics
    """Its figures."""

    timing: RunTiming
    """Its times; empty where the run did not record them."""

    config: str | None
    """Text of the settings; None without."""

    record: RunRecord
    """What became of its frames; empty where the run did not record that."""

    timestamps: np.ndarray
    """[s], shape (N,); N = 0 without a trajectory."""

    poses: np.ndarray
    """T_world_camera, shape (N, 4, 4)."""

    truth: np.ndarray | None
    """Ground truth of the same frames, shape (N, 4, 4), NaN where unknown; None where there is none at all."""

    panels: list[Panel]
    """Frames beside their renderings."""

    source: Source | None
    """How the input was opened; None where that is not known."""

    @classmethod
    def gather(cls, folder: RunFolder) -> RunData:
        """Read a run folder.

        Raises:
            DatasetError: A file is damaged.
        """
        timestamps, poses = np.zeros(0), np.zeros((0, 4, 4))
        if folder.trajectory.is_file():
            timestamps, poses = read_tum(folder.trajectory)
        truth = _read_truth(folder, timestamps)
        return cls(
            folder,
            RunMetrics.read(folder.metrics),
            RunTiming.read(folder.timing) if folder.timing.is_file() else RunTiming(),
            folder.read_config_text(),
            _read_record(folder, poses, truth),
            timestamps,
            poses,
            truth,
            load_panels(folder.panel_images) if folder.panel_images.is_file() else [],
            folder.read_source() if folder.source.is_file() else None,
        )

    @property
    def name(self) -> str:
        """Name of the sequence."""
        return self.metrics.sequence or self.folder.path.name

    @property
    def statuses(self) -> list[FrameStatus]:
        """Status of each pose; OK where the run did not record it."""
        return self.record.statuses or [FrameStatus.OK] * len(self.poses)

    @property
    def frame_indices(self) -> list[int]:
        """Number in the sequence of each pose's frame; counted from 0 where the run did not record it."""
        return self.record.frame_indices or list(range(len(self.poses)))

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


def _read_record(folder: RunFolder, poses: np.ndarray, truth: np.ndarray | None) -> RunRecord:
    if not folder.frame_records.is_file():
        return RunRecord()
    try:
        return RunRecord.from_rows(read_json(folder.frame_records), poses, truth)
    except ValueError as error:
        raise DatasetError(f"{folder.frame_records}: does not fit the run ({error}); run again") from error
