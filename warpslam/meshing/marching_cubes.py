"""Marching cubes block by block, on Warp's tables: vertices are named by their lattice edge, so blocks fit exactly."""

from __future__ import annotations

import numpy as np
from warp.geometry import IsoSurfaceMarchingCubes


def corner_views(points: np.ndarray) -> list[np.ndarray]:
    """Values of the 8 corners of every cell as views of the point array, in the order of the tables."""
    n = [size - 1 for size in points.shape]
    offsets = IsoSurfaceMarchingCubes.CUBE_CORNER_OFFSETS
    return [points[i : i + n[0], j : j + n[1], k : k + n[2]] for i, j, k in offsets]


def all_corners(points: np.ndarray) -> np.ndarray:
    """Cells all of whose corners are set, bool (nx-1, ny-1, nz-1)."""
    return np.logical_and.reduce(corner_views(points))


def touched_points(cells: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Points that are a corner of a set cell, bool, of the given shape."""
    points = np.zeros(shape, dtype=bool)
    for corner in corner_views(points):
        corner |= cells
    return points


class Surface:
    """Collects the triangles of all blocks; a vertex is named by the lattice edge it lies on."""

    def __init__(self, lo: np.ndarray, hi: np.ndarray, voxel: float) -> None:
        tables = IsoSurfaceMarchingCubes
        corners = np.array(tables.CUBE_CORNER_OFFSETS)
        pairs = np.array(tables.EDGE_TO_CORNERS)
        self.edge_start = corners[pairs[:, 0]]
        self.edge_axis = np.argmax(corners[pairs[:, 1]] - self.edge_start, axis=1)
        self.case_start = np.array(tables.CASE_TO_TRI_RANGE)
        self.case_edges = np.array(tables.TRI_LOCAL_INDICES)
        self.lo, self.voxel = lo, voxel
        extent = hi - lo + 1
        self.stride = np.array([extent[1] * extent[2], extent[2], 1], dtype=np.int64)
        self.keys: list[np.ndarray] = []
        self.positions: list[np.ndarray] = []
        self.faces: list[np.ndarray] = []
        self.cells: list[np.ndarray] = []
        self.groups: list[np.ndarray] = []

    def add_block(
        self, logits: np.ndarray, cells: np.ndarray, start: np.ndarray, level_set: float, group: int = 0
    ) -> None:
        """Add the triangles of the cells set in `cells`.

        `logits` holds the block's points, `start` is its first lattice index, `group` is what `merged` says of these
        triangles.
        """
        code = np.zeros(cells.shape, dtype=np.uint8)
        for bit, corner in enumerate(corner_views(logits > level_set)):
            code |= corner.astype(np.uint8) << np.uint8(bit)
        cell = np.argwhere(cells & (code != 0) & (code != 255))
        if len(cell) == 0:
            return
        case = code[tuple(cell.T)].astype(np.int64)
        count = self.case_start[case + 1] - self.case_start[case]
        owner = np.repeat(np.arange(len(cell)), count)
        nth = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
        edge = self.case_edges[self.case_start[case][owner] + nth]

        point = cell[owner] + self.edge_start[edge]
        axis = self.edge_axis[edge]
        key = ((point + start - self.lo) @ self.stride) * 3 + axis
        unique, first = np.unique(key, return_index=True)
        a, axis = point[first], axis[first]
        b = a + np.eye(3, dtype=np.int64)[axis]
        value_a, value_b = (logits[tuple(p.T)].astype(np.float64) for p in (a, b))
        # A vertex exactly on a lattice point would be shared by several edges and give triangles without area.
        t = np.clip((level_set - value_a) / (value_b - value_a), 1e-3, 1.0 - 1e-3)
        position = (a + start).astype(np.float64)
        position[np.arange(len(a)), axis] += t
        self.keys.append(unique)
        self.positions.append(position * self.voxel)
        # The tables wind triangles so that normals point to higher values; ours point to free space.
        self.faces.append(key.reshape(-1, 3)[:, ::-1])
        self.cells.append(((cell + start - self.lo) @ self.stride)[owner[::3]])
        self.groups.append(np.full(len(owner) // 3, group))

    def merged(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Vertices (V, 3) float64 [m] and faces (F, 3) int64, ordered along the lattice, and the faces' groups (F,)."""
        if not self.keys:
            return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64), np.zeros(0, dtype=np.int64)
        keys, first = np.unique(np.concatenate(self.keys), return_index=True)
        order = np.argsort(np.concatenate(self.cells), kind="stable")
        faces = np.searchsorted(keys, np.concatenate(self.faces)[order])
        return np.concatenate(self.positions)[first], faces, np.concatenate(self.groups)[order]
