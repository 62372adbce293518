"""The loop of a run: each frame of the selection is read, given to the method, and entered into the record."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from warpslam.errors import DatasetError
from warpslam.evaluation import ate
from warpslam.frames import FrameStatus
from warpslam.pipeline.metrics_files import found_timing
from warpslam.pipeline.read_ahead import ReadAhead
from warpslam.pipeline.results import trajectory_of
from warpslam.runs.metrics import FoundTiming
from warpslam.runs.record import Progress
from warpslam.runtime.stopping import raise_if_terminated
from warpslam.sequences.base import EndOfFrames

if TYPE_CHECKING:
    from warpslam.frames import FrameResult
    from warpslam.pipeline.checkpoints import Checkpoints
    from warpslam.pipeline.forecast import Forecast
    from warpslam.pipeline.methods import Method
    from warpslam.pipeline.observer import Observer
    from warpslam.runs.given_poses import GivenPoses
    from warpslam.runs.record import RunRecord
    from warpslam.sequences.base import Frame, RgbdSequence

log = logging.getLogger(__name__)


@dataclass(eq=False)
class FrameLoop:
    """What takes a method through the frames of a run."""

    sequence: RgbdSequence
    """Input."""

    selected: range
    """Numbers of the frames to use."""

    slam: Method
    """What is given the frames."""

    record: RunRecord
    """Filled as frames are done; a run that was resumed has some in it."""

    given: GivenPoses | None
    """Poses that take the place of the sequence's own."""

    poses_are_wanted: bool
    """The method takes all poses as they are given: a frame without one is no use."""

    world_is_known: bool
    """The method's world is that of the true poses; a map that was loaded has its own."""

    checkpoints: Checkpoints
    observer: Observer
    forecast: Forecast
    """Of the time that is left."""
    _next_ate: int = 0
    _ate: float | None = None

    def run(self) -> None:
        """Process the frames that are left.

        Raises:
            DatasetError: Not a single frame could be used.
        """
        self.checkpoints.before_frames(self.record, self.slam)
        for frame in self._readable_frames():
            raise_if_terminated()
            truth = _true_pose(frame)
            result = self.slam.step(
                frame.rgb,
                frame.depth,
                timestamp=frame.timestamp,
                T_world_camera=self._given_pose(frame, truth),
                depth_timestamp=frame.depth_timestamp,
            )
            self.record.add(frame.index, truth, result)
            level = logging.INFO if result.status == FrameStatus.OK else logging.WARNING
            log.log(level, "frame %d: %s", frame.index, _describe(result))
            if result.sensor_timing:
                found = FoundTiming.model_validate(found_timing(self.record, self.sequence))
                log.info("the camera's timing was estimated: %s", found.text)
            self.observer.frame(self._progress(frame, result))
            self.checkpoints.after_frame(frame, self.record, self.slam)
        self._check_that_one_was_used()

    def _readable_frames(self) -> Iterator[Frame]:
        with ReadAhead(self.sequence, self.selected[self.record.position :]) as reader:
            yield from self._frames_of(reader)

    def _frames_of(self, reader: ReadAhead) -> Iterator[Frame]:
        record = self.record
        last = record.results[-1].timestamp if record.results else -np.inf
        for index in reader.indices:
            record.position += 1
            try:
                with record.clock("reading"):
                    frame = reader.take()
                # Against the frame before, whatever became of it: a single wrong time costs one frame, not the rest.
                before, last = last, frame.timestamp
                if last <= before:
                    raise DatasetError(f"its time {last:.6f} s is not after {before:.6f} s, that of the frame before")
                if self.given is not None and self.given.of(frame) is None:
                    raise DatasetError(f"{self.given.path} has no pose for {frame.timestamp:.3f} s")
            except EndOfFrames:
                record.position -= 1
                return
            except DatasetError as error:
                record.leave_out(index, str(error))
                log.warning("frame %d left out: %s", index, error)
                continue
            yield frame

    def _given_pose(self, frame: Frame, truth: np.ndarray) -> np.ndarray | None:
        """The pose (4, 4) that the method is told; NaN makes it skip the frame, and the run goes on."""
        if self.given is not None:
            return self.given.of(frame)
        if self.poses_are_wanted:
            return truth
        return truth if self.world_is_known and np.isfinite(truth).all() else None

    def _progress(self, frame: Frame, result: FrameResult) -> Progress:
        record, processed = self.record, len(self.record.results)
        # Of all poses so far, and so dearer by the frame: asked anew when there are a twentieth more, and at the end.
        if processed >= self._next_ate or record.position == len(self.selected):
            self._next_ate = processed + 1 + processed // 20
            self._ate = ate(trajectory_of(self.slam, record).poses, record.truth).rmse if record.has_truth else None
        done = processed + len(record.left_out)
        seconds_left = self.forecast.after_frame(result, done)
        total = len(self.selected)
        if self.sequence.is_live:  # until somebody ends it
            total, seconds_left = done, 0.0
        return Progress(done, total, result, self._ate, self.forecast.fps, seconds_left, frame)

    def _check_that_one_was_used(self) -> None:
        name, results = self.sequence.name, self.record.results
        if not results:
            raise DatasetError(f"{name}: none of the {len(self.selected)} selected frames can be read")
        if all(result.status == FrameStatus.SKIPPED for result in results):
            raise DatasetError(f"{name}: none of the {len(results)} frames can be used: {results[-1].message}")


def _true_pose(frame: Frame) -> np.ndarray:
    """True T_world_camera (4, 4); all NaN where it is unknown in part or in all."""
    T_world_camera = frame.T_world_camera
    if T_world_camera is None or not np.isfinite(T_world_camera).all():
        return np.full((4, 4), np.nan)
    return T_world_camera


def _describe(result: FrameResult) -> str:
    losses = " ".join(f"{name}={value:.4g}" for name, value in result.losses.items())
    inliers = "" if np.isnan(result.inliers) else f"inliers={result.inliers:.2f}"
    return " ".join(part for part in (result.status, losses, inliers, result.message) if part)
