"""How long a run will still take: its frames, and all that comes after the last of them."""

from __future__ import annotations

import statistics
import time
from collections import deque
from typing import TYPE_CHECKING

from warpslam.errors import WarpSlamError
from warpslam.frames import FrameStatus
from warpslam.runs.panels import PANEL_COUNT, panel_stride

if TYPE_CHECKING:
    from warpslam.config import Config
    from warpslam.frames import FrameResult
    from warpslam.pipeline.methods import Method
    from warpslam.sequences.base import RgbdSequence

_RECENT = 40  # frames, some calls of mapping among them
_PROBE_FRAME = 4  # the map has something in it, and everything is warm
_PROBE_RAYS = 400
_MESHING, _EVALUATION = 0.15, 0.7  # of the time that rendering the panels takes, as measured in runs on two cores
_PLOTS = 4.0  # [s]: plots, mesh views and the report


class RecentRate:
    """Frames a second of the last frames, which tell how long the others will take. The first frame, with the first
    mapping, is like no other, and counts until there is a second.

    Args:
        start: Clock before the first frame [s].
        period: Every so many frames one is mapped, which takes longer: whole periods are looked at, once there is one.
    """

    def __init__(self, start: float, period: int = 1) -> None:
        self._period = min(max(period, 1), _RECENT)
        self._ends = deque([start], maxlen=_RECENT + 1)
        self._count = 0

    def after_frame(self, now: float) -> float:
        """The rate [1/s] when the clock shows ``now`` [s] at the end of a frame."""
        self._count += 1
        self._ends.append(now)
        if self._count == 2:
            self._ends.popleft()
        count = len(self._ends) - 1
        if self._count > self._period:
            count -= count % self._period
        return count / max(self._ends[-1] - self._ends[-1 - count], 1e-9)


class Forecast:
    """Seconds that are left of a run, asked after every frame.

    Frames go by the rate of those before. What follows them goes by what it is made of: rounds of refinement cost what
    a call of mapping does, and the pictures what a small one did that is rendered as a probe, once, which changes
    nothing.

    Args:
        config: Settings of the run.
        sequence: Input.
        method: What is given the frames.
        frame_count: Frames that were selected.
        evaluates: There is a true surface to compare with.
        start: Clock before the first frame [s].
    """

    def __init__(
        self,
        config: Config,
        sequence: RgbdSequence,
        method: Method,
        frame_count: int,
        *,
        evaluates: bool = False,
        start: float | None = None,
    ) -> None:
        self._config, self._camera, self._method = config, sequence.intrinsics, method
        self._total, self._evaluates = frame_count, evaluates
        self._maps = config.mapping.enabled
        every = config.mapping.every if self._maps else 1
        self._rate = RecentRate(time.perf_counter() if start is None else start, every)
        self._calls: deque[float] = deque(maxlen=8)  # of mapping [s], but the first
        self._first_call: float | None = None
        self._pictures: float | None = None
        self._done = 0
        self.fps = 0.0

    def after_frame(self, result: FrameResult, done: int) -> float:
        """Seconds left after a frame, of which ``done`` are done."""
        self._done += 1
        self._note_mapping(result)
        self.fps = self._rate.after_frame(time.perf_counter())
        if self._maps and self._pictures is None and self._done > _PROBE_FRAME and result.status == FrameStatus.OK:
            self._pictures = self._probe(result)
        return max(self._total - done, 0) / self.fps + self.after_frames

    @property
    def after_frames(self) -> float:
        """Seconds from the last frame to the end, as far as can be told."""
        if not self._maps:
            return _PLOTS
        pictures = self._pictures or 0.0
        share = 1.0 + _MESHING + (_EVALUATION if self._evaluates else 0.0)
        return self._refinement + share * pictures + _PLOTS

    @property
    def _refinement(self) -> float:
        mapping = self._config.mapping
        if self._calls:
            call = statistics.median(self._calls)
        elif self._first_call is not None:
            call = self._first_call * mapping.iterations / max(mapping.first_iterations, 1)
        else:
            return 0.0
        return call * (mapping.refinement_rounds if mapping.color_refinement else 0)

    def _note_mapping(self, result: FrameResult) -> None:
        seconds = result.timings.get("mapping")
        if seconds is None:
            return
        if self._first_call is None:
            self._first_call = seconds
        else:
            self._calls.append(seconds)

    def _probe(self, result: FrameResult) -> float:
        """Seconds that rendering all panels will take; 0 where the method renders nothing yet."""
        camera = self._camera
        stride = max(1, round((camera.width * camera.height / _PROBE_RAYS) ** 0.5))
        start = time.perf_counter()
        try:
            image = self._method.render(result.T_world_camera, stride=stride)
        except WarpSlamError:
            return 0.0
        each = (time.perf_counter() - start) / max(image.depth.size, 1)
        panel = panel_stride(camera.width)
        return PANEL_COUNT * each * (camera.width / panel) * (camera.height / panel)
