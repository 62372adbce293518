"""The map (Sec. 3.1): four feature grids on world-aligned lattices that grow, and the decoders that read them."""

from __future__ import annotations

import logging

import numpy as np
import warp as wp

from warpslam.config import GridConfig
from warpslam.decoders import Decoders
from warpslam.errors import InputError, MapSizeError
from warpslam.field import FieldArrays, PackedDecoder, RayBatch
from warpslam.kernels import grid as grid_kernels
from warpslam.kernels.grid import Lattice, Vec32
from warpslam.launching import slice_count
from warpslam.memory import free_gigabytes
from warpslam.profiling import phase

LEVELS = ("coarse", "middle", "fine", "color")
QUERY_CHUNK = 1 << 16

_log = logging.getLogger(__name__)


class FeatureGrid:
    """One level: features on the vertices ``spacing * (first + index)`` of the world lattice.

    first: World lattice index of vertex 0, int64 (3,).
    shape: Vertices per axis.
    features: Array of `Vec32`, one row a vertex (`warpslam.kernels.grid.row_of`).
    seen: 1 where a mapped frame has measured what is at a vertex, uint8 (rows,): of the colour level, which tracking
        goes by (`RayBatch.drop_unseen`), and of the middle one, where `warpslam.depth_start` started it.
    """

    def __init__(self, level: str, spacing: float, std: float, seed: int, device: wp.Device) -> None:
        self.level, self.spacing, self.std, self.seed, self.device = level, spacing, std, seed, device
        self.first = np.zeros(3, np.int64)
        self.shape = (0, 0, 0)
        self.features = wp.zeros(1, dtype=Vec32, device=device)
        self.seen = wp.zeros(1, dtype=wp.uint8, device=device)
        self.lattice = self._lattice()

    @property
    def row_count(self) -> int:
        """Vertices of the grid."""
        return int(np.prod(self.shape))

    def cover(self, low: np.ndarray, high: np.ndarray) -> bool:
        """Grow to hold every vertex of the cells between ``low`` and ``high`` [m]; old features stay. True if it grew.
        """
        first = np.floor(low / self.spacing + 1e-6).astype(np.int64)
        last = np.ceil(high / self.spacing - 1e-6).astype(np.int64)
        last = np.maximum(last, first + 1)
        if self.row_count:
            first = np.minimum(first, self.first)
            last = np.maximum(last, self.first + self.shape - 1)
        shape = tuple(int(n) for n in last - first + 1)
        if shape == self.shape:
            return False
        self._resize(first, shape)
        return True

    def _resize(self, first: np.ndarray, shape: tuple[int, int, int]) -> None:
        old_lattice, old_features, old_seen = self.lattice, self.features, self.seen
        shift = self.first - first
        self.first, self.shape = first, shape
        self.lattice = self._lattice()
        self.features = wp.empty(self.row_count, dtype=Vec32, device=self.device)
        self.seen = wp.empty(self.row_count, dtype=wp.uint8, device=self.device)
        wp.launch(
            grid_kernels.fill_grid,
            dim=shape,
            inputs=[self.lattice, wp.vec3i(*first), self.seed, LEVELS.index(self.level), self.std]
            + [old_lattice, old_features, old_seen, wp.vec3i(*shift)],
            outputs=[self.features, self.seen],
            device=self.device,
            record_tape=False,
        )

    def restore(
        self, first: np.ndarray, shape: tuple[int, int, int], features: np.ndarray, seen: np.ndarray
    ) -> None:
        """Put back a saved grid: ``features`` float32 (rows, 32), ``seen`` uint8 (rows,)."""
        self.first, self.shape = np.asarray(first, np.int64), tuple(int(n) for n in shape)
        self.lattice = self._lattice()
        self.features = wp.array(np.ascontiguousarray(features, np.float32), dtype=Vec32, device=self.device)
        self.seen = wp.array(np.ascontiguousarray(seen, np.uint8), dtype=wp.uint8, device=self.device)

    def update_from(self, other: FeatureGrid, rows: wp.array | None) -> None:
        """Take over the extent of another grid of this level, and some of its rows: int (n,), None for none."""
        if other.shape != self.shape or (other.first != self.first).any():
            self._resize(other.first, other.shape)
        if rows is not None:
            inputs = [rows, other.features, self.features]
            wp.launch(grid_kernels.copy_rows, rows.shape[0], inputs, device=self.device, record_tape=False)
            wp.copy(self.seen, other.seen)

    def _lattice(self) -> Lattice:
        lattice = Lattice()
        lattice.origin = wp.vec3(*(self.first * self.spacing))
        lattice.inverse_spacing = wp.vec3(1.0 / self.spacing, 1.0 / self.spacing, 1.0 / self.spacing)
        lattice.shape = wp.vec3i(*self.shape)
        return lattice


class SceneMap:
    """Occupancy and colour of everything seen so far.

    bounds: ``low``, ``high``, float64 (3,) [m], multiples of the middle spacing. Nothing is known on or beyond them.
    """

    def __init__(self, decoders: Decoders, config: GridConfig, device: wp.Device, seed: int = 0) -> None:
        self.config, self.device, self.decoder_weights, self.seed = config, device, decoders, seed
        self.grids = {
            level: FeatureGrid(
                level, getattr(config, f"{level}_spacing"), getattr(config, f"{level}_std"), seed, device
            )
            for level in LEVELS
        }
        self.decoders = {weights.level: PackedDecoder(weights, device) for weights in decoders}
        self.low = np.zeros(3)
        self.high = np.zeros(3)
        self._buffers = 1
        self._queries: RayBatch | None = None

    def copy(self) -> SceneMap:
        """The same map in arrays of its own, which is meant to exist beside this one."""
        other = SceneMap(self.decoder_weights, self.config, self.device, self.seed)
        for level, grid in self.grids.items():
            other.grids[level].restore(grid.first, grid.shape, grid.features.numpy(), grid.seen.numpy())
        other.update_from(self, {})
        other._buffers = 1 + self._buffers
        return other

    def update_from(self, other: SceneMap, rows: dict[str, wp.array]) -> None:
        """Take over what changed in ``other``, a map of the same seed: its bounds, the colour decoder, and ``rows`` of
        each level (int, indices into the other's grid). New vertices start alike in both maps.
        """
        self.low, self.high = other.low, other.high
        for level, grid in self.grids.items():
            grid.update_from(other.grids[level], rows.get(level))
        mine, theirs = self.decoders["color"], other.decoders["color"]
        wp.copy(mine.weights, theirs.weights)
        wp.copy(mine.transposed, theirs.transposed)

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner, float64 (3,) each [m]."""
        return self.low, self.high

    def restore_bounds(self, low: np.ndarray, high: np.ndarray) -> None:
        """Put back saved bounds [m]; the grids are restored one by one."""
        self.low, self.high = np.asarray(low, np.float64), np.asarray(high, np.float64)

    @property
    def is_empty(self) -> bool:
        """Whether no frame has been mapped yet."""
        return not self.grids["middle"].row_count

    @phase("growth")
    def cover(self, low: np.ndarray, high: np.ndarray) -> bool:
        """Grow the map to hold the box ``low``..``high`` [m] plus the margin; True if it grew.

        Raises:
            MapSizeError: the grown map would not fit `GridConfig.max_gigabytes`, or what is free.
        """
        spacing, margin = self.config.middle_spacing, self.config.margin
        if not self.is_empty and (low > self.low).all() and (high < self.high).all():
            return False
        low = np.floor((low - margin) / spacing) * spacing
        high = np.ceil((high + margin) / spacing) * spacing
        if not self.is_empty:
            low, high = np.minimum(low, self.low), np.maximum(high, self.high)
        needed = self.gigabytes(low, high)
        if needed > self.config.max_gigabytes:
            raise MapSizeError(
                f"the map would grow to {np.round(high - low, 1).tolist()} m and {needed:.1f} GB, beyond "
                f"grid.max_gigabytes = {self.config.max_gigabytes}: raise it, lower grid.max_depth "
                f"(now {self.config.max_depth} m), or check the depth scale"
            )
        more = needed - (0.0 if self.is_empty else self.gigabytes(self.low, self.high))
        free = free_gigabytes(self.device)
        if free is not None and more > free:
            raise MapSizeError(
                f"the map would grow to {np.round(high - low, 1).tolist()} m, which needs {more:.1f} GB more, and "
                f"{self.device} has {free:.1f} GB free: lower grid.max_depth (now {self.config.max_depth} m), or check "
                "the depth scale"
            )
        self.low, self.high = low, high
        for level, grid in self.grids.items():
            # One more coarse cell around, so that the forecast reaches beyond what was seen.
            extra = grid.spacing if level == "coarse" else 0.0
            grid.cover(low - extra, high + extra)
        _log.info("map covers %s to %s m", np.round(low, 2).tolist(), np.round(high, 2).tolist())
        return True

    def gigabytes(self, low: np.ndarray, high: np.ndarray) -> float:
        """Memory of the grids over a box, with both Adam moments and the gradient buffers [GB]."""
        arrays = 2 + self._buffers + slice_count(self.device)
        rows = sum(float(np.prod((high - low) / grid.spacing + 2)) for grid in self.grids.values())
        return rows * 32 * 4 * arrays / 1e9

    def arrays(self) -> FieldArrays:
        """What the kernels read, as it is now."""
        return FieldArrays(
            lattices={level: grid.lattice for level, grid in self.grids.items()},
            features={level: grid.features for level, grid in self.grids.items()},
            decoders=self.decoders,
            low=wp.vec3(*self.low),
            high=wp.vec3(*self.high),
            seen=self.grids["color"].seen,
        )

    def query_occupancy(self, points: np.ndarray, level: str = "fine") -> np.ndarray:
        """Occupancy logits, float32 (N,), at world points (N, 3) [m]; > 0 is occupied, alpha = sigmoid(10 logit) (Eq.
        1-4).

        level: "coarse", "middle", or "fine" (middle plus the fine residual).
        """
        if level not in ("coarse", "middle", "fine"):
            raise InputError(f"level = {level!r}: expected coarse, middle or fine")
        return self._query(points, level)

    def query_color(self, points: np.ndarray) -> np.ndarray:
        """Colours in [0, 1], float32 (N, 3), at world points (N, 3) [m]."""
        return self._query(points, "color")

    def _query(self, points: np.ndarray, stage: str) -> np.ndarray:
        points = np.asarray(points, np.float32)
        if points.ndim != 2 or points.shape[1] != 3:
            raise InputError(f"points have shape {points.shape}, expected (N, 3)")
        if self.is_empty:
            raise InputError("the map is empty: step at least one frame first")
        if self._queries is None:
            self._queries = RayBatch(QUERY_CHUNK, 1, self.device)
        batch, arrays = self._queries, self.arrays()
        parts = []
        for start in range(0, len(points), QUERY_CHUNK):
            chunk = points[start : start + QUERY_CHUNK]
            batch.set_points(chunk)
            batch.query(arrays, stage)
            values = batch.color if stage == "color" else batch.logit
            parts.append(values.numpy()[: len(chunk)].copy())
        if not parts:
            return np.zeros((0, 3) if stage == "color" else 0, np.float32)
        result = np.concatenate(parts)
        return np.clip(result, 0.0, 1.0) if stage == "color" else result
