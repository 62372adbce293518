"""A mesh in blocks that is made anew only where the map has changed: for looking on while it grows."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence

import numpy as np

from warpslam.meshing.extraction import BlockMesh, Field, mesh_of_block
from warpslam.meshing.views import Evidence
from warpslam.scene.mapped_views import ObservedView

BlockKey = tuple[int, int, int]
"""Place of a block in a lattice of blocks at the world's origin."""


class GrowingMesh:
    """Blocks of the surface, and which of them are out of date.

    A block is out of date when a new view measured a surface in it. Small pieces are not dropped, as `extract_mesh`
    does: that takes the whole mesh.

    Args:
        voxel: Edge of a marching-cubes cell [m].
        level_set: Logit of the surface.
        block_cells: Cells along each edge of a block.
        device: Warp device of the seen test.
    """

    def __init__(
        self, voxel: float, level_set: float = 0.0, *, block_cells: int = 24, device: str | None = None
    ) -> None:
        self.voxel, self.level_set, self.block_cells, self.device = voxel, level_set, block_cells, device
        self._view_count = 0
        self._due: dict[BlockKey, None] = {}  # in the order in which they were last seen
        self._shown: set[BlockKey] = set()

    @property
    def due_count(self) -> int:
        """Blocks that are out of date."""
        return len(self._due)

    def note(self, views: Sequence[ObservedView]) -> None:
        """Learn of the views that are new since the last call; ``views`` are all of them, those of before first."""
        for view in views[self._view_count :]:
            for key in self._blocks_of(view.points()):
                self._due.pop(key, None)
                self._due[key] = None
        self._view_count = len(views)

    def update(
        self, scene: Field, views: Sequence[ObservedView], seconds: float
    ) -> Iterator[tuple[BlockKey, BlockMesh | None]]:
        """Mesh blocks that are out of date, those seen last first, for about so many seconds, but at least one.

        Args:
            scene: The map.
            views: All views.
            seconds: Time to take.

        Returns:
            Blocks and their meshes; None where a block that had a surface has none any more.
        """
        self.note(views)
        if not self._due:
            return
        end = time.perf_counter() + seconds
        margin = 2.0 * self.voxel
        evidence = Evidence(views, margin, margin, self.device)
        bounds = tuple(np.asarray(corner, dtype=np.float64) for corner in scene.bounds)
        while self._due:
            key, _ = self._due.popitem()
            mesh = self._mesh(scene, evidence, key, bounds)
            if mesh is not None:
                self._shown.add(key)
                yield key, mesh
            elif key in self._shown:
                self._shown.remove(key)
                yield key, None
            if time.perf_counter() >= end:
                return

    def _mesh(
        self, scene: Field, evidence: Evidence, key: BlockKey, bounds: tuple[np.ndarray, ...]
    ) -> BlockMesh | None:
        start = np.array(key, dtype=np.int64) * self.block_cells
        end = start + self.block_cells
        low = np.maximum(start, np.ceil(bounds[0] / self.voxel).astype(np.int64))
        high = np.minimum(end, np.floor(bounds[1] / self.voxel).astype(np.int64))
        if (high <= low).any():
            return None
        return mesh_of_block(scene, evidence, low, high, self.voxel, self.level_set)

    def _blocks_of(self, points: np.ndarray) -> list[BlockKey]:
        """Blocks that hold a point, or are close to one: the surface may lie a little before or behind it."""
        size, margin = self.block_cells * self.voxel, 2.0 * self.voxel
        low, high = np.floor((points - margin) / size), np.floor((points + margin) / size)
        corners = [np.where([bit >> axis & 1 for axis in range(3)], high, low) for bit in range(8)]
        return [tuple(key) for key in np.unique(np.concatenate(corners).astype(np.int64), axis=0).tolist()]
