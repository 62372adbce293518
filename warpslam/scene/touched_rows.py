"""Adam on the rows of a grid that an iteration touches, with moments and a step count of each row that are kept for
good; see `warpslam.kernels.touched_rows`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from warpslam.field.arrays import GridGradient, entries, lazy_zeros, struct
from warpslam.kernels import touched_rows
from warpslam.kernels.decoder.build import decoders_for
from warpslam.kernels.touched_rows import HELD, RowState, Touched
from warpslam.runtime.cores import slice_count
from warpslam.runtime.launching import Launcher, Step
from warpslam.scene.feature_grid import FeatureGrid


@dataclass(frozen=True)
class TouchedRowsState:
    """A `TouchedRows` as arrays, of the rows that were ever updated."""

    rows: np.ndarray
    """Their numbers, int32 (n,), ascending."""
    updates: np.ndarray
    """How often each was, int32 (n,)."""
    moments: np.ndarray
    """First and second, float32 (n, 2, 32)."""


class TouchedRows:
    """Optimiser of one feature grid, with which it grows.

    moments: (rows, 2) of `Vec32`. updates: How often a row was updated, int (rows,).

    Args:
        launcher: Of the iterations that use it.
        grid: The grid.
        capacity: Most rows that an iteration touches.
    """

    def __init__(self, launcher: Launcher, grid: FeatureGrid, capacity: int) -> None:
        self.launcher, self.device, self.capacity = launcher, launcher.device, capacity
        self._first, self._shape, self._lattice = grid.first.copy(), grid.shape, grid.lattice
        self._rejected = wp.zeros(1, dtype=int, device=self.device)
        self._held: np.ndarray | None = None
        self._allocate(grid)

    def fit(self, grid: FeatureGrid) -> None:
        """Grow to the size of the grid."""
        old_moments, old_updates, old_shape, old_lattice = self.moments, self.updates, self._shape, self._lattice
        if grid.lattice.shared:
            # Rows of blocks stay where they are.
            if grid.capacity != old_updates.shape[0]:
                self._allocate(grid)
                wp.copy(self.moments, old_moments, count=min(old_moments.size, self.moments.size))
                wp.copy(self.updates, old_updates, count=min(old_updates.size, self.updates.size))
            return
        if grid.shape == self._shape and (grid.first == self._first).all():
            return
        shift = wp.vec3i(*(int(n) for n in self._first - grid.first))
        self._first, self._shape, self._lattice = grid.first.copy(), grid.shape, grid.lattice
        self._allocate(grid)
        if np.prod(old_shape):
            inputs = [old_lattice, shift, grid.lattice, old_moments, old_updates, self.moments, self.updates]
            self.launcher.spread(touched_rows.move_rows, old_shape, inputs)

    def _allocate(self, grid: FeatureGrid) -> None:
        rows, device = grid.capacity, self.device
        self.moments = lazy_zeros((rows, 2), device)
        self.updates = wp.zeros(rows, dtype=int, device=device)
        self._changed = wp.zeros(rows, dtype=wp.uint8, device=device)
        size = max(min(self.capacity, rows), 1)
        self.touched = struct(
            Touched,
            count=wp.zeros(1, dtype=int, device=device),
            rows=wp.zeros(size, dtype=int, device=device),
            place=wp.full(rows, -1, dtype=int, device=device),
        )
        self._gradient = lazy_zeros((slice_count(device), size), device)

    def begin(self) -> None:
        """Start a call: no row has changed."""
        if self._held is None:
            self._changed.zero_()
        else:
            # Rows that are newer are held, too.
            held = np.full(self._changed.shape[0], HELD.value, np.uint8)
            held[: len(self._held)] = self._held
            self._changed.assign(held)
        self._rejected.zero_()

    def hold(self, held: np.ndarray | None) -> None:
        """From the next call on, rows that are true stay what they are, bool (rows,); None for no more of that."""
        self._held = None if held is None else np.where(held, np.uint8(HELD.value), np.uint8(0))

    def forget(self, rows: np.ndarray) -> None:
        """Some rows, int (n,), as if they had never been updated: their features begin anew."""
        updates, moments = self.updates.numpy(), self.moments.numpy()
        updates[rows], moments[rows] = 0, 0.0
        if not self.device.is_cpu:  # there they are copies
            self.updates.assign(updates)
            self.moments.assign(moments)

    def wanted(self) -> GridGradient:
        """Where the kernels list the rows that this level's gradient touches, and put it."""
        return GridGradient(self._gradient, self.touched.place, self.touched)

    def update(self, x: wp.array, learning_rate: float) -> None:
        """One step on the rows of ``x`` that are listed; the gradients are zero afterwards."""
        state = struct(RowState, moments=self.moments, updates=self.updates, changed=self._changed)
        if decoders_for(self.device).by_sample:
            inputs = [learning_rate, self.touched, entries(self._gradient), entries(self.moments), state, entries(x)]
            self.launcher.launch(
                touched_rows.adam_touched_entries, (self._gradient.shape[1], 32), [*inputs, self._rejected]
            )
            return
        parts = slice_count(self.device)
        inputs = [parts, learning_rate, self.touched, self._gradient, state, x, self._rejected]

        def steps(part: int, stop: int, slot: int) -> list[Step]:
            return [(touched_rows.adam_touched, 1, [part, *inputs])]

        self.launcher.slices(parts, steps)

    @property
    def has_rejected(self) -> bool:
        """Whether a gradient of this call was not finite; such rows were left as they were."""
        return bool(self._rejected.numpy()[0])

    def changed_rows(self) -> wp.array:
        """Rows that have changed since `begin`, int (n,)."""
        return wp.array(np.flatnonzero(self._changed.numpy() == 1).astype(np.int32), dtype=int, device=self.device)

    def state(self) -> TouchedRowsState:
        """What the next call depends on."""
        updates = self.updates.numpy()
        rows = np.flatnonzero(updates).astype(np.int32)
        return TouchedRowsState(rows, updates[rows], self.moments.numpy()[rows])

    def restore(self, state: TouchedRowsState) -> None:
        """Put back what `state` was, into an optimiser of the same grid."""
        updates, moments = np.zeros(self.updates.shape[0], np.int32), np.zeros((*self.moments.shape, 32), np.float32)
        updates[state.rows], moments[state.rows] = state.updates, state.moments
        self.updates.assign(updates)
        self.moments.assign(moments)
