"""A level whose rows follow what was seen: blocks of vertices are made when an image needs them."""

from __future__ import annotations

import numpy as np
import warp as wp

from warpslam.camera import Intrinsics
from warpslam.field.arrays import camera_struct, lazy_zeros, struct
from warpslam.field.ray_batch import image_struct
from warpslam.kernels import grid as grid_kernels
from warpslam.kernels.blocks import TILE, Reach, want_blocks
from warpslam.kernels.grid import BLOCK, BLOCK_ROWS, Lattice, Vec32
from warpslam.scene.feature_grid import FeatureGrid, GridState

GROWTH = {"cpu": 4.0, "cuda": 1.5}
"""Arrays grow at least by this: all copying together is then thrice what is copied, at most. On the CPU rows that are
not written to take no memory.
"""

Images = tuple[wp.array, wp.array, wp.array]


class BlockGrid(FeatureGrid):
    """One level in blocks of `warpslam.kernels.grid.BLOCK` vertices along each axis; see there.

    Growth of the box lays out the table anew, which has a number a block; growth of what was seen appends rows. Neither
    moves a row.

    blocks: Which were made, in their order, int64 (n, 3), in units of blocks of the world lattice.
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
        self.blocks = np.zeros((0, 3), np.int64)
        self._table = np.zeros((0, 0, 0), np.int32)
        self._device_table = wp.zeros(1, dtype=int, device=device)
        self._wanted = wp.zeros(1, dtype=int, device=device)
        self._count = wp.zeros(1, dtype=int, device=device)
        self._corners = wp.zeros(1, dtype=wp.vec3i, device=device)
        super().__init__(level, spacing, std, seed, device, mean)
        self._reserve(BLOCK_ROWS)
        self._launcher.launch(grid_kernels.fill_shared, BLOCK_ROWS, [self._start(), self.features])

    @property
    def row_count(self) -> int:
        """Rows in use, those that are shared first."""
        return BLOCK_ROWS * (1 + len(self.blocks))

    @property
    def capacity(self) -> int:
        """Rows that there is room for."""
        return int(self.features.shape[0])

    @property
    def bytes(self) -> int:
        """Memory of the features and of what leads to them."""
        return 128 * self.row_count + 8 * self._table.size + 12 * len(self.blocks)

    def bytes_over(self, low: np.ndarray, high: np.ndarray, arrays: int) -> float:
        """Memory of the grid grown to a box [m]: what is there now, and a larger table."""
        table = float(np.prod((high - low) / (BLOCK * self.spacing) + 2)) * 8
        return 128.0 * self.row_count * arrays + table

    # -- blocks --------------------------------------------------------------------------------------------------

    def wanted_blocks(
        self, images: Images, slot: int, T_world_camera: np.ndarray, camera: Intrinsics, reach: Reach
    ) -> np.ndarray:
        """Blocks that an image needs and that were not made, as in `blocks`, in the order of the table.

        On a GPU one number is read back, and the table's marks if it is not 0.

        Args:
            images: Colour, depth and scale of images in slots.
            slot: Which of them.
            T_world_camera: Its pose (4, 4).
            camera: Intrinsics.
            reach: How far its rays are followed.
        """
        height, width = images[1].shape[1:]
        inputs = [self.lattice, wp.mat44(*T_world_camera.astype(np.float32).ravel().tolist()), camera_struct(camera)]
        inputs += [image_struct(images), slot, reach, self._wanted, self._count]
        self._launcher.spread(want_blocks, -(-width // TILE) * -(-height // TILE), inputs)
        if not self._count.numpy()[0]:
            return np.zeros((0, 3), np.int64)
        wanted = self._wanted.numpy().reshape(self._table.shape) != 0
        self._wanted.zero_()
        self._count.zero_()
        return np.argwhere(wanted) + self._first_block

    def wanted_in_box(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Blocks with vertices between two corners [m] that were not made, as in `wanted_blocks`."""
        first = np.maximum(np.floor(low / self.spacing).astype(np.int64), self.first)
        last = np.minimum(np.ceil(high / self.spacing).astype(np.int64), self.first + self.shape - 1)
        if (last < first).any():
            return np.zeros((0, 3), np.int64)
        first, last = first // BLOCK - self._first_block, last // BLOCK - self._first_block
        part = self._table[first[0] : last[0] + 1, first[1] : last[1] + 1, first[2] : last[2] + 1]
        return np.argwhere(part == 0) + first + self._first_block

    def make(self, blocks: np.ndarray) -> None:
        """Make blocks, int64 (n, 3), in this order; their features are the initial ones.

        What is recorded goes on to hold, unless the arrays have to grow: the table is changed in its place.
        """
        if not len(blocks):
            return
        start, count = self.row_count, len(blocks)
        self._reserve(start + BLOCK_ROWS * count)
        corners = wp.array((BLOCK * blocks).astype(np.int32), dtype=wp.vec3i, device=self.device)
        wp.copy(self._corners, corners, dest_offset=len(self.blocks))
        self.blocks = np.concatenate([self.blocks, blocks])
        self.renew(np.arange(start, start + BLOCK_ROWS * count))
        self._note(blocks, start)
        self._device_table.assign(self._table.ravel())

    def rows_of(self, vertices: np.ndarray) -> np.ndarray:
        """See `FeatureGrid.rows_of`."""
        within = np.stack(np.meshgrid(*3 * [np.arange(BLOCK)], indexing="ij"), -1).reshape(-1, 3)
        places = (BLOCK * self.blocks[:, None] + within - self.first).reshape(-1, 3)
        mask = np.zeros(self.row_count, bool)
        inside = ((places >= 0) & (places < self.shape)).all(axis=1)  # blocks reach beyond the box
        mask[BLOCK_ROWS:][inside] = vertices.reshape(self.shape)[tuple(places[inside].T)]
        return mask

    def renew(self, rows: np.ndarray) -> None:
        """See `FeatureGrid.renew`."""
        which = wp.array(rows.astype(np.int32), dtype=int, device=self.device)
        inputs = [which, self.lattice, self._start(), self.features, self.seen]
        self._launcher.launch(grid_kernels.fill_rows, len(rows), inputs)

    def _note(self, blocks: np.ndarray, start: int) -> None:
        """Write first rows into the table."""
        place = tuple((blocks - self._first_block).T)
        self._table[place] = start + BLOCK_ROWS * np.arange(len(blocks))

    def _reserve(self, rows: int) -> None:
        """Have room for so many rows."""
        old = self.features, self.seen, self._corners
        have = old[0].shape[0]
        if rows <= have and have >= BLOCK_ROWS:
            return
        blocks = max(rows, int(GROWTH["cuda" if self.device.is_cuda else "cpu"] * have)) // BLOCK_ROWS
        self.features = lazy_zeros((BLOCK_ROWS * blocks,), self.device)
        self.seen = wp.zeros(BLOCK_ROWS * blocks, dtype=wp.uint8, device=self.device)
        self._corners = wp.zeros(blocks, dtype=wp.vec3i, device=self.device)
        for source, target in zip(old, (self.features, self.seen, self._corners), strict=True):
            wp.copy(target, source, count=source.shape[0])
        self.lattice = self._lattice()

    # -- as `FeatureGrid` ----------------------------------------------------------------------------------------

    @property
    def _first_block(self) -> np.ndarray:
        return self.first // BLOCK

    def _resize(self, first: np.ndarray, shape: tuple[int, int, int]) -> None:
        self.first, self.shape = first, shape
        size = (first + shape - 1) // BLOCK - self._first_block + 1
        self._table = np.zeros(size, np.int32)
        self._note(self.blocks, BLOCK_ROWS)
        self._device_table = wp.array(self._table.ravel(), dtype=int, device=self.device)
        self._wanted = wp.zeros(self._table.size, dtype=int, device=self.device)
        self.lattice = self._lattice()

    def state(self) -> GridState:
        """The grid as arrays, of the blocks that were made; on the CPU they are its own, not copies."""
        rows = slice(BLOCK_ROWS, self.row_count)
        return GridState(self.first, self.shape, self.features.numpy()[rows], self.seen.numpy()[rows], self.blocks)

    def restore(self, state: GridState) -> None:
        """Put back what `state` was."""
        assert state.blocks is not None
        self.blocks = np.zeros((0, 3), np.int64)
        if any(state.shape):
            self._resize(np.asarray(state.first, np.int64), state.shape)
        self.make(np.asarray(state.blocks, np.int64))
        if len(state.blocks):
            features = wp.array(np.ascontiguousarray(state.features, np.float32), dtype=Vec32, device=self.device)
            seen = wp.array(np.ascontiguousarray(state.seen, np.uint8), dtype=wp.uint8, device=self.device)
            wp.copy(self.features, features, dest_offset=BLOCK_ROWS)
            wp.copy(self.seen, seen, dest_offset=BLOCK_ROWS)

    def update_from(self, other: FeatureGrid, rows: wp.array | None) -> None:
        """Take over extent and blocks of another grid of this level, and some of its rows: int (n,), None for none."""
        assert isinstance(other, BlockGrid)
        if other.shape != self.shape or (other.first != self.first).any():
            self._resize(other.first, other.shape)
        self.make(other.blocks[len(self.blocks) :])
        if rows is not None:
            inputs = [rows, other.features, self.features]
            self._launcher.launch(grid_kernels.copy_rows, rows.shape[0], inputs)
            wp.copy(self.seen, other.seen, count=self.row_count)

    def _lattice(self) -> Lattice:
        lattice = super()._lattice()
        lattice.shared = BLOCK_ROWS
        lattice.first = wp.vec3i(*(int(n) for n in self.first))
        lattice.offset = wp.vec3i(*(int(n) for n in self.first % BLOCK))
        lattice.blocks = wp.vec3i(*self._table.shape)
        lattice.table, lattice.corners = self._device_table, self._corners
        return lattice


def reach_of(behind: float, missing: float = 0.0) -> Reach:
    """How far rays are followed: behind their depth, and where there is none [m]."""
    return struct(Reach, behind=behind, missing=missing)
