"""What the map gives to tracking: rows of a frame's points against its surface, where that is sharp."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warpslam.field.arrays import EXACT, FieldArrays, Gradients
from warpslam.field.passes import begin_rays, geometry_adjoint, logits, steep_list
from warpslam.field.ray_batch import RayBatch
from warpslam.kernels.direct import map_rows
from warpslam.runtime.launching import Step

if TYPE_CHECKING:
    from warpslam.tracking.direct.registrar import Registrar

LEAST_SLOPE = 4.0
"""Of the logit at the surface [1/m]: half of what the direct loss of mapping teaches it at least."""
POINTS = Gradients(points=True)


class MapRows:
    """Evaluates the map at the points that a registrar holds of a frame.

    Args:
        registrar: Holds the points.
        level: Level of the pyramid whose points are taken.
        weight: Of the rows, beside those of depth.
    """

    def __init__(self, registrar: Registrar, level: int, weight: float) -> None:
        self.registrar, self.weight, self.level = registrar, weight, level
        plan = registrar.plan.levels[level]
        self.first, self.count = int(plan["first_point"]), int(plan["points"])
        self._batch = RayBatch(self.count, 1, registrar.device)
        self._batch.count, self._batch.sample_count = self.count, 1

    def add(
        self, arrays: FieldArrays, pose: wp.array, T_world_reference: np.ndarray, points: int, rows: wp.array, at: int
    ) -> None:
        """Write the rows at a pose into ``rows[at]``, without waiting.

        Args:
            arrays: The map.
            pose: `registration.Result`, from the reference's axes to the frame's.
            T_world_reference: Pose of the reference, (4, 4).
            points: Row of the frame's points.
            rows: `registration.OtherRows`.
            at: Which of them.
        """
        batch, registrar, launcher = self._batch, self.registrar, self._batch.launcher
        T = wp.mat44(*T_world_reference.astype(np.float32).reshape(-1).tolist())
        known = registrar.points, points, self.first
        inputs = [*known, pose, T, arrays.low, arrays.high, arrays.lattices["color"], arrays.seen]
        inputs += [batch.origin, batch.keep, batch.logit_grad, batch.point_grad]
        launcher.launch(map_rows.place_points, self.count, inputs)

        def steps(first: int, stop: int, slot: int) -> list[Step]:
            result = [begin_rays(batch, first, stop, slot), *logits(batch, arrays, "fine", first, stop, 0, 1, EXACT)]
            result.append((map_rows.list_all, stop - first, [steep_list(batch, first, slot), stop - first]))
            for level in ("middle", "fine"):
                result += geometry_adjoint(batch, arrays, level, POINTS, first, stop, slot)
            return result

        launcher.slices(self.count, steps, whole=batch.kernels.by_sample)
        inputs = [*known, self.count, pose, T, batch.keep, batch.logit, batch.point_grad]
        inputs += [LEAST_SLOPE, registrar.floors.depth, self.weight]
        registrar.sum_map_rows(inputs, rows, at)
