"""When a camera's sensors see, found from its images alone: no true poses, no target.

Depth that is believed to be taken at a wrong time, or rows at wrong times, do not fit a frame some steps later where
the camera moved. `AlignmentCost` aligns pairs of frames under a hypothesis, a delay of depth beyond the stamps and a
readout time, and returns the mean robust residual that is left. `find_timing` looks for the minimum of any such cost:
a grid, a finer one around its lowest node, and a quadratic through that, which also says how flat the minimum is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp

from warpslam.camera import MAX_DEPTH_DELAY, MAX_READOUT, ONE_MOMENT, Intrinsics, SensorTiming
from warpslam.errors import DatasetError, InputError
from warpslam.frames import read_images
from warpslam.kernels.direct import equations as eq
from warpslam.kernels.direct import points
from warpslam.poses import motion_of, twist_of
from warpslam.scene.image_pool import ImagePool
from warpslam.sequences.base import RgbdSequence
from warpslam.tracking.direct.measures import Measures
from warpslam.tracking.direct.pyramid import PyramidPlan
from warpslam.tracking.direct.registrar import Floors, Registrar, new_tasks

Cost = Callable[[SensorTiming], float]
"""Mean cost under a hypothesis."""

READOUTS = (0.0, 0.01, 0.02, 0.03, 0.04)
"""Of the coarse grid [s]; the next frame is on its way after 1/30 s."""
DELAYS = (-0.06, -0.04, -0.02, 0.0, 0.02, 0.04, 0.06)
"""Of the coarse grid [s]."""
FINE_STEP = 0.005
"""Of the fine grid, two nodes to each side of the lowest [s]."""
TOLERANCE = 0.01
"""Timings whose cost is within this share of the lowest can't be told from it."""
MAX_SPREAD = 0.015
"""A value that may be further off than this [s] is not determined."""

MIN_WIDTH = 120
"""The second largest images of the pyramid are compared if they are as wide [px], else the largest."""
PAIRS = 40
"""Pairs of frames that are aligned."""
GAPS = (3, 4)
"""Frames between those of a pair, in turn."""
MIN_PAIRS = 8
MIN_AGREEMENT, MIN_CORRELATION, MIN_VIEW = 0.5, 0.7, 0.4
"""Pairs that do not fit as well as this are left out."""
BLUR = 1.5
"""Of colour images before they are compared [pixels of the level], as a standard deviation."""
FLOORS = Floors(6.0, 1.5)
"""Residuals are measured by these scales, grey values and standard deviations of depth, if they spread by no more."""


@dataclass(frozen=True)
class Estimate:
    """One of the two times."""

    seconds: float
    """At the lowest cost [s]."""
    spread: float
    """By which it may be off, the other one adapting, before the cost rises by `TOLERANCE` of the lowest [s]."""
    at_edge: bool
    """Whether the lowest cost is at the edge of what was looked at."""

    @property
    def is_determined(self) -> bool:
        """Whether the recording tells it."""
        return self.spread <= MAX_SPREAD and not self.at_edge


@dataclass(frozen=True)
class TimingEstimate:
    """What the images of a recording say of its camera."""

    depth_delay: Estimate
    readout: Estimate
    cost: float
    """Lowest mean cost."""
    uncorrected: float
    """Mean cost without delay and readout."""
    believed: SensorTiming = ONE_MOMENT
    """What was known before."""

    @property
    def timing(self) -> SensorTiming:
        """Both, to the millisecond; one that is not determined stays as it was."""
        delay, readout = self.depth_delay, self.readout
        return SensorTiming(
            round(delay.seconds, 3) + 0.0 if delay.is_determined else self.believed.depth_delay,
            round(readout.seconds, 3) + 0.0 if readout.is_determined else self.believed.readout,
        )


def find_timing(
    cost: Cost, believed: SensorTiming = ONE_MOMENT, report: Callable[[int], None] | None = None
) -> TimingEstimate:
    """The delay and readout of the lowest cost.

    Args:
        cost: Mean cost of a hypothesis; asked for each at most once.
        believed: What was known before, and stays where the cost does not tell.
        report: Told of the number of hypotheses that were tried, after each.
    """
    known: dict[tuple[float, float], float] = {}

    def at(readout: float, delay: float) -> float:
        node = round(readout, 6), round(delay, 6)
        if node not in known:
            known[node] = cost(SensorTiming(node[1], node[0]))
            if report is not None:
                report(len(known))
        return known[node]

    nodes = [(readout, delay) for readout in READOUTS for delay in DELAYS]
    readout, delay = min(nodes, key=lambda node: at(*node))
    for _ in range(2):  # once more, if the lowest node of the fine grid is at its edge
        fine = _around(readout, delay)
        lowest = min(fine, key=lambda node: at(*node))
        moved = max(abs(lowest[0] - readout), abs(lowest[1] - delay)) > 1.5 * FINE_STEP
        readout, delay = lowest
        if not moved:
            break
    fine = _around(readout, delay)
    costs = np.array([at(*node) for node in fine])
    estimates = _quadratic_minimum(np.array(fine), costs)
    if not estimates[1].is_determined and estimates[0].is_determined:
        # What it would have adapted to is not to be believed: the readout that fits the delay that stays.
        line = [(value, believed.depth_delay) for value in sorted({node[0] for node in fine})]
        alone = _quadratic_line(np.array([value for value, _ in line]), np.array([at(*node) for node in line]))
        estimates = alone, estimates[1]
    return TimingEstimate(estimates[1], estimates[0], float(costs.min()), at(0.0, 0.0), believed)


def _around(readout: float, delay: float) -> list[tuple[float, float]]:
    """Nodes of the fine grid."""
    steps = FINE_STEP * np.arange(-2, 3)
    first = max(readout, 2 * FINE_STEP)  # no camera reads backwards
    nodes = [(first + a, delay + b) for a in steps for b in steps]
    return [(a, b) for a, b in nodes if 0 <= a <= MAX_READOUT and abs(b) <= MAX_DEPTH_DELAY]


def _quadratic_minimum(nodes: np.ndarray, costs: np.ndarray) -> tuple[Estimate, Estimate]:
    """Readout and delay at the minimum of a quadratic through costs at nodes (n, 2) [s]."""
    center = nodes.mean(axis=0)
    x, y = ((nodes - center) / FINE_STEP).T
    a = np.stack([np.ones_like(x), x, y, 0.5 * x * x, x * y, 0.5 * y * y], axis=1)
    _, gx, gy, hxx, hxy, hyy = np.linalg.lstsq(a, costs, rcond=None)[0]
    lowest = nodes[costs.argmin()]
    limit = TOLERANCE * costs.min()
    H = np.array([[hxx, hxy], [hxy, hyy]])
    # Curvature along one, the other adapting.
    profile = [hxx - hxy * hxy / hyy if hyy > 0 else 0.0, hyy - hxy * hxy / hxx if hxx > 0 else 0.0]
    spreads = [FINE_STEP * float(np.sqrt(2.0 * limit / k)) if k > 0 else float(np.inf) for k in profile]
    at = lowest
    if min(profile) > 0:
        at = center - FINE_STEP * np.linalg.solve(H, [gx, gy])
    low, high = nodes.min(axis=0), nodes.max(axis=0)
    # Readout may well be 0; there the cost rises from its edge on.
    low[0] = -np.inf if low[0] == 0.0 else low[0]
    outside = (at < low - 1e-9) | (at > high + 1e-9)
    at = np.clip(at, nodes.min(axis=0), nodes.max(axis=0))
    readout, delay = (Estimate(float(at[n]), spreads[n], bool(outside[n])) for n in range(2))
    return readout, delay


def _quadratic_line(values: np.ndarray, costs: np.ndarray) -> Estimate:
    """The same along one axis."""
    center = values.mean()
    x = (values - center) / FINE_STEP
    k, g, _ = np.polyfit(x, costs, 2) * [2.0, 1.0, 1.0]
    if k <= 0:
        return Estimate(float(values[costs.argmin()]), float(np.inf), False)
    at = center - FINE_STEP * g / k
    spread = FINE_STEP * float(np.sqrt(2.0 * TOLERANCE * costs.min() / k))
    outside = at > values.max() or (at < values.min() and values.min() > 0.0)
    return Estimate(float(np.clip(at, values.min(), values.max())), spread, bool(outside))


@dataclass
class _Pair:
    """Two frames of a recording; rows are those of their images in the registrar."""

    rows: tuple[int, int]
    twists: tuple[np.ndarray, np.ndarray]
    """Of the camera at each [m/s, rad/s]."""
    stamped: tuple[float, float]
    """Time of depth minus that of colour by the stamps [s]."""
    T: np.ndarray
    """From the axes of the first to those of the second, where alignment starts (4, 4)."""


@dataclass(eq=False)
class AlignmentCost:
    """Mean cost of pairs of frames, each aligned under a hypothesis by direct registration.

    Twists come from the frames before and after each frame of a pair.

    Args:
        sequence: Recording.
        selected: Numbers of the frames to use.
        device: Where it computes.
        max_depth: Depth beyond this is not used [m].

    Raises:
        DatasetError: Too few pairs can be read and aligned.
    """

    sequence: RgbdSequence
    selected: range
    device: wp.Device
    max_depth: float = 8.0
    pairs: list[_Pair] = field(default_factory=list)

    def __post_init__(self) -> None:
        camera: Intrinsics = self.sequence.intrinsics
        self._plan = PyramidPlan.of(camera)
        is_fine = self._plan.top >= 1 and int(self._plan.levels[1]["width"]) >= MIN_WIDTH
        self._level = 1 if is_fine else 0
        starts = _spread(len(self.selected), PAIRS)
        # Three rows more for the frames around one.
        self._registrar = Registrar(self._plan, 2 * len(starts) + 3, self.max_depth, FLOORS, self.device)
        self._images = ImagePool(camera, self.device, capacity=1)
        for number, start in enumerate(starts):
            pair = self._load_pair(start, GAPS[number % len(GAPS)])
            if pair is not None:
                self.pairs.append(pair)
        if len(self.pairs) < MIN_PAIRS:
            raise DatasetError(
                f"{self.sequence.name}: only {len(self.pairs)} of {len(starts)} pairs of frames can be aligned, "
                f"{MIN_PAIRS} are needed; use more frames, or a recording with more texture"
            )

    @property
    def speed(self) -> tuple[float, float]:
        """Mean speed [m/s] and turn [rad/s] of the camera at the frames used."""
        twists = np.array([twist for pair in self.pairs for twist in pair.twists])
        return float(np.linalg.norm(twists[:, :3], axis=1).mean()), float(np.linalg.norm(twists[:, 3:], axis=1).mean())

    def __call__(self, timing: SensorTiming) -> float:
        """Mean cost of all pairs, each residual with the same weight."""
        tasks = new_tasks(len(self.pairs))
        tasks["grey"] = tasks["depth"] = 1.0
        tasks["top"] = tasks["low"] = self._level
        for number, pair in enumerate(self.pairs):
            for row, twist, stamped in zip(pair.rows, pair.twists, pair.stamped, strict=True):
                self._registrar.set_motion(row, _motion(twist, stamped + timing.depth_delay, timing.readout))
            self._registrar.select(pair.rows[0], number, self._level)
            tasks[number]["keyframe"], tasks[number]["row"], tasks[number]["T"] = number, pair.rows[1], pair.T
        results = self._registrar.register(tasks)
        return float(np.mean([_cost(record) for record in results[_record_name(self._level)]]))

    # -- pairs ---------------------------------------------------------------------------------------------------

    def _load_pair(self, start: int, gap: int) -> _Pair | None:
        """The pair from the ``start``-th selected frame on; None if a frame can't be read, or nothing fits."""
        row = 2 * len(self.pairs)
        first, second = self._load(start, row), self._load(start + gap, row + 1)
        if first is None or second is None:
            return None
        twist_a, twist_b = self._twist(start), self._twist(start + gap)
        if twist_a is None or twist_b is None:
            return None
        seconds = second[0] - first[0]
        guess = motion_of(-0.5 * seconds * (twist_a + twist_b))
        T = self._align(row, row + 1, guess)
        if T is None:
            return None
        return _Pair((row, row + 1), (twist_a, twist_b), (first[1], second[1]), T)

    def _load(self, position: int, row: int) -> tuple[float, float] | None:
        """Load a frame; its time, and that of its depth less its own [s]."""
        try:
            frame = self.sequence[self.selected[position]]
            rgb, depth = read_images(frame.rgb, frame.depth, self.sequence.intrinsics, self.max_depth)
        except (DatasetError, InputError):
            return None
        # Between pixels a sharp image is smoother than on them, and fits better: where hypotheses move points off their
        # own pixel they would win by that alone, no motion at all would lose.
        rgb = _blurred(rgb, BLUR * (self._plan.edge << self._level))
        self._images.set(0, rgb, depth)
        arrays = self._images.arrays
        self._registrar.load(row, arrays[0][0], arrays[1][0], arrays[2])
        depth_time = frame.timestamp if frame.depth_timestamp is None else frame.depth_timestamp
        return frame.timestamp, depth_time - frame.timestamp

    def _twist(self, position: int) -> np.ndarray | None:
        """Twist of the camera at a frame, from those before and after it, in its own axes nearly enough."""
        row = self._registrar.rows - 3
        before, after = self._load(position - 1, row), self._load(position + 1, row + 1)
        if before is None or after is None or after[0] <= before[0]:
            return None
        T = self._align(row, row + 1, np.eye(4))
        return None if T is None else twist_of(T) / (before[0] - after[0])

    def _align(self, a: int, b: int, start: np.ndarray) -> np.ndarray | None:
        """From the axes of the frame in row ``a`` to those of ``b``, all pixels taken at once; None if they do not fit.

        start: (4, 4).
        """
        for row in (a, b):
            self._registrar.set_motion(row, None)
        scratch = PAIRS  # no pair has this number
        self._registrar.select(a, scratch)
        task = new_tasks(1)
        task["grey"] = task["depth"] = 1.0
        task["keyframe"], task["row"], task["top"], task["low"] = scratch, b, self._plan.top, self._level
        task["T"] = start
        result = self._registrar.register(task)[0]
        measures = Measures.of(result[_record_name(self._level)])
        fits = measures.agreement > MIN_AGREEMENT and measures.correlation > MIN_CORRELATION
        if not (result["ok"] and fits and measures.view > MIN_VIEW and np.isfinite(result["T"]).all()):
            return None
        return np.asarray(result["T"], np.float64)


def _blurred(rgb: np.ndarray, sigma: float) -> np.ndarray:
    import cv2

    return np.asarray(cv2.GaussianBlur(rgb, (0, 0), sigma))


def _record_name(level: int) -> str:
    return f"record_{level}"


def _cost(record: np.ndarray) -> float:
    """Mean negative log-likelihood of a residual under t-distributions, against that of a spread at the floors."""
    grey, depth = float(record[eq.GREY_COUNT]), float(record[eq.DEPTH_COUNT])
    wider = grey * np.log(record[eq.GREY_SCALE] / FLOORS.grey) + depth * np.log(record[eq.DEPTH_SCALE] / FLOORS.depth)
    return float(record[eq.COST] + wider) / max(grey + depth, 1.0)


def _motion(twist: np.ndarray, depth_offset: float, readout: float) -> np.ndarray:
    struct: Any = points.Motion
    motion: Any = np.zeros(1, struct.numpy_dtype())
    motion["to_depth"] = motion_of(-depth_offset * twist)
    motion["velocity"], motion["spin"] = readout * twist[:3], readout * twist[3:]
    motion["moves"] = 1
    return np.asarray(motion)


def _spread(count: int, most: int) -> Sequence[int]:
    """Where pairs begin: evenly over the frames, with room before and behind."""
    last = count - 2 - max(GAPS)
    if last < 1:
        return []
    return sorted({int(n) for n in np.linspace(1, last, min(most, last)).round()})
