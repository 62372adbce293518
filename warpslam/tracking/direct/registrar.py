"""Direct registration on a device: pyramids of frames, points of keyframes, and the launches that work on them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from warpslam.kernels.direct import equations, images, map_rows, points, registration, timing
from warpslam.runtime.launching import Launcher, Step
from warpslam.tracking.direct.pyramid import PyramidPlan, records

FIRST_KEYFRAMES = 16
"""Rows of points to begin with; they double as keyframes come."""
MOST_NEAR = 24
"""Keyframes whose overlap with a frame is asked for at once."""
MOST_OTHERS = 2
"""Rows from elsewhere that join: the map's and those of features."""
ALIGNED = 64
"""Bytes that a part of a buffer begins at a multiple of."""
OVERLAP_STRIDE = 2
"""Every second point tells enough of an overlap."""


@dataclass(frozen=True)
class Floors:
    """Least scales of the residuals: no image fits better than its noise."""

    grey: float
    """Grey values of 255."""
    depth: float
    """Standard deviations of depth."""

    def to_struct(self) -> registration.Floors:
        """As kernels take it."""
        struct = registration.Floors()
        struct.grey, struct.depth = self.grey, self.depth
        return struct


@dataclass(frozen=True)
class FollowedRecords:
    """What `Registrar.follow` finds."""

    result: np.ndarray
    """`registration.Result` of the reference alone."""
    joined: np.ndarray
    """That of all keyframes."""
    shares: np.ndarray
    """Of the keyframes near by, float32 (near,)."""
    back: np.ndarray
    """`registration.PairSums` of the reference in the frame's points."""


class Registrar:
    """Images and points on a device, by row, and registrations among them.

    Args:
        plan: Levels of the pyramids.
        rows: Frames whose images are there at a time.
        max_depth: Points further away are none [m].
        floors: Least scales.
        device: Where all of it is.
    """

    def __init__(self, plan: PyramidPlan, rows: int, max_depth: float, floors: Floors, device: wp.Device) -> None:
        self.plan, self.rows, self.max_depth, self.device = plan, rows, max_depth, device
        self.lanes = equations.WARP if device.is_cuda else 1
        self._launcher = Launcher(device)
        self._levels = plan.to_device(device)
        self._iterations = wp.array(plan.iterations, dtype=int, device=device)
        self.floors, self._floors = floors, floors.to_struct()
        shape = (rows, plan.pixels)
        self._images = images.Images()
        self._images.grey = wp.zeros(shape, dtype=float, device=device)
        self._images.shades = wp.zeros(shape, dtype=wp.vec3, device=device)
        self._images.depth = wp.zeros(shape, dtype=float, device=device)
        self.points = self._new_points(FIRST_KEYFRAMES)
        """Of keyframes, as kernels take them, until more rows are wanted."""
        still = records(points.Motion, rows)
        still["to_depth"] = np.eye(4)
        self._motions = wp.array(still, dtype=points.Motion, device=device)
        self._buffers: dict[str, wp.array] = {}
        self._mean_depths: dict[int, float] = {}  # by row
        last = plan.levels[-1]
        self._others = wp.zeros(MOST_OTHERS, dtype=registration.OtherRows, device=device)
        self._report = _Report(int(last["width"] * last["height"]), device)

    # -- images and points ---------------------------------------------------------------------------------------

    def load(self, row: int, rgb: wp.array, units: wp.array, scale: wp.array) -> None:
        """Build the pyramid of an image: uint8 (H, W, 3), uint16 (H, W), and metres per unit (1,)."""
        levels, last = self.plan.levels, self.plan.levels[-1]
        self._mean_depths.pop(row, None)

        def base(first: int, stop: int, slot: int) -> list[Step]:
            inputs = [rgb, units, scale, self.plan.edge, self._levels, row, first, self._images]
            return [(images.largest_level, stop - first, inputs)]

        self._launcher.slices(int(levels[0]["width"] * levels[0]["height"]), base)
        for n, level in enumerate(levels[1:], start=1):
            self._launcher.launch(
                images.halve, int(level["width"] * level["height"]), [n, self._levels, row, self._images]
            )

        def shades(first: int, stop: int, slot: int) -> list[Step]:
            return [(images.differentiate, stop - first, [self._levels, row, first, self._images])]

        self._launcher.slices(int(last["first"] + last["width"] * last["height"]), shades)
        self.set_motion(row, None)

    def set_motion(self, row: int, motion: np.ndarray | None) -> None:
        """How the camera moved while it took the image: a `points.Motion`; None = it stood still."""
        if motion is None:
            motion = records(points.Motion)
            motion["to_depth"] = np.eye(4)
        self._motions[row : row + 1].assign(motion.reshape(1))

    def select(self, row: int, keyframe: int, first_level: int = 0) -> None:
        """Choose the points of an image, from level ``first_level`` up, and keep them as those of ``keyframe``."""
        while keyframe >= self.points.grey.shape[0]:
            self._grow()
        levels = self.plan.levels
        count = self.plan.points - int(levels[first_level]["first_point"])
        inputs = [
            self._levels,
            first_level,
            self._images,
            row,
            self._motions,
            self.max_depth,
            self.points,
            keyframe,
        ]
        self._launcher.launch(points.select_points, count, inputs)

    def smallest(self, row: int) -> np.ndarray:
        """Grey values of the smallest level, float32 (pixels,)."""
        first = int(self.plan.levels[-1]["first"])
        return np.array(self._images.grey[row].numpy()[first:])

    def mean_depth(self, row: int) -> float:
        """Of the smallest level [m]; 1 where nothing has depth."""
        if row not in self._mean_depths:
            first = int(self.plan.levels[-1]["first"])
            self._note_mean_depth(row, self._images.depth[row].numpy()[first:])
        return self._mean_depths[row]

    def _note_mean_depth(self, row: int, smallest: np.ndarray) -> None:
        known = smallest[smallest > 0]
        self._mean_depths[row] = float(known.mean()) if len(known) else 1.0

    # -- registration --------------------------------------------------------------------------------------------

    def register(self, tasks: np.ndarray) -> np.ndarray:
        """Run `registration.Task`s side by side; one `registration.Result` each."""
        return np.array(self.start(tasks).numpy()[: len(tasks)])

    def start(self, tasks: np.ndarray, results: wp.array | None = None) -> wp.array:
        """`register` without waiting; what it returns holds until the next call."""
        count = len(tasks)
        if results is None:
            results = self._array("results", registration.Result, count)
        before = [self._levels, self._iterations, self._floors, self.points, self._images, self._motions]
        before.append(self._upload("tasks", registration.Task, tasks))
        self._by_groups(registration.register, count, before, results)
        return results

    def join(
        self,
        start: wp.array,
        joint: np.ndarray,
        to_reference: np.ndarray,
        result: wp.array | None = None,
    ) -> wp.array:
        """A `registration.Joint` from the pose of ``start`` on, without waiting; its `registration.Result` (1,).
        Rows that join are those of `put_rows`.
        """
        joints = self._upload("joints", registration.Joint, joint)
        matrices = self._upload("to_reference", wp.mat44, to_reference.astype(np.float32))
        if result is None:
            result = self._array("joined", registration.Result, 1)
        inputs = [
            self._levels,
            self._floors,
            self.points,
            self._images,
            self._motions,
            joints,
            matrices,
            self._others,
            start,
            self.lanes,
            self._histograms(1),
            result,
        ]
        self._launcher.launch(registration.register_jointly, self.lanes, inputs)
        return result

    def follow(
        self,
        task: np.ndarray,
        joint: np.ndarray,
        joint_to_reference: np.ndarray,
        near: Sequence[int],
        near_to_reference: np.ndarray,
        back: np.ndarray,
        more: Callable[[wp.array, wp.array], None] | None = None,
    ) -> FollowedRecords:
        """Register to the reference, from there to several keyframes at once, see which others overlap, and look back;
        all of it is read at once.

        Args:
            task: A `registration.Task`.
            joint: A `registration.Joint`.
            joint_to_reference: From the axes of its keyframes to those of the reference, (count, 4, 4).
            near: Keyframes whose overlap is asked for.
            near_to_reference: The same for these, (near, 4, 4).
            back: A `registration.Pair`, from the frame's points, which are chosen here, to the reference; its pose is
                filled in: the inverse of the joint one.
            more: Writes `registration.OtherRows` that join, for the pose of the `registration.Result` that is its first
                argument, into the first place of the second; the frame's points are chosen for it.
        """
        row = int(joint["row"][0])
        report = self._report
        scratch = int(back["keyframe"][0])
        started = self.start(task, report.started)
        joint["others"] = 0
        if more is not None:
            self.select(row, scratch)
            more(started, self._others)
            joint["others"] = 1
        joined = self.join(started, joint, joint_to_reference, report.joined)
        self.overlaps(row, joined, near, near_to_reference, report.shares)
        pairs = self._upload("back", registration.Pair, back)
        self._launcher.launch(registration.look_back, 1, [joined, pairs])
        level = self.plan.middle
        self.select(row, scratch, level)
        self._sum_pairs(level, 1, pairs, float(task["grey"][0]), float(task["depth"][0]), report.back)
        first = int(self.plan.levels[-1]["first"])
        wp.copy(report.depth, self._images.depth[row], src_offset=first, count=report.depth.size)
        found = report.read()
        self._note_mean_depth(row, found["depth"])
        return FollowedRecords(found["started"][0], found["joined"][0], found["shares"][: len(near)], found["back"][0])

    def overlaps(
        self,
        row: int,
        pose: wp.array,
        keyframes: Sequence[int],
        to_reference: np.ndarray,
        shares: wp.array | None = None,
    ) -> wp.array:
        """Share of each keyframe's points that a frame sees at the depth expected, without waiting; (keyframes,).

        pose: `registration.Result`, from the reference's axes to the frame's. to_reference: from the axes of each
        keyframe to those of the reference, (keyframes, 4, 4).
        """
        count = len(keyframes)
        numbers = self._upload("numbers", wp.int32, np.array(keyframes, np.int32))
        matrices = self._upload("matrices", wp.mat44, to_reference.astype(np.float32))
        if shares is None:
            shares = self._array("shares", wp.float32, count)
        level = max(self.plan.top - 1, 0)
        inputs = [
            self._levels,
            level,
            OVERLAP_STRIDE,
            self.points,
            self._images,
            row,
            self._motions,
            pose,
            numbers,
            matrices,
            shares,
        ]
        self._launcher.launch(registration.overlaps, count, inputs)
        return shares

    def overlap(self, row: int, keyframes: Sequence[int], T_frame_keyframe: np.ndarray) -> np.ndarray:
        """The same for transforms that are known: (keyframes, 4, 4), from each keyframe's axes to the frame's."""
        if not len(keyframes):
            return np.zeros(0)
        identity = records(registration.Result)
        identity["T"] = np.eye(4)
        still = self._upload("identity", registration.Result, identity)
        return np.array(self.overlaps(row, still, keyframes, T_frame_keyframe).numpy()[: len(keyframes)])

    def put_rows(self, rows: np.ndarray, first: int) -> None:
        """Where `registration.OtherRows` lie that join a joint registration: ``Joint.others`` says how many."""
        self._others[first : first + len(rows)].assign(rows)

    def join_again(self, joint: np.ndarray, to_reference: np.ndarray) -> np.ndarray:
        """The joint registration of the last `follow` with other rows: its `registration.Result`."""
        result = self.join(self._report.started, joint, to_reference, self._report.joined)
        return np.array(result.numpy()[0])

    def sum_map_rows(self, inputs: list[Any], rows: wp.array, at: int) -> None:
        """Launch `map_rows.sum_map_rows`, without waiting."""
        self._launcher.launch(map_rows.sum_map_rows, self.lanes, [*inputs, self.lanes, self._histograms(1), rows, at])

    def pairs(self, level: int, pairs: np.ndarray, grey: float, depth: float) -> np.ndarray:
        """Normal equations of `registration.Pair`s at a level, one `registration.PairSums` each."""
        count = len(pairs)
        sums = self._array("sums", registration.PairSums, count)
        self._sum_pairs(level, count, self._upload("pairs", registration.Pair, pairs), grey, depth, sums)
        return np.array(sums.numpy()[:count])

    def _sum_pairs(self, level: int, count: int, pairs: wp.array, grey: float, depth: float, sums: wp.array) -> None:
        before = [self._levels, level, grey, depth, self._floors, self.points, self._images, self._motions, pairs]
        self._by_groups(registration.sum_pairs, count, before, sums)

    def timing(self, level: int, pairs: np.ndarray, grey: float, depth: float) -> np.ndarray:
        """What `timing.TimedPair`s say of the camera's timing at a level, one `timing.TimedSums` each."""
        count = len(pairs)
        sums = self._array("timed_sums", timing.TimedSums, count)
        before = [self._levels, level, grey, depth, self._floors, self.points, self._images, self._motions]
        before.append(self._upload("timed_pairs", timing.TimedPair, pairs))
        self._by_groups(timing.sum_timing, count, before, sums)
        return np.array(sums.numpy()[:count])

    def rotations(self, smallest: np.ndarray, row: int, candidates: np.ndarray) -> np.ndarray:
        """1 - correlation of the smallest images under each rotation (n, 3, 3), of each of ``smallest`` (k, pixels)
        with the frame in ``row``; (k, n).
        """
        known = self._buffers.get("rotations")
        if known is None:
            known = self._buffers["rotations"] = wp.array(candidates, dtype=wp.mat33, device=self.device)
        keys = self._upload("smallest", wp.float32, smallest)
        scores = self._array("scores", wp.float32, len(smallest), len(candidates))
        inputs = [self._levels, keys, self._images, row, known, scores]
        self._launcher.launch(registration.search_rotations, (len(smallest), len(candidates)), inputs)
        return np.array(scores.numpy()[: len(smallest)])

    # -- memory --------------------------------------------------------------------------------------------------

    def _array(self, name: str, dtype: type, count: int, *more: int) -> wp.array:
        """A buffer of at least ``count`` rows."""
        found = self._buffers.get(name)
        if found is None or found.shape[0] < count or found.shape[1:] != more:
            size = max(count, 2 * found.shape[0] if found is not None else 0)
            found = self._buffers[name] = wp.zeros((size, *more), dtype=dtype, device=self.device)
        return found

    def _upload(self, name: str, dtype: type, values: np.ndarray) -> wp.array:
        """A buffer that begins with ``values``; those of a struct or a matrix are one to an entry."""
        array = self._array(name, dtype, len(values), *(values.shape[1:] if dtype is wp.float32 else ()))
        array[: len(values)].assign(values)
        return array

    def _by_groups(self, kernel: wp.Kernel, count: int, before: list[Any], results: wp.array) -> None:
        """Launch a kernel whose every result takes a group of threads."""
        histograms = self._histograms(count)

        def steps(first: int, stop: int, slot: int) -> list[Step]:
            return [(kernel, (stop - first) * self.lanes, [*before, first, self.lanes, histograms, results])]

        self._launcher.slices(count, steps, whole=count == 1)

    def _histograms(self, count: int) -> wp.array:
        return self._array("histograms", wp.int32, count, 2 * equations.BINS)

    def _new_points(self, rows: int) -> points.Points:
        new = points.Points()
        shape = (rows, self.plan.points)
        new.position = wp.zeros(shape, dtype=wp.vec3, device=self.device)
        new.normal = wp.zeros(shape, dtype=wp.vec3, device=self.device)
        new.grey = wp.zeros(shape, dtype=float, device=self.device)
        return new

    def _grow(self) -> None:
        old = self.points
        new = self._new_points(2 * old.grey.shape[0])
        for name in ("position", "normal", "grey"):
            wp.copy(getattr(new, name), getattr(old, name), count=getattr(old, name).size)
        self.points = new


class _Report:
    """Arrays of `Registrar.follow` that lie in one buffer, so that one read brings them all."""

    def __init__(self, pixels: int, device: wp.Device) -> None:
        parts = {
            "started": (registration.Result, 1),
            "joined": (registration.Result, 1),
            "back": (registration.PairSums, 1),
            "shares": (wp.float32, MOST_NEAR),
            "depth": (wp.float32, pixels),
        }
        sizes = [count * wp.types.type_size_in_bytes(dtype) for dtype, count in parts.values()]
        starts = np.cumsum([0, *(-(-size // ALIGNED) * ALIGNED for size in sizes)]).tolist()
        self._buffer = wp.zeros(starts[-1], dtype=wp.uint8, device=device)
        self._parts = {}
        for (name, (dtype, count)), at, size in zip(parts.items(), starts[:-1], sizes, strict=True):
            array = wp.array(ptr=self._buffer.ptr + at, dtype=dtype, shape=count, capacity=size, device=device)
            self._parts[name] = slice(at, at + size), array
        self.started, self.joined, self.back, self.shares, self.depth = (array for _, array in self._parts.values())

    def read(self) -> dict[str, np.ndarray]:
        """All of them, by name."""
        found = self._buffer.numpy().copy()
        types = {name: array.dtype for name, (_, array) in self._parts.items()}
        dtypes = {name: np.float32 if dtype is wp.float32 else dtype.numpy_dtype() for name, dtype in types.items()}
        return {name: found[part].view(dtypes[name]) for name, (part, _) in self._parts.items()}


def new_tasks(count: int) -> Any:
    """Tasks with a start at the identity, even exposure, and no cost asked for."""
    tasks = records(registration.Task, count)
    tasks["T"], tasks["exposure"], tasks["cost_level"] = np.eye(4), (1.0, 0.0), -1
    return tasks
