"""The map (Sec. 3.1): four feature grids on world-aligned lattices that grow, and the decoders that read them."""

from __future__ import annotations

import logging
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import warp as wp

from warpslam.camera import Intrinsics
from warpslam.config import GridConfig
from warpslam.errors import InputError, MapSizeError
from warpslam.field.arrays import FieldArrays
from warpslam.field.decoders import LEVELS, Decoders
from warpslam.field.feature_fit import free_feature
from warpslam.field.packing import PackedDecoder
from warpslam.field.passes import query
from warpslam.field.ray_batch import RayBatch
from warpslam.kernels.blocks import Reach
from warpslam.kernels.grid import BLOCK_ROWS
from warpslam.poses import MAX_DISTANCE, as_numbers
from warpslam.runtime.cores import slice_count
from warpslam.runtime.environment import free_gigabytes
from warpslam.runtime.exclusive import ObjectLock, exclusive
from warpslam.runtime.phases import phase
from warpslam.scene.block_grid import BlockGrid
from warpslam.scene.feature_grid import FeatureGrid, GridState
from warpslam.scene.keyframes import PlacedImage

QUERY_CHUNK = 1 << 16
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class SceneState:
    """A `SceneMap` as arrays."""

    decoders: Decoders
    """Weights, those of the colour decoder as they are by now."""
    low: np.ndarray
    """Lower corner of the bounds [m], float64 (3,)."""
    high: np.ndarray
    """Upper corner of the bounds [m], float64 (3,)."""
    grids: dict[str, GridState]
    """By level."""


class SceneMap:
    """Occupancy and colour of everything seen so far.

    bounds: ``low``, ``high``, float64 (3,) [m], multiples of the middle spacing. Nothing is known on or beyond them.
    """

    def __init__(self, decoders: Decoders, config: GridConfig, device: wp.Device, seed: int = 0) -> None:
        self.config, self.device, self.decoder_weights, self.seed = config, device, decoders, seed
        self.grids = {level: new_grid(level, config, seed, device, decoders) for level in LEVELS}
        self.decoders = {weights.level: PackedDecoder(weights, device) for weights in decoders}
        self.low = np.zeros(3)
        self.high = np.zeros(3)
        self._buffers = 1
        # A second look would find nothing more, unless the box has grown.
        self._with_rows: dict[Hashable, tuple] = {}
        self._queries: RayBatch | None = None
        self.lock = ObjectLock(outlives_fork=not device.is_cuda)

    def copy(self) -> SceneMap:
        """The same map in arrays of its own, which is meant to exist beside this one."""
        other = SceneMap(self.decoder_weights, self.config, self.device, self.seed)
        for level, grid in self.grids.items():
            other.grids[level].restore(grid.state())
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

    def state(self) -> SceneState:
        """The map as arrays; on the CPU those of the grids are its own, not copies."""
        decoders = replace(self.decoder_weights, color=self.decoders["color"].unpack())
        return SceneState(decoders, self.low, self.high, {level: grid.state() for level, grid in self.grids.items()})

    def restore(self, state: SceneState) -> None:
        """Put back what `state` was; the decoders are those that the map was made with."""
        self.low, self.high = state.low.copy(), state.high.copy()
        self._with_rows.clear()
        for level, grid in self.grids.items():
            grid.restore(state.grids[level])

    @property
    def is_empty(self) -> bool:
        """Whether no frame has been mapped yet."""
        return not any(self.grids["middle"].shape)

    @phase("growth")
    def cover(self, low: np.ndarray, high: np.ndarray) -> bool:
        """Grow the map to hold the box ``low``..``high`` [m] plus the margin; True if it grew.

        Raises:
            MapSizeError: The grown map would not fit `GridConfig.max_gigabytes`, or what is free.
        """
        if not self.is_empty and (low > self.low).all() and (high < self.high).all():
            return False
        low, high = self._grown(low, high)
        self.low, self.high = low, high
        self._with_rows.clear()
        for level, grid in self.grids.items():
            # One more coarse cell around, so that the forecast reaches beyond what was seen.
            extra = grid.spacing if level == "coarse" else 0.0
            grid.cover(low - extra, high + extra)
        _log.info("map covers %s to %s m", np.round(low, 2).tolist(), np.round(high, 2).tolist())
        return True

    def check_growth(self, low: np.ndarray, high: np.ndarray) -> None:
        """Whether the map could hold a box [m].

        Raises:
            MapSizeError: As `cover` does.
        """
        self._grown(low, high)

    def _grown(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The bounds of the map when it holds a box plus the margin, if it can."""
        spacing, margin = self.config.middle_spacing, self.config.margin
        low = np.floor((low - margin) / spacing) * spacing
        high = np.ceil((high + margin) / spacing) * spacing
        if not self.is_empty:
            low, high = np.minimum(low, self.low), np.maximum(high, self.high)
        needed = self.gigabytes(low, high)
        more = needed - (0.0 if self.is_empty else self.gigabytes(self.low, self.high))
        self._check_size(low, high, needed, more)
        return low, high

    def _check_size(self, low: np.ndarray, high: np.ndarray, needed: float, more: float) -> None:
        """Whether so many gigabytes may be taken in all, and so many more can be."""
        if needed > self.config.max_gigabytes:
            raise MapSizeError(
                f"the map would grow to {np.round(high - low, 1).tolist()} m and {needed:.1f} GB, beyond "
                f"grid.max_gigabytes = {self.config.max_gigabytes}: raise it, lower grid.max_depth "
                f"(now {self.config.max_depth} m), or check the depth scale"
            )
        free = free_gigabytes(self.device)
        if free is not None and more > free:
            raise MapSizeError(
                f"the map would grow to {np.round(high - low, 1).tolist()} m, which needs {more:.1f} GB more, and "
                f"{self.device} has {free:.1f} GB free: lower grid.max_depth (now {self.config.max_depth} m), or check "
                "the depth scale"
            )

    def gigabytes(self, low: np.ndarray, high: np.ndarray) -> float:
        """Memory of the grids over a box, with both Adam moments and the gradient buffers [GB]; of levels in blocks,
        that of the blocks that were made.
        """
        return sum(grid.bytes_over(low, high, self._arrays) for grid in self.grids.values()) / 1e9

    @property
    def _arrays(self) -> int:
        """Arrays of a row's size that a row takes, at most."""
        return 2 + self._buffers + slice_count(self.device)

    @property
    def layout(self) -> str:
        """Of rows: "dense", or in "blocks", which `make_room` makes."""
        return self.config.layout

    @phase("growth")
    def make_room(
        self,
        images: tuple[wp.array, wp.array, wp.array],
        views: Sequence[PlacedImage],
        camera: Intrinsics,
        reach: Reach,
        around: float = 0.0,
    ) -> None:
        """Have rows for every vertex that a sample of some images touches; dense levels have them.

        Args:
            images: Colour, depth and scale of images in slots.
            views: Which, and where they were taken.
            camera: Intrinsics.
            reach: How far rays are followed.
            around: Vertices so near to a camera get a row, too [m].

        Raises:
            MapSizeError: As `cover` does.
        """
        for view in views:
            known = view.T_world_camera.tobytes(), reach.behind, reach.missing, around
            if view.name is not None and self._with_rows.get(view.name) == known:
                continue
            for grid in self.grids.values():
                if isinstance(grid, BlockGrid):
                    blocks = grid.wanted_blocks(images, view.slot, view.T_world_camera, camera, reach)
                    self._make(grid, blocks)
                    if around > 0:
                        center = view.T_world_camera[:3, 3]
                        self._make(grid, grid.wanted_in_box(center - around, center + around))
            if view.name is not None:
                self._with_rows[view.name] = known

    def _make(self, grid: BlockGrid, blocks: np.ndarray) -> None:
        if len(blocks):
            more = len(blocks) * BLOCK_ROWS * 128 * self._arrays / 1e9
            self._check_size(self.low, self.high, self.gigabytes(self.low, self.high) + more, more)
            grid.make(blocks)

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

    @exclusive
    def _query(self, points: np.ndarray, stage: str) -> np.ndarray:
        points = as_numbers(points, "points")
        if points.ndim != 2 or points.shape[1] != 3:
            raise InputError(f"points have shape {points.shape}, expected (N, 3)")
        if not (np.abs(points) <= MAX_DISTANCE).all():  # NaN is not
            raise InputError(f"points must be finite and within {MAX_DISTANCE:g} m of the origin")
        points = points.astype(np.float32)
        if self.is_empty:
            raise InputError("the map is empty: step at least one frame first")
        if self._queries is None:
            self._queries = RayBatch(QUERY_CHUNK, 1, self.device)
        batch, arrays = self._queries, self.arrays()
        parts = []
        for start in range(0, len(points), QUERY_CHUNK):
            chunk = points[start : start + QUERY_CHUNK]
            batch.set_points(chunk)
            query(batch, arrays, stage)
            values = batch.color if stage == "color" else batch.logit
            parts.append(values.numpy()[: len(chunk)].copy())
        if not parts:
            return np.zeros((0, 3) if stage == "color" else 0, np.float32)
        result = np.concatenate(parts)
        return np.clip(result, 0.0, 1.0) if stage == "color" else result


def new_grid(level: str, config: GridConfig, seed: int, device: wp.Device, decoders: Decoders) -> FeatureGrid:
    """An empty grid of a level. The coarse one is dense: it forecasts what was not seen, and has few vertices.

    Raises:
        CheckpointError: With `GridConfig.middle_start` free, see `warpslam.field.feature_fit.free_feature`.
    """
    spacing, std = getattr(config, f"{level}_spacing"), getattr(config, f"{level}_std")
    kind = BlockGrid if is_in_blocks(level, config) else FeatureGrid
    if level == "middle" and config.middle_start == "free":
        return kind(level, spacing, 0.0, seed, device, free_feature(decoders.middle))
    return kind(level, spacing, std, seed, device)


def is_in_blocks(level: str, config: GridConfig) -> bool:
    """Whether a level has rows only where something was seen."""
    return config.layout == "blocks" and level != "coarse"
