"""Direct registration on a device: pyramids of frames, points of keyframes, and the launches that work on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from warpslam.kernels.direct import equations, images, points, registration
from warpslam.runtime.launching import Launcher, Step
from warpslam.tracking.direct.pyramid import PyramidPlan, records

FIRST_KEYFRAMES = 16
"""Rows of points to begin with; they double as keyframes come."""
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
        self._floors = floors.to_struct()
        shape = (rows, plan.pixels)
        self._images = images.Images()
        self._images.grey = wp.zeros(shape, dtype=float, device=device)
        self._images.shades = wp.zeros(shape, dtype=wp.vec3, device=device)
        self._images.depth = wp.zeros(shape, dtype=float, device=device)
        self._points = self._new_points(FIRST_KEYFRAMES)
        still = records(points.Motion, rows)
        still["to_depth"] = np.eye(4)
        self._motions = wp.array(still, dtype=points.Motion, device=device)
        self._buffers: dict[str, wp.array] = {}
        self._mean_depths: dict[int, float] = {}  # by row

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
        while keyframe >= self._points.grey.shape[0]:
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
            self._points,
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
            depth = self._images.depth[row].numpy()[first:]
            known = depth[depth > 0]
            self._mean_depths[row] = float(known.mean()) if len(known) else 1.0
        return self._mean_depths[row]

    # -- registration --------------------------------------------------------------------------------------------

    def register(self, tasks: np.ndarray) -> np.ndarray:
        """Run `registration.Task`s side by side; one `registration.Result` each."""
        return np.array(self.start(tasks).numpy()[: len(tasks)])

    def start(self, tasks: np.ndarray) -> wp.array:
        """`register` without waiting; what it returns holds until the next call."""
        count = len(tasks)
        results = self._array("results", registration.Result, count)
        before = [self._levels, self._iterations, self._floors, self._points, self._images, self._motions]
        before.append(self._upload("tasks", registration.Task, tasks))
        self._by_groups(registration.register, count, before, results)
        return results

    def join(
        self, start: wp.array, joint: np.ndarray, to_reference: np.ndarray, others: np.ndarray | None = None
    ) -> wp.array:
        """A `registration.Joint` from the pose of ``start`` on, without waiting; its `registration.Result` (1,).

        others: `registration.OtherRows` that join.
        """
        if others is None:
            others = records(registration.OtherRows)
        joints = self._upload("joints", registration.Joint, joint)
        matrices = self._upload("to_reference", wp.mat44, to_reference.astype(np.float32))
        result = self._array("joined", registration.Result, 1)
        inputs = [
            self._levels,
            self._floors,
            self._points,
            self._images,
            self._motions,
            joints,
            matrices,
            self._upload("others", registration.OtherRows, others),
            start,
            self.lanes,
            self._histograms(1),
            result,
        ]
        self._launcher.launch(registration.register_jointly, self.lanes, inputs)
        return result

    def overlaps(self, row: int, pose: wp.array, keyframes: Sequence[int], to_reference: np.ndarray) -> wp.array:
        """Share of each keyframe's points that a frame sees at the depth expected, without waiting; (keyframes,).

        pose: `registration.Result`, from the reference's axes to the frame's. to_reference: from the axes of each
        keyframe to those of the reference, (keyframes, 4, 4).
        """
        count = len(keyframes)
        numbers = self._upload("numbers", wp.int32, np.array(keyframes, np.int32))
        matrices = self._upload("matrices", wp.mat44, to_reference.astype(np.float32))
        shares = self._array("shares", wp.float32, count)
        level = max(self.plan.top - 1, 0)
        inputs = [
            self._levels,
            level,
            OVERLAP_STRIDE,
            self._points,
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

    def pairs(self, level: int, pairs: np.ndarray, grey: float, depth: float) -> np.ndarray:
        """Normal equations of `registration.Pair`s at a level, one `registration.PairSums` each."""
        count = len(pairs)
        sums = self._array("sums", registration.PairSums, count)
        before = [self._levels, level, grey, depth, self._floors, self._points, self._images, self._motions]
        before.append(self._upload("pairs", registration.Pair, pairs))
        self._by_groups(registration.sum_pairs, count, before, sums)
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
        old = self._points
        new = self._new_points(2 * old.grey.shape[0])
        for name in ("position", "normal", "grey"):
            wp.copy(getattr(new, name), getattr(old, name), count=getattr(old, name).size)
        self._points = new


def new_tasks(count: int) -> Any:
    """Tasks with a start at the identity, even exposure, and no cost asked for."""
    tasks = records(registration.Task, count)
    tasks["T"], tasks["exposure"], tasks["cost_level"] = np.eye(4), (1.0, 0.0), -1
    return tasks
