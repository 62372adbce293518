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
_PROBE_RAYS = 400, 2500  # of two views: a launch costs the same for any number, a ray something more
_USUAL_KEYFRAMES, _USUAL_FRAMES = 2, 30  # so many in so many: what is expected before there are frames to go by
_MESHING = 0.15  # of the time that rendering the panels takes
_A_RAY = 2.0  # samples that take as long as a ray without any
# [s]. Neither the map nor its device has a part in these.
_EVALUATION, _EVALUATION_A_FRAME = 6.0, 0.08
_PLOTS = 4.0  # mesh views and the report, too


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

    def leave_out(self, seconds: float) -> None:
        """Time that passed since the last frame, and is none of the next."""
        self._ends = deque((end + seconds for end in self._ends), maxlen=self._ends.maxlen)


class Forecast:
    """Seconds that are left of a run, asked after every frame.

    Frames go by the rate of those before. What follows them goes by what it is made of: an iteration of refinement
    costs what one of mapping does, more where it has more samples, and the pictures what two small ones did that are
    rendered as a probe, once, which changes nothing.

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
        self._is_live = sequence.is_live
        every = config.mapping.every if self._maps else 1
        self._rate = RecentRate(time.perf_counter() if start is None else start, every)
        self._calls: deque[float] = deque(maxlen=8)  # of mapping [s], but the first
        self._first_call: float | None = None
        self._pictures: float | None = None
        self._done = 0
        self.fps = 0.0

    def after_frame(self, result: FrameResult, done: int) -> float:
        """Seconds left after a frame, of which ``done`` are done; 0 where nothing tells, as after the first one, in
        which more is mapped than in any other.
        """
        self._done += 1
        self._note_mapping(result)
        self.fps = self._rate.after_frame(time.perf_counter())
        # Nobody knows when a live run ends, and its frames do not wait.
        may_probe = self._maps and not self._is_live and self._pictures is None
        if may_probe and self._done > _PROBE_FRAME and result.status == FrameStatus.OK:
            start = time.perf_counter()
            self._pictures = self._probe(result)
            self._rate.leave_out(time.perf_counter() - start)
        if self._done == 1:
            return 0.0
        return max(self._total - done, 0) / self.fps + self.after_frames

    @property
    def after_frames(self) -> float:
        """Seconds from the last frame to the end, as far as can be told."""
        if not self._maps:
            return _PLOTS
        pictures = self._pictures or 0.0
        evaluation = _EVALUATION + _EVALUATION_A_FRAME * self._total if self._evaluates else 0.0
        return self._refinement + (1.0 + _MESHING) * pictures + evaluation + _PLOTS

    @property
    def _refinement(self) -> float:
        mapping = self._config.mapping
        if self._calls:
            call = statistics.median(self._calls)
        elif self._first_call is not None:
            call = self._first_call * mapping.iterations / max(mapping.first_iterations, 1)
        else:
            return 0.0
        keyframes = getattr(self._method, "keyframes", None)
        if keyframes is None or not mapping.color_refinement:
            return 0.0
        if getattr(self._method, "name", "") == "imap":
            return call * self._config.imap.refinement_rounds
        iterations = float(mapping.refinement_iterations or mapping.iterations)
        if mapping.loss == "direct":  # as many samples a second, of which a ray of the rendering loss has more
            direct, sampling = self._config.supervision, self._config.sampling
            samples = direct.free_samples + direct.near_samples + 1
            rendered = sampling.stratified + sampling.surface
            iterations = iterations * (rendered + _A_RAY) / (samples + _A_RAY) + mapping.refined_directly
        # The first frame is one in any case, and tells nothing of how many follow.
        count = (len(keyframes) - 1 + _USUAL_KEYFRAMES) / (self._done + _USUAL_FRAMES) * self._total
        return call * iterations / mapping.iterations * mapping.rounds_for(round(count))

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

        def view(rays: int) -> tuple[int, float]:
            stride = max(1, round((camera.width * camera.height / rays) ** 0.5))
            start = time.perf_counter()
            image = self._method.render(result.T_world_camera, stride=stride)
            return image.depth.size, time.perf_counter() - start

        few, many = _PROBE_RAYS
        try:
            view(few)  # kernels that were never launched are loaded
            (fewer, short), (more, long) = view(few), view(many)
        except WarpSlamError:
            return 0.0
        each = max(long - short, 0.0) / max(more - fewer, 1)
        fixed = max(short - each * fewer, 0.0)
        panel = panel_stride(camera.width)
        return PANEL_COUNT * (fixed + each * (camera.width / panel) * (camera.height / panel))
