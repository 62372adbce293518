"""Analytic solids: exact inside test, distance bound, and a triangulated surface.

A solid is a box, an elliptical frustum (cylinder, cone, tapered leg) or an ellipsoid with a pose. With q = R^T (p - c):

    box        |q_i| <= half_i
    frustum    |q_z| <= half_z  and  hypot(q_x / half_x, q_y / half_y) <= 1 + (taper - 1) (q_z / half_z + 1) / 2
    ellipsoid  |q / half| <= 1
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_CHORD_ERROR = 0.001  # largest distance [m] between a curved surface and its triangles


@dataclass(frozen=True)
class Solid:
    """One solid part."""

    kind: str
    """"box", "frustum" or "ellipsoid"."""
    center: np.ndarray
    """Centre of the solid [m], shape (3,)."""
    rotation: np.ndarray
    """Solid-to-room rotation, shape (3, 3)."""
    half: np.ndarray
    """Half sizes [m], shape (3,); of a frustum its bottom radii and half height."""
    material: int
    """Index of its material."""
    taper: float = 1.0
    """Top radius over bottom radius of a frustum."""

    @property
    def extent(self) -> np.ndarray:
        """Half sizes of the box around the solid in its own axes [m], shape (3,)."""
        widest = max(1.0, self.taper) if self.kind == "frustum" else 1.0
        return self.half * np.array([widest, widest, 1.0])

    @property
    def bounds(self) -> np.ndarray:
        """Axis-aligned box around the solid [m], shape (2, 3)."""
        reach = np.abs(self.rotation) @ self.extent
        return np.stack([self.center - reach, self.center + reach])

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Whether ``points`` [m], shape (N, 3), lie in the solid (its surface included), shape (N,)."""
        q = (points - self.center) @ self.rotation
        if self.kind == "box":
            return (np.abs(q) <= self.half).all(axis=1)
        q = q / self.half
        if self.kind == "ellipsoid":
            return (q * q).sum(axis=1) <= 1.0
        radius = 1.0 + (self.taper - 1.0) * 0.5 * (q[:, 2] + 1.0)
        return (np.abs(q[:, 2]) <= 1.0) & (q[:, 0] ** 2 + q[:, 1] ** 2 <= radius**2)

    def distance_bound(self, points: np.ndarray) -> np.ndarray:
        """Distance [m] to the solid's oriented box, shape (N,): exact for a box, else never above the true one."""
        q = np.abs((points - self.center) @ self.rotation) - self.extent
        return np.linalg.norm(np.maximum(q, 0.0), axis=1)

    def surface(self, spacing: float) -> Surface:
        """Triangulate the surface with edges of about ``spacing`` [m]."""
        if self.kind == "box":
            patches = _box_patches(self.half, spacing)
        elif self.kind == "frustum":
            patches = _frustum_patches(self.half, self.taper, spacing)
        else:
            patches = _ellipsoid_patches(self.half, spacing)
        local = Surface.joined(patches)
        return Surface(local.vertices @ self.rotation.T + self.center, local.faces, local.curved)

    def onto_curve(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Move points of a curved triangle onto the exact curved surface.

        Returns:
            points [m] and outward unit normals, both of shape (N, 3).
        """
        q = (points - self.center) @ self.rotation
        if self.kind == "ellipsoid":
            q = q / np.linalg.norm(q / self.half, axis=1, keepdims=True)
            normals = q / self.half**2
        else:
            radius = 1.0 + (self.taper - 1.0) * 0.5 * (q[:, 2:] / self.half[2] + 1.0)
            q[:, :2] *= radius / np.linalg.norm(q[:, :2] / self.half[:2], axis=1, keepdims=True)
            slope = np.full(len(q), 0.5 * (1.0 - self.taper) / self.half[2])
            normals = np.column_stack([q[:, :2] / self.half[:2] ** 2 / radius, slope])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return q @ self.rotation.T + self.center, normals @ self.rotation.T


@dataclass(frozen=True)
class Surface:
    """Triangles, counter-clockwise from outside."""

    vertices: np.ndarray
    """Positions [m], shape (V, 3)."""
    faces: np.ndarray
    """Vertex indices, shape (F, 3)."""
    curved: np.ndarray
    """Whether a triangle stands for a curved piece, shape (F,)."""

    @classmethod
    def joined(cls, surfaces: list[Surface]) -> Surface:
        """All triangles of ``surfaces`` in one."""
        offsets = np.cumsum([0] + [len(s.vertices) for s in surfaces[:-1]])
        return cls(
            np.concatenate([s.vertices for s in surfaces]),
            np.concatenate([s.faces + offset for s, offset in zip(surfaces, offsets, strict=True)]),
            np.concatenate([s.curved for s in surfaces]),
        )


def yaw_rotation(yaw: float, tilt: float = 0.0) -> np.ndarray:
    """Rotation (3, 3) about x by ``tilt``, then about z by ``yaw`` [rad]."""
    c, s = np.cos(yaw), np.sin(yaw)
    ct, st = np.cos(tilt), np.sin(tilt)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]) @ np.array([[1.0, 0, 0], [0, ct, -st], [0, st, ct]])


def _grid(u_count: int, v_count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit-square grid: u and v per vertex, and faces that are counter-clockwise in the (u, v) plane."""
    u, v = np.meshgrid(np.linspace(0, 1, u_count + 1), np.linspace(0, 1, v_count + 1), indexing="ij")
    index = np.arange(u.size).reshape(u.shape)
    a, b, c, d = (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:])
    faces = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    return u.ravel(), v.ravel(), faces


def _cells(length: float, spacing: float) -> int:
    return max(1, int(np.ceil(length / spacing - 1e-9)))


def _ring_cells(radius: float, spacing: float) -> int:
    chord = np.pi / np.arccos(max(1.0 - _CHORD_ERROR / radius, 0.0))
    return int(np.clip(max(chord, 2 * np.pi * radius / spacing), 8, 96))


def _box_patches(half: np.ndarray, spacing: float) -> list[Surface]:
    patches = []
    for axis in range(3):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        u, v, faces = _grid(_cells(2 * half[i], spacing), _cells(2 * half[j], spacing))
        for side in (-1.0, 1.0):
            vertices = np.empty((len(u), 3))
            vertices[:, axis] = side * half[axis]
            vertices[:, i] = (2 * u - 1) * half[i]
            vertices[:, j] = (2 * v - 1) * half[j]
            patches.append(Surface(vertices, faces if side > 0 else faces[:, ::-1], np.zeros(len(faces), bool)))
    return patches


def _frustum_patches(half: np.ndarray, taper: float, spacing: float) -> list[Surface]:
    radius = max(half[0], half[1]) * max(1.0, taper)
    ring = _ring_cells(radius, spacing)
    u, v, faces = _grid(ring, _cells(2 * half[2], spacing))
    scale = 1.0 + (taper - 1.0) * v
    angle = 2 * np.pi * u
    side = np.column_stack([scale * half[0] * np.cos(angle), scale * half[1] * np.sin(angle), (2 * v - 1) * half[2]])
    patches = [Surface(side, faces, np.ones(len(faces), bool))]
    for end, size in ((-1.0, 1.0), (1.0, taper)):
        u, v, faces = _grid(_cells(max(half[0], half[1]) * size, spacing), ring)
        angle = 2 * np.pi * v
        cap = np.column_stack(
            [u * size * half[0] * np.cos(angle), u * size * half[1] * np.sin(angle), np.full(len(u), end * half[2])]
        )
        patches.append(Surface(cap, faces if end > 0 else faces[:, ::-1], np.zeros(len(faces), bool)))
    return patches


def _ellipsoid_patches(half: np.ndarray, spacing: float) -> list[Surface]:
    ring = _ring_cells(float(half.max()), spacing)
    u, v, faces = _grid(ring, max(4, ring // 2))
    azimuth, polar = 2 * np.pi * u, np.pi * v
    vertices = half * np.column_stack(
        [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), -np.cos(polar)]
    )
    return [Surface(vertices, faces, np.ones(len(faces), bool))]
