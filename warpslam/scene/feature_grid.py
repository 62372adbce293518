"""One level of the map (Sec. 3.1): features at the vertices of a lattice that grows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from warpslam.field.arrays import struct
from warpslam.field.decoders import FEATURE_SIZE, LEVELS
from warpslam.kernels import grid as grid_kernels
from warpslam.kernels.grid import Lattice, Level, Start, Vec32
from warpslam.runtime.launching import Launcher


@dataclass(frozen=True)
class GridState:
    """A `FeatureGrid` as arrays."""

    first: np.ndarray
    """Lattice index of the first vertex, int64 (3,)."""
    shape: tuple[int, int, int]
    """Vertices per axis."""
    features: np.ndarray
    """float32 (rows, 32)."""
    seen: np.ndarray
    """uint8 (rows,)."""
    blocks: np.ndarray | None = None
    """Of a `BlockGrid`: which blocks were made, in their order, int64 (n, 3) in units of blocks of the world lattice,
    whose rows are above. None: dense.
    """


class FeatureGrid:
    """One level: features on the vertices ``spacing * (first + index)`` of the world lattice.

    first: World lattice index of vertex 0, int64 (3,).
    shape: Vertices per axis.
    std, mean: Of the features that new vertices begin with; the mean is float32 (32,), zero by default.
    features: Array of `Vec32`, one row a vertex (`warpslam.kernels.grid.row_of`), and room for more.
    seen: 1 where a mapped frame has measured what is at a vertex, uint8 (rows,): of the colour level, which tracking
        goes by (`RayBatch.drop_unseen`), and of the middle one, where `warpslam.mapping.depth_start` started it.
    """

    def __init__(
        self,
        level: str,
        spacing: float,
        std: float,
        seed: int,
        device: wp.Device,
        mean: np.ndarray | None = None,
    ) -> None:
        self.level, self.spacing, self.std, self.seed, self.device = level, spacing, std, seed, device
        self.mean = np.zeros(FEATURE_SIZE, np.float32) if mean is None else mean
        self._launcher = Launcher(device)
        self.first = np.zeros(3, np.int64)
        self.shape: tuple[int, int, int] = (0, 0, 0)
        self.features = wp.zeros(1, dtype=Vec32, device=device)
        self.seen = wp.zeros(1, dtype=wp.uint8, device=device)
        self.lattice = self._lattice()

    @property
    def row_count(self) -> int:
        """Rows in use."""
        return int(np.prod(self.shape))

    @property
    def own_rows(self) -> int:
        """Rows that belong to one vertex each: the last ones of those in use."""
        return self.row_count - self.lattice.shared

    @property
    def capacity(self) -> int:
        """Rows that there is room for."""
        return self.row_count

    @property
    def bytes(self) -> int:
        """Memory of the features and of what leads to them."""
        return 128 * self.row_count

    def rows_of(self, vertices: np.ndarray) -> np.ndarray:
        """Mask of the rows, bool (rows,), of some vertices of the box, bool (vertices,); a shared row is nobody's."""
        return vertices

    def cover(self, low: np.ndarray, high: np.ndarray) -> bool:
        """Grow to hold every vertex of the cells between ``low`` and ``high`` [m]; features stay. True if it grew."""
        first = np.floor(low / self.spacing + 1e-6).astype(np.int64)
        last = np.ceil(high / self.spacing - 1e-6).astype(np.int64)
        last = np.maximum(last, first + 1)
        if any(self.shape):
            first = np.minimum(first, self.first)
            last = np.maximum(last, self.first + self.shape - 1)
        nx, ny, nz = (int(n) for n in last - first + 1)
        shape = (nx, ny, nz)
        if shape == self.shape:
            return False
        self._resize(first, shape)
        return True

    def bytes_over(self, low: np.ndarray, high: np.ndarray, arrays: int) -> float:
        """Memory of the grid grown to a box [m], with ``arrays`` arrays of a row's size in all."""
        return float(np.prod((high - low) / self.spacing + 2)) * 128 * arrays

    def _resize(self, first: np.ndarray, shape: tuple[int, int, int]) -> None:
        old, old_seen = Level(), self.seen
        old.lattice, old.features = self.lattice, self.features
        shift = self.first - first
        self.first, self.shape = first, shape
        self.lattice = self._lattice()
        self.features = wp.empty(self.row_count, dtype=Vec32, device=self.device)
        self.seen = wp.empty(self.row_count, dtype=wp.uint8, device=self.device)
        inputs = [self.lattice, wp.vec3i(*first), self._start(), old, old_seen, wp.vec3i(*shift)]
        self._launcher.spread(grid_kernels.fill_grid, shape, [*inputs, self.features, self.seen])

    def renew(self, rows: np.ndarray) -> None:
        """Some rows, int (n,), become again what a new vertex is; `seen` says so, too."""
        fresh = FeatureGrid(self.level, self.spacing, self.std, self.seed, self.device, self.mean)
        fresh._resize(self.first, self.shape)
        fresh.seen = self.seen
        seen = self.seen.numpy().copy()
        seen[rows] = 0
        self.seen.assign(seen)
        self.update_from(fresh, wp.array(rows.astype(np.int32), dtype=int, device=self.device))

    def state(self) -> GridState:
        """The grid as arrays; on the CPU they are its own, not copies."""
        features, seen = (array.numpy()[: self.row_count] for array in (self.features, self.seen))
        return GridState(self.first, self.shape, features, seen)

    def restore(self, state: GridState) -> None:
        """Put back what `state` was."""
        nx, ny, nz = (int(n) for n in state.shape)
        self.first, self.shape = np.asarray(state.first, np.int64), (nx, ny, nz)
        self.lattice = self._lattice()
        self.features = wp.array(np.ascontiguousarray(state.features, np.float32), dtype=Vec32, device=self.device)
        self.seen = wp.array(np.ascontiguousarray(state.seen, np.uint8), dtype=wp.uint8, device=self.device)

    def update_from(self, other: FeatureGrid, rows: wp.array | None) -> None:
        """Take over the extent of another grid of this level, and some of its rows: int (n,), None for none."""
        if other.shape != self.shape or (other.first != self.first).any():
            self._resize(other.first, other.shape)
        if rows is not None:
            inputs = [rows, other.features, self.features]
            wp.launch(grid_kernels.copy_rows, rows.shape[0], inputs, device=self.device, record_tape=False)
            wp.copy(self.seen, other.seen)

    def _start(self) -> Start:
        """What new vertices begin with, as the kernels take it."""
        parts = {"seed": self.seed, "level": LEVELS.index(self.level), "std": self.std}
        return struct(Start, **parts, mean=Vec32(*self.mean))

    def _lattice(self) -> Lattice:
        lattice = Lattice()
        lattice.origin = wp.vec3(*(self.first * self.spacing))
        lattice.inverse_spacing = wp.vec3(1.0 / self.spacing, 1.0 / self.spacing, 1.0 / self.spacing)
        lattice.shape = wp.vec3i(*self.shape)
        return lattice
