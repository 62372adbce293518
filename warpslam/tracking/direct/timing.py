"""The camera's timing, estimated while it is tracked: delay of depth beyond its stamps, and the readout time.

Each frame is evaluated against the keyframe beside it that the camera passed most differently: there its motion moves
late depth against colour, and late rows against early ones (`warpslam.kernels.direct.timing`). A frame adds 2 x 2
normal equations, from which pose and exposure are eliminated. Twists come from the frames before and after, for an
error of the frame's own pose must not look like motion.

Residuals of one frame, and of frames one after another, err together: the deviation is taken from how much blocks of
frames differ. The weights of a t-distribution make a step too short by its information, which is divided out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from warpslam.camera import MAX_DEPTH_DELAY, MAX_READOUT, ONE_MOMENT, SensorTiming
from warpslam.frames import FrameStatus
from warpslam.kernels.direct.registration import BIAS_PRIOR, GAIN_PRIOR
from warpslam.kernels.direct.timing import COLUMNS, TimedPair
from warpslam.poses import adjoint, inverse
from warpslam.tracking.direct.pyramid import records
from warpslam.tracking.direct.tracker import MIN_OVERLAP, DirectTracker
from warpslam.trajectory import FrameHistory

BLOCK = 10
"""Frames whose errors go together."""
FIRST_BLOCKS, LATER_BLOCKS = 6, 12
"""Blocks before the first estimate, and before the one that corrects it."""
MAX_BLOCKS = 60
"""If nothing was found in as many, there is nothing to find."""
BIAS = 0.002
"""What is left of the timing of images that were rendered, and so have none [s]."""
MAX_SIGMA = 0.004
"""An estimate must be known as well as this [s]."""
SIGNIFICANCE = 3.0
"""Standard deviations that a timing must differ from 0 by."""
MAX_STAGES = 4
"""Estimates."""
SETTLED = 0.003
"""When an estimate is corrected by less, there is no more to find out [s]."""
LINEAR = 0.3
"""A step may be wrong by this share of it: residuals are not linear, and robust weights hold back."""
MAX_STEP = 0.04
"""By which an estimate changes the timing at once [s]: further away residuals are not linear."""
INFORMATION = 0.75
"""(n + 1) / (n + 3), of a t-distribution with n = 5, over the mean of its weights, 1."""
MAX_ELAPSED = 0.2
"""Time from the frame before to the one after [s]; over a longer one the twist is not that of the moment."""
MIN_POINTS = 200
"""Of a pair, residuals of each kind."""
CANDIDATES = 4
"""Keyframes, those of largest overlap, of which a frame is evaluated against one."""
TURN_METRES = 2.0
"""Distance at which a turn moves what is seen [m], to compare with a shift."""

_TRIANGLE = np.tril_indices(COLUMNS)
_SCORES = 5
"""Of a block: the upper triangle of its normal matrix, and the gradient."""


@dataclass(frozen=True)
class FoundTiming:
    """What was found out."""

    timing: SensorTiming
    """Altogether."""
    sigma: tuple[float, float]
    """Standard deviations of delay and readout [s]."""

    def to_dict(self) -> dict[str, float]:
        """As `FrameResult.sensor_timing` has it."""
        return {
            "depth_delay": self.timing.depth_delay,
            "depth_delay_sigma": self.sigma[0],
            "readout": self.timing.readout,
            "readout_sigma": self.sigma[1],
        }


@dataclass(frozen=True)
class TimingState:
    """All that the next estimate depends on."""

    blocks: np.ndarray
    """Number of each block (frames / `BLOCK`), normal matrix (h00, h01, h11) and gradient (g0, g1), float64 (B, 6)."""
    first: int
    """The first frame that the camera took."""
    since: int
    """The first one that counts."""
    stamped: bool
    """Whether depth has stamps of its own."""
    stage: int
    """Estimates that were made."""
    is_done: bool
    """Whether no more is to be found out."""


class TimingEstimator:
    """Gathers what frames say, and says when it is enough.

    Args:
        timing: As it is believed.
        first: The first frame that the camera takes.
    """

    def __init__(self, timing: SensorTiming = ONE_MOMENT, first: int = 0) -> None:
        self.timing, self.first = timing, first
        self._blocks: dict[int, np.ndarray] = {}
        self._since = first
        self._stamped = False
        self._stage = 0
        self.is_done = False

    @property
    def is_open(self) -> bool:
        """Whether depth has stamps of its own, and what is known of the timing may yet change."""
        return self._stamped and not self.is_done

    def look(self, tracker: DirectTracker, history: FrameHistory, depth_offset: float) -> FoundTiming | None:
        """Take in the frame before the last; what was found out by now, if that is news.

        depth_offset: tau of the last frame [s].
        """
        if self.is_done:
            return None
        # Depth stamped as colour is has no clock of its own: rendered, or paired already.
        self._stamped = self._stamped or depth_offset != self.timing.depth_delay
        if not self._stamped:
            return None
        index = len(history) - 2
        if index < self._since:
            return None
        sums = evaluate(tracker, history, index)
        if sums is None:
            return None
        self._blocks.setdefault(index // BLOCK, np.zeros(_SCORES))[:] += sums
        return self._conclude(len(history))

    def _conclude(self, next_frame: int) -> FoundTiming | None:
        wanted = FIRST_BLOCKS if self._stage == 0 else LATER_BLOCKS
        # A block that may grow yet is not counted.
        scores = np.array(list(self._blocks.values()))
        if len(scores) <= wanted:
            return None
        step, sigma = solve(scores, least=(-np.inf, -self.timing.readout))
        if max(sigma) <= MAX_SIGMA and (self._stage > 0 or (np.abs(step) > SIGNIFICANCE * sigma).any()):
            if self._stage == 0:  # one that can't be told from none is none
                step = np.where(np.abs(step) > SIGNIFICANCE * sigma, step, 0.0)
            self.timing = moved(self.timing, step)
            self._blocks, self._since = {}, next_frame + 1
            self._stage += 1
            is_settled = self._stage > 1 and bool((np.abs(step) < SETTLED).all())
            self.is_done = is_settled or self._stage >= MAX_STAGES
            return FoundTiming(self.timing, _told(sigma, step))
        if len(scores) > MAX_BLOCKS:
            self.is_done = True
            if max(sigma) <= MAX_SIGMA:
                return FoundTiming(self.timing, _told(sigma, np.zeros(2)))
        return None

    def state(self) -> TimingState:
        """All of it."""
        rows = [[number, *scores] for number, scores in self._blocks.items()]
        blocks = np.array(rows, np.float64).reshape(-1, 1 + _SCORES)
        return TimingState(blocks, self.first, self._since, self._stamped, self._stage, self.is_done)

    @classmethod
    def restored(cls, state: TimingState, timing: SensorTiming) -> TimingEstimator:
        """What `state` was taken from."""
        new = cls(timing, state.first)
        new._blocks = {int(row[0]): row[1:].copy() for row in state.blocks}
        new._since, new._stamped = state.since, state.stamped
        new._stage, new.is_done = state.stage, state.is_done
        return new


def evaluate(tracker: DirectTracker, history: FrameHistory, index: int) -> np.ndarray | None:
    """Normal matrix (h00, h01, h11) and gradient (g0, g1) of a frame; None if it tells nothing."""
    row, twist = tracker.row_of(index), twist_between(history, index)
    if row is None or twist is None:
        return None
    pose = history.pose(index)
    best, most = None, 0.0
    near = sorted(tracker.overlap.items(), key=lambda item: -item[1])[:CANDIDATES]
    for number, share in near:
        keyframe = tracker.keyframes[number]
        there = twist_between(history, keyframe.index) if share > MIN_OVERLAP and keyframe.index != index else None
        if there is None:
            continue
        T = inverse(pose) @ keyframe.pose
        brought = adjoint(T) @ there
        change = brought - twist
        differs = float(np.linalg.norm(change[:3]) + TURN_METRES * np.linalg.norm(change[3:]))
        if differs > most:
            best, most = (number, T, brought), differs
    if best is None:
        return None
    pair = records(TimedPair)
    pair["row"] = row
    pair["frame_twist"] = twist
    pair["keyframe"], pair["T"], pair["keyframe_twist"] = tracker.points_of(best[0]), best[1], best[2]
    config = tracker.config
    found = tracker.registrar.timing(tracker.judged, pair, config.grey_weight, config.depth_weight)[0]
    if min(found["grey_count"], found["depth_count"]) < MIN_POINTS or not np.isfinite(found["entries"]).all():
        return None
    H = np.zeros((COLUMNS, COLUMNS))
    H[_TRIANGLE] = found["entries"]
    return eliminated(H + np.tril(H, -1).T)


def twist_between(history: FrameHistory, index: int) -> np.ndarray | None:
    """Twist (v, w) of the camera at a frame, from those before and after it, (6,) [m/s, rad/s]; None if not known."""
    if not 0 < index < len(history) - 1 or history.status(index + 1) is not FrameStatus.OK:
        return None
    if not (history.follows(index) and history.follows(index + 1)):
        return None
    elapsed = history.timestamp(index + 1) - history.timestamp(index - 1)
    if not 0.0 < elapsed <= MAX_ELAPSED:
        return None
    return _short_twist(history.pose(index - 1), history.pose(index + 1)) / elapsed


def _short_twist(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """`twist_of` the motion between two poses (4, 4) that is a few degrees long: right to the second order."""
    back = before[:3, :3].T
    R, t = back @ after[:3, :3], back @ (after[:3, 3] - before[:3, 3])
    x, y, z = 0.5 * (R[2, 1] - R[1, 2]), 0.5 * (R[0, 2] - R[2, 0]), 0.5 * (R[1, 0] - R[0, 1])
    stretch = 1.0 + (x * x + y * y + z * z) / 6.0
    x, y, z = stretch * x, stretch * y, stretch * z
    a, b, c = t
    return np.array([a - 0.5 * (y * c - z * b), b - 0.5 * (z * a - x * c), c - 0.5 * (x * b - y * a), x, y, z])


def eliminated(H: np.ndarray) -> np.ndarray:
    """What sums (11, 11) say of delay and readout if pose and exposure adapt: (h00, h01, h11, g0, g1)."""
    own = H[:8, :8] + np.diag([1e-3] * 6 + [float(GAIN_PRIOR), float(BIAS_PRIOR)])
    rest = H[8:, 8:] - H[8:, :8] @ np.linalg.solve(own, H[:8, 8:])
    return np.array([rest[0, 0], rest[0, 1], rest[1, 1], rest[0, 2], rest[1, 2]])


def solve(blocks: np.ndarray, least: tuple[float, float] = (-np.inf, -np.inf)) -> tuple[np.ndarray, np.ndarray]:
    """Change of delay and readout, no less than ``least``, and its standard deviations, (2,) each [s].

    blocks: (h00, h01, h11, g0, g1) each, (B, 5).
    """
    H, g = blocks[:, [0, 1, 1, 2]].reshape(-1, 2, 2), blocks[:, 3:]
    total = H.sum(axis=0)
    if not np.linalg.det(total) > 1e-12 * max(total.trace(), 1e-12) ** 2:
        return np.zeros(2), np.full(2, np.inf)
    step = -np.linalg.solve(total, g.sum(axis=0))
    for k in range(2):
        if step[k] < INFORMATION * least[k]:  # no camera reads backwards: the other one without it
            step[k] = INFORMATION * least[k]
            other = 1 - k
            step[other] = -(g[:, other].sum() + total[other, k] * step[k]) / total[other, other]
    scores = g + H @ step
    scores -= scores.mean(axis=0)
    spread = scores.T @ scores * len(blocks) / max(len(blocks) - 2, 1)
    inverted = np.linalg.inv(total)
    variance = (inverted @ spread @ inverted).diagonal() / INFORMATION**2
    return step / INFORMATION, np.sqrt(variance + BIAS**2)


def _told(sigma: np.ndarray, step: np.ndarray) -> tuple[float, float]:
    """Standard deviations of what a step leads to."""
    delay, readout = np.sqrt(sigma**2 + (LINEAR * step) ** 2).tolist()
    return delay, readout


def moved(timing: SensorTiming, step: np.ndarray) -> SensorTiming:
    """The timing after a step (2,) [s], to a tenth of a millisecond."""
    delay, readout = np.clip(step, -MAX_STEP, MAX_STEP) + (timing.depth_delay, timing.readout)
    return replace(
        timing,
        depth_delay=round(float(np.clip(delay, -MAX_DEPTH_DELAY, MAX_DEPTH_DELAY)), 4) + 0.0,
        readout=round(float(np.clip(readout, 0.0, MAX_READOUT)), 4) + 0.0,
    )
