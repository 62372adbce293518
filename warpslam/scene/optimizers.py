"""Adam state for grid rows, the colour decoder and poses; `start` makes moments fresh in every call, as in the released
code.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from warpslam.field.arrays import GridGradient, entries, gradient_buffers
from warpslam.field.packing import PackedDecoder
from warpslam.kernels import adam
from warpslam.kernels.decoder.build import decoders_for
from warpslam.kernels.decoder.layout import COLOR_WEIGHT_ROWS
from warpslam.kernels.grid import Vec32
from warpslam.runtime.launching import Launcher
from warpslam.scene.feature_grid import FeatureGrid
from warpslam.scene.touched_rows import TouchedRowsState


class RowOptimizer:
    """Adam on some rows of an array of `Vec32`. Buffers persist between calls and grow with the array."""

    def __init__(self, launcher: Launcher) -> None:
        self.launcher, self.device = launcher, launcher.device
        self.size = 0
        self.step = wp.zeros(1, dtype=int, device=self.device)
        self._buffers: int | None = None
        self._rejected = wp.zeros(1, dtype=int, device=self.device)

    def start(self, size: int, rows: np.ndarray) -> None:
        """Begin a call: ``rows`` (int) of ``size`` change, with moments and step count at zero."""
        if size != self.size:
            self.size = size
            self.gradient = gradient_buffers(size, self.device, self._buffers)
            self.m = wp.zeros(size, dtype=Vec32, device=self.device)
            self.v = wp.zeros(size, dtype=Vec32, device=self.device)
        self.rows = wp.array(rows.astype(np.int32), dtype=int, device=self.device)
        self.step.zero_()
        self._rejected.zero_()
        if len(rows):
            self.launcher.launch(adam.clear_moments, len(rows), [self.rows, self.m, self.v])

    def update(self, x: wp.array, learning_rate: float) -> None:
        """One step on ``x`` from the gradient buffers, which are zero afterwards."""
        count = self.rows.shape[0]
        if count == 0:
            return
        self.launcher.launch(adam.advance_step, 1, [self.step])
        if decoders_for(self.device).by_sample:
            inputs = [self.rows, self.step, learning_rate]
            inputs += [entries(array) for array in (x, self.gradient, self.m, self.v)]
            self.launcher.launch(adam.adam_entries, (count, 32), [*inputs, self._rejected])
            return
        inputs = [self.rows, self.step, learning_rate, x, self.gradient, self.m, self.v, self._rejected]
        self.launcher.spread(adam.adam_rows, count, inputs)

    @property
    def has_rejected(self) -> bool:
        """Whether a gradient of this call was not finite; such rows were left as they were."""
        return bool(self._rejected.numpy()[0])


class GridOptimizer(RowOptimizer):
    """Adam on the selected vertices of one feature grid."""

    def begin(self, grid: FeatureGrid, selected: np.ndarray) -> None:
        """``selected``: bool (rows,), from frustum selection; False for rows that are shared."""
        self.start(grid.capacity, np.flatnonzero(selected))
        self.selected = wp.array(selected.astype(np.uint8), dtype=wp.uint8, device=self.device)
        place = np.where(selected, np.arange(grid.row_count), -1)
        self._place = wp.array(place.astype(np.int32), dtype=int, device=self.device)

    def wanted(self) -> GridGradient:
        """Where the kernels put this level's gradient, and for which rows."""
        return GridGradient(self.gradient, self._place)


class ColorDecoderOptimizer(RowOptimizer):
    """Adam on all weights of the colour decoder, B included; keeps the transposed rows in line.

    Args:
        launcher: Of the iterations that use it.
        layout: Of the map's grids: the decoder kernels of a run are those of its layout alone.
    """

    def __init__(self, launcher: Launcher, layout: str) -> None:
        super().__init__(launcher)
        self.layout = layout

    def begin(self) -> None:
        """Start a call: all rows change."""
        self._buffers = decoders_for(self.device).weight_slots
        self.start(COLOR_WEIGHT_ROWS, np.arange(COLOR_WEIGHT_ROWS))

    def state(self) -> TouchedRowsState:
        """What the next step depends on beside the weights."""
        count = int(self.step.numpy()[0])
        moments = np.stack([self.m.numpy(), self.v.numpy()], axis=1)
        return TouchedRowsState(np.arange(self.size, dtype=np.int32), np.full(self.size, count, np.int32), moments)

    def restore(self, state: TouchedRowsState) -> None:
        """Put back what `state` was."""
        self.m.assign(np.ascontiguousarray(state.moments[:, 0]))
        self.v.assign(np.ascontiguousarray(state.moments[:, 1]))
        self.step.assign(state.updates[:1])

    def update_decoder(self, packed: PackedDecoder, learning_rate: float) -> None:
        """One step on the packed weights."""
        self.update(packed.weights, learning_rate)
        weights, transposed, kernels = packed.weights, packed.transposed, decoders_for(self.device, self.layout)
        if kernels.by_sample:
            dim = (transposed.shape[0], 32)
            self.launcher.launch(kernels.transpose_color_entries, dim, [entries(weights), entries(transposed)])
        else:
            self.launcher.launch(kernels.transpose_color_weights, transposed.shape[0], [weights, transposed])


class PoseOptimizer:
    """Adam on pose vectors (qw, qx, qy, qz, tx, ty, tz); the quaternion is not renormalised meanwhile."""

    def __init__(self, capacity: int, launcher: Launcher) -> None:
        self.launcher, self.device = launcher, launcher.device
        self.step = wp.zeros(1, dtype=int, device=self.device)
        self._all = wp.zeros((capacity, 7), dtype=float, device=self.device, requires_grad=True)
        self._m = wp.zeros((capacity, 7), dtype=float, device=self.device)
        self._v = wp.zeros((capacity, 7), dtype=float, device=self.device)
        self.rates = wp.zeros(1, dtype=wp.vec2, device=self.device)
        self.count = 1
        self.poses = self._all[:1]

    def begin(self, vectors: np.ndarray, rates: np.ndarray | None = None) -> None:
        """Start from ``vectors``, float (frames, 7).

        rates: Learning rates of rotation and translation, one row a step, float (steps, 2); the last one holds on.
        """
        if len(vectors) != self.count:
            self.count = len(vectors)
            self.poses = self._all[: self.count]
        self.poses.assign(np.asarray(vectors, np.float32))
        if rates is not None:
            if len(rates) != self.rates.shape[0]:
                self.rates = wp.zeros(len(rates), dtype=wp.vec2, device=self.device)
            self.rates.assign(np.asarray(rates, np.float32))
        self._all.grad.zero_()
        self._m.zero_()
        self._v.zero_()
        self.step.zero_()

    def update(self, first: int = 0) -> None:
        """One step on the poses from row ``first`` on, from ``poses.grad``, which is zero afterwards."""
        self.launcher.launch(adam.advance_step, 1, [self.step])
        inputs = [self.step, self.rates, first, self._all, self._all.grad, self._m, self._v]
        self.launcher.launch(adam.adam_poses, (self.count, 7), inputs)

    def vectors(self) -> np.ndarray:
        """Poses as they are now, float64 (frames, 7)."""
        return self.poses.numpy().astype(np.float64)
