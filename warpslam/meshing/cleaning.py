"""What is left of a raw mesh: faces dropped, pieces counted, normals, and the hull of what was seen."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull


def keep_faces(vertices: np.ndarray, faces: np.ndarray, keep: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The mesh with only the faces where `keep` (F,) is set, and only the vertices they use."""
    used, index = np.unique(faces[keep], return_inverse=True)
    return vertices[used], index.reshape(-1, 3)


def piece_areas(
    vertices: np.ndarray, faces: np.ndarray, marked: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Area [m^2] of the connected piece that each face belongs to, and how much of it is `marked` (F,); (F,) each."""
    rows, columns = faces.ravel(), np.roll(faces, 1, axis=1).ravel()
    graph = coo_matrix((np.ones(len(rows), dtype=np.uint8), (rows, columns)), shape=(len(vertices),) * 2)
    label = connected_components(graph, directed=False)[1][faces[:, 0]]
    area = 0.5 * np.linalg.norm(face_vectors(vertices, faces), axis=1)
    marked_area = np.zeros(len(faces)) if marked is None else area * marked
    return np.bincount(label, weights=area)[label], np.bincount(label, weights=marked_area)[label]


def face_vectors(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Normals (F, 3) of the faces, as long as twice their area."""
    a, b, c = (vertices[faces[:, n]] for n in range(3))
    return np.cross(b - a, c - a)


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals (V, 3) float64: the mean of the faces around a vertex, weighted by area."""
    vectors = np.repeat(face_vectors(vertices, faces), 3, axis=0)
    total = np.stack([np.bincount(faces.ravel(), weights=vectors[:, n], minlength=len(vertices)) for n in range(3)], 1)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)


class Hull:
    """Convex hull of points (N, 3) [m], scaled about its centre; the test is on its half-spaces, so it is exact."""

    def __init__(self, points: np.ndarray, scale: float) -> None:
        # QJ moves the points by rounding errors: points of one plane have a hull as well then.
        hull = ConvexHull(points, qhull_options="QJ")
        self.normals = np.unique(hull.equations.round(9), axis=0)
        corners = points[hull.vertices]
        center = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
        # n . (c + (x - c) / scale) + d <= 0
        self.offsets = scale * self.normals[:, 3] + (scale - 1.0) * (self.normals[:, :3] @ center)
        self.normals = self.normals[:, :3]

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Whether each point (N, 3) [m] lies inside, bool (N,)."""
        inside = np.ones(len(points), dtype=bool)
        for normal, offset in zip(self.normals, self.offsets, strict=True):
            rest = np.flatnonzero(inside)
            inside[rest] = points[rest] @ normal + offset <= 0
        return inside

    def misses_box(self, lo: np.ndarray, hi: np.ndarray) -> bool:
        """Whether one of the half-spaces leaves out all of the box from `lo` to `hi` [m]."""
        nearest = np.where(self.normals > 0, lo, hi)
        return bool(((nearest * self.normals).sum(axis=1) + self.offsets > 0).any())
