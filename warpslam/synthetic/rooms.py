"""Random furnished rooms whose occupancy, surface and colours are known exactly.

A room is a union of analytic solids. Its walls, floor and ceiling are solids too, at least 0.2 m thick.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from warpslam.errors import InputError
from warpslam.synthetic.furniture import AGAINST_WALL, FREE_STANDING, Piece, PieceBuilder
from warpslam.synthetic.solids import Solid, Surface, yaw_rotation
from warpslam.synthetic.textures import Material

if TYPE_CHECKING:
    import trimesh

_SURFACE_STEP = 1e-3  # [m] distance at which a surface point is tested for being covered by another solid


@dataclass(frozen=True, eq=False)
class Room:
    """A union of solids, with colours.

    All public methods take and return world coordinates.
    """

    solids: list[Solid]
    """Parts in room coordinates [m], z up, floor at z = 0."""
    materials: list[Material]
    """What ``Solid.material`` points into."""
    interior: np.ndarray
    """Box of the space inside the outer shell, recesses included, room coordinates [m], shape (2, 3)."""
    offset: np.ndarray
    """World position of the room's origin [m], shape (3,)."""
    wall: float
    """Thickness of the outer shell [m]."""

    @property
    def bounds(self) -> np.ndarray:
        """Box of the room with its walls [m], shape (2, 3). Outside of it, `occupancy` is False."""
        return self.interior_bounds + np.array([[-self.wall], [self.wall]])

    @property
    def interior_bounds(self) -> np.ndarray:
        """Box of the space inside the walls, recesses included [m], shape (2, 3)."""
        return self.interior + self.offset

    def occupancy(self, points: np.ndarray) -> np.ndarray:
        """Whether points lie in a solid.

        Args:
            points: Positions [m], shape (N, 3).

        Returns:
            bool, shape (N,).
        """
        points = self._local(points)
        # Sorting by x once turns the box cull of every solid into a contiguous slice.
        order = np.argsort(points[:, 0])
        x, y, z = np.ascontiguousarray(points[order].T)
        inside = np.zeros(len(points), dtype=bool)
        for solid, (low, high) in zip(self.solids, self._boxes, strict=True):
            first, last = np.searchsorted(x, low[0], "left"), np.searchsorted(x, high[0], "right")
            ys, zs = y[first:last], z[first:last]
            near = (zs >= low[2]) & (zs <= high[2]) & (ys >= low[1]) & (ys <= high[1]) & ~inside[first:last]
            index = np.flatnonzero(near) + first
            if len(index):
                inside[index] = solid.contains(np.column_stack([x[index], y[index], z[index]]))
        result = np.empty(len(points), dtype=bool)
        result[order] = inside
        return result

    def free_space(self, points: np.ndarray, margin: float = 0.0) -> np.ndarray:
        """Whether a ball of radius ``margin`` [m] around each point touches no solid (never wrongly True).

        Round solids count with the box around them.

        Args:
            points: Positions [m], shape (N, 3).

        Returns:
            bool, shape (N,).
        """
        points = self._local(points)
        free = ((points >= self.interior[0]) & (points <= self.interior[1])).all(axis=1)
        for solid, (low, high) in zip(self.solids, self._boxes, strict=True):
            index = np.flatnonzero(free & ((points >= low - margin) & (points <= high + margin)).all(axis=1))
            if len(index):
                free[index] = solid.distance_bound(points[index]) > margin
        return free

    def color_at(self, points: np.ndarray, part: np.ndarray | int) -> np.ndarray:
        """Colour of the material of each point's part.

        Args:
            points: Positions [m], shape (N, 3).
            part: Index into ``solids``, one or shape (N,).

        Returns:
            float32 in [0, 1], shape (N, 3).
        """
        points = self._local(points)
        material = np.array([solid.material for solid in self.solids])[np.broadcast_to(part, len(points))]
        colors = np.empty((len(points), 3), dtype=np.float32)
        order = np.argsort(material, kind="stable")
        for group in np.split(order, np.flatnonzero(np.diff(material[order])) + 1):
            if len(group):
                colors[group] = self.materials[material[group[0]]].color_at(points[group])
        return colors

    def sample_surface(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Random points of the visible surface, uniform by area.

        Returns:
            points [m], outward unit normals and colours in [0, 1], each float32, shape (count, 3).
        """
        surface, part = self._coarse
        corners = surface.vertices[surface.faces]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        doubled_area = np.linalg.norm(cross, axis=1)
        flat_normals = cross / doubled_area[:, None]
        cumulative = np.cumsum(doubled_area)
        found: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        missing = count
        while missing > 0:
            draw = int(1.3 * missing) + 64
            face = np.searchsorted(cumulative, rng.uniform(0, cumulative[-1], size=draw))
            face = np.minimum(face, len(cumulative) - 1)
            u, v = np.sqrt(rng.uniform(size=(draw, 1))), rng.uniform(size=(draw, 1))
            a, b, c = corners[face].transpose(1, 0, 2)
            points = (1 - u) * a + u * (1 - v) * b + u * v * c
            normals = flat_normals[face]
            self._snap(points, normals, surface.curved[face], part[face])
            keep = self._uncovered(points + _SURFACE_STEP * normals)
            found.append((points[keep][:missing], normals[keep][:missing], part[face][keep][:missing]))
            missing -= len(found[-1][0])
        if not found:
            empty = np.empty((0, 3), dtype=np.float32)
            return empty, empty.copy(), empty.copy()
        points, normals, parts = (np.concatenate(column) for column in zip(*found, strict=True))
        # The acceptance order is that of the draws, so no shuffle is needed.
        points = points + self.offset
        return points.astype(np.float32), normals.astype(np.float32), self.color_at(points, parts)

    def mesh(self, spacing: float = 0.05) -> trimesh.Trimesh:
        """Visible surface with a colour at each vertex; vertices are about ``spacing`` [m] apart.

        Triangles that another solid covers are left out, partly covered ones are kept whole.
        """
        import trimesh  # takes a second, and rooms without a mesh need none of it

        surface, part = self._visible_surface(spacing)
        used, faces = np.unique(surface.faces, return_inverse=True)
        vertex_part = np.empty(len(surface.vertices), dtype=int)
        vertex_part[surface.faces] = part[:, None]
        points = surface.vertices[used] + self.offset
        colors = (255 * self.color_at(points, vertex_part[used]) + 0.5).astype(np.uint8)
        return trimesh.Trimesh(points, faces.reshape(-1, 3), vertex_colors=colors, process=False)

    @cached_property
    def _boxes(self) -> np.ndarray:
        return np.stack([solid.bounds for solid in self.solids])

    @cached_property
    def _coarse(self) -> tuple[Surface, np.ndarray]:
        return self._visible_surface(0.25)

    def _local(self, points: np.ndarray) -> np.ndarray:
        points = np.asarray(points, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 3:
            raise InputError(f"points has shape {points.shape}, expected (N, 3)")
        return points - self.offset

    def _uncovered(self, points: np.ndarray) -> np.ndarray:
        inside_shell = ((points > self.interior[0]) & (points < self.interior[1])).all(axis=1)
        return inside_shell & ~self.occupancy(points + self.offset)

    def _snap(self, points: np.ndarray, normals: np.ndarray, curved: np.ndarray, part: np.ndarray) -> None:
        """Move points of curved triangles onto their solid, in place, with their exact normals."""
        index = np.flatnonzero(curved)
        index = index[np.argsort(part[index], kind="stable")]
        for group in np.split(index, np.flatnonzero(np.diff(part[index])) + 1):
            if len(group):
                points[group], normals[group] = self.solids[part[group[0]]].onto_curve(points[group])

    def _visible_surface(self, spacing: float) -> tuple[Surface, np.ndarray]:
        """Triangles with some uncovered point, and the solid each belongs to, room coordinates."""
        surfaces = [solid.surface(spacing) for solid in self.solids]
        surface = Surface.joined(surfaces)
        part = np.repeat(np.arange(len(surfaces)), [len(s.faces) for s in surfaces])
        corners = surface.vertices[surface.faces]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = np.linalg.norm(cross, axis=1)
        # The pole of a disc or an ellipsoid yields slivers of no area.
        keep = np.flatnonzero(area > 1e-10)
        corners, normals = corners[keep], cross[keep] / area[keep, None]
        center = corners.mean(axis=1)
        probes = [center] + [0.9 * corners[:, k] + 0.1 * center for k in range(3)]
        probes += [0.45 * (corners[:, k] + corners[:, k - 1]) + 0.1 * center for k in range(3)]
        visible = np.zeros(len(keep), dtype=bool)
        for probe in probes:
            rest = np.flatnonzero(~visible)
            visible[rest] = self._uncovered(probe[rest] + 2 * _SURFACE_STEP * normals[rest])
        keep = keep[visible]
        return Surface(surface.vertices, surface.faces[keep], surface.curved[keep]), part[keep]


def make_room(seed: int, *, furniture: bool = True, offset: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Room:
    """Generate a room: 3-7 m by 3-7 m, 2.4-3 m high, with recesses, sometimes L-shaped.

    Args:
        seed: The same seed gives the same room.
        furniture: False leaves only the shell (walls, floor, ceiling, doors, windows).
        offset: World position of the room's origin, a corner on the floor [m].
    """
    origin = np.asarray(offset, dtype=np.float64)
    if origin.shape != (3,) or not np.isfinite(origin).all():
        raise InputError(f"offset = {origin!r} must be three finite numbers")
    return _RoomBuilder(np.random.default_rng(seed)).build(furniture, origin)


@dataclass(frozen=True)
class _Recess:
    """Opening in the inner layer of a wall: range along the wall and in height [m], and what it is."""

    kind: str
    u: tuple[float, float]
    z: tuple[float, float]


DrawPose = Callable[[np.ndarray, np.ndarray], tuple[float, np.ndarray]]
"""Yaw and position of a piece whose box has these corners."""


class _RoomBuilder:
    """Builds the shell, then places furniture where there is floor left."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.materials: list[Material] = []
        self.solids: list[Solid] = []
        self.taken: list[np.ndarray] = []  # footprints [m]: (x0, y0, x1, y1)
        self.recesses: dict[int, list[_Recess]] = {}
        self.size = np.array([rng.uniform(3.0, 7.0), rng.uniform(3.0, 7.0), rng.uniform(2.4, 3.0)])
        self.wall = float(rng.uniform(0.2, 0.3))
        self.recess = float(rng.uniform(0.1, 0.3))

    def build(self, furnished: bool, offset: np.ndarray) -> Room:
        self._add_shell()
        if furnished:
            self._furnish()
        w, d, h = self.size
        r = self.recess
        interior = np.array([[-r, -r, 0.0], [w + r, d + r, h]])
        return Room(self.solids, self.materials, interior, offset, self.wall)

    def _add_shell(self) -> None:
        w, d, h = self.size
        t, r = self.wall, self.recess
        o = t + r
        piece = Piece(self.rng, self.materials)
        light = {"contrast": 0.22, "scale": (0.3, 0.7), "noise": 0.55}
        floor = np.clip(self.rng.uniform(0.3, 0.75) * (1 + 0.25 * self.rng.normal(size=3)), 0.15, 0.9)
        piece.box(
            (-o, -o, -t), (w + o, d + o, 0), piece.paint("checker", "wood", "bricks", "blotches", color=floor, **light)
        )
        pale = np.array([0.8, 0.8, 0.78])
        piece.box((-o, -o, h), (w + o, d + o, h + t), piece.paint("blotches", "checker", color=pale, **light))
        base = np.clip(0.7 + 0.1 * self.rng.normal(size=3), 0.4, 0.9)
        for side in range(4):
            tint = np.clip(base + 0.06 * self.rng.normal(size=3), 0.3, 0.95)
            self._add_wall(piece, side, piece.paint(color=tint, **light))
        if self.rng.uniform() < 0.45:
            self._add_corner_block(piece)
        self.solids += piece.solids

    def _wall_frame(self, side: int) -> tuple[float, float, np.ndarray, np.ndarray]:
        """Length of a wall, its yaw, its start and its direction; its inward normal is the direction turned left."""
        w, d, _ = self.size
        start = np.array([[0.0, 0.0], [w, 0.0], [w, d], [0.0, d]][side])
        along = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]][side])
        return (w, d, w, d)[side], side * np.pi / 2, start, along

    def _add_wall(self, room: Piece, side: int, paint: int) -> None:
        length, yaw, start, _ = self._wall_frame(side)
        h, t, r = self.size[2], self.wall, self.recess
        # Wall frame: x along the wall, y into the room, the wall's face at y = 0.
        wall = Piece(self.rng, self.materials)
        wall.box((-r - t, -r - t, 0), (length + r + t, -r, h), paint)
        at = -r
        self.recesses[side] = self._draw_recesses(length, h, has_door=side == 0)
        for recess in self.recesses[side]:
            (u0, u1), (z0, z1) = recess.u, recess.z
            wall.box((at, -r, 0), (u0, 0, h), paint)
            if z0 > 0:
                wall.box((u0, -r, 0), (u1, 0, z0), paint)
            if z1 < h:
                wall.box((u0, -r, z1), (u1, 0, h), paint)
            self._fill_recess(wall, recess)
            at = u1
            if recess.kind == "door":
                self._take(self._to_room(side, np.array([[u0, 0.0], [u1, 0.8]])))
        wall.box((at, -r, 0), (length + r, 0, h), paint)
        skirting = wall.paint("stripes", contrast=0.1)
        if self.rng.uniform() < 0.6:
            doors = [recess.u for recess in self.recesses[side] if recess.kind == "door"]
            edges = [0.0, *[u for door in doors for u in door], length]
            for left, right in zip(edges[::2], edges[1::2], strict=True):
                wall.box((left, -0.02, 0), (right, 0.02, self.rng.uniform(0.06, 0.12)), skirting)
        self.solids += _moved(wall.solids, yaw, np.array([*start, 0.0]))

    def _draw_recesses(self, length: float, height: float, *, has_door: bool) -> list[_Recess]:
        kinds = ["door"] if has_door else []
        kinds += list(self.rng.choice(["window", "niche", "niche"], size=self.rng.integers(0, 3)))
        self.rng.shuffle(kinds)
        slots = np.linspace(0.25, length - 0.25, len(kinds) + 1)
        recesses = []
        for kind, left, right in zip(kinds, slots[:-1], slots[1:], strict=True):
            low, high = {"door": (0.85, 1.1), "window": (0.7, 1.8), "niche": (0.4, 1.4)}[kind]
            width = min(self.rng.uniform(low, high), right - left - 0.2)
            u0 = self.rng.uniform(left + 0.1, max(left + 0.1, right - 0.1 - width))
            if kind == "door":
                z = (0.0, self.rng.uniform(2.0, 2.15))
            elif kind == "window":
                z = (self.rng.uniform(0.8, 1.0), self.rng.uniform(1.9, height - 0.2))
            else:
                z = (self.rng.uniform(0.5, 1.1), self.rng.uniform(1.4, height - 0.25))
            recesses.append(_Recess(kind, (u0, u0 + width), z))
        return recesses

    def _fill_recess(self, wall: Piece, recess: _Recess) -> None:
        (u0, u1), (z0, z1), r = recess.u, recess.z, self.recess
        if recess.kind == "door":
            leaf = wall.paint("wood", "checker")
            wall.box((u0, -r, 0), (u1, -r + 0.05, z1), leaf)
            for low, high in ((0.15, 0.9), (1.05, z1 - 0.15)):
                wall.box((u0 + 0.12, -r, low), (u1 - 0.12, -r + 0.07, high), leaf)
            wall.box((u1 - 0.1, -r, 0.98), (u1 - 0.06, -r + 0.1, 1.02), wall.paint("stripes"))
        elif recess.kind == "window":
            frame, glass = (
                wall.paint("stripes", contrast=0.15),
                wall.paint("blotches", color=np.array([0.6, 0.75, 0.9])),
            )
            wall.box((u0, -r - 0.01, z0), (u1, -r + 0.02, z1), glass)
            for u in (u0 + 0.025, (u0 + u1) / 2, u1 - 0.025):
                wall.box((u - 0.025, -r, z0), (u + 0.025, -r + 0.05, z1), frame)
            for z in (z0 + 0.025, (z0 + z1) / 2, z1 - 0.025):
                wall.box((u0, -r, z - 0.025), (u1, -r + 0.05, z + 0.025), frame)
            wall.box((u0 - 0.05, -r, z0 - 0.03), (u1 + 0.05, 0.06, z0), frame)
        elif r > 0.12:
            wall.things_on((u0, -r), (u1, 0), z0, int(self.rng.integers(1, 4)), tall=z1 - z0 - 0.05)

    def _add_corner_block(self, room: Piece) -> None:
        """A full-height block in a corner makes the room L-shaped."""
        w, d, h = self.size
        bw, bd = w * self.rng.uniform(0.2, 0.42), d * self.rng.uniform(0.2, 0.42)
        corner = self.rng.integers(2, 4)  # the two corners away from the door wall
        low = np.array([w - bw if corner == 2 else 0.0, d - bd])
        high = low + [bw, bd]
        grow = self.recess  # fills the recesses behind it
        x0, x1 = (low[0], high[0] + grow) if corner == 2 else (low[0] - grow, high[0])
        room.box((x0, low[1], 0), (x1, high[1] + grow, h), room.paint(contrast=0.22, scale=(0.3, 0.7)))
        self._take(np.concatenate([low, high]))

    def _furnish(self) -> None:
        w, d, h = self.size
        area = w * d
        if self.rng.uniform() < 0.5:
            rug = Piece(self.rng, self.materials)
            half = self.rng.uniform(0.5, 0.25 * min(w, d) + 0.3, size=2)
            rug.box((*-half, 0), (*half, 0.02), rug.paint(contrast=0.5), yaw=self.rng.uniform(0, np.pi))
            self.solids += _moved(rug.solids, 0.0, np.array([w / 2, d / 2, 0.0]))
        for _ in range(int(area / 4.5) + 3):
            self._place(_choose(self.rng, AGAINST_WALL), self._draw_wall_pose)
        for _ in range(int(area / 5.0) + 2):
            self._place(_choose(self.rng, FREE_STANDING), self._draw_free_pose)
        self._hang_pictures()
        self._hang_lamps()

    def _place(self, builder: PieceBuilder, draw_pose: DrawPose) -> None:
        piece = Piece(self.rng, self.materials)
        builder(piece)
        boxes = np.stack([solid.bounds for solid in piece.solids])
        low, high = boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)
        for _ in range(25):
            yaw, position = draw_pose(low, high)
            corners = np.array([[x, y] for x in (low[0], high[0]) for y in (low[1], high[1])])
            corners = corners @ yaw_rotation(yaw)[:2, :2].T + position
            print_ = np.concatenate([corners.min(axis=0), corners.max(axis=0)])
            if self._is_free(print_):
                self._take(print_)
                self.solids += _moved(piece.solids, yaw, np.array([*position, 0.0]))
                return

    def _draw_wall_pose(self, low: np.ndarray, high: np.ndarray) -> tuple[float, np.ndarray]:
        side = int(self.rng.integers(4))
        length, yaw, start, along = self._wall_frame(side)
        inward = np.array([-along[1], along[0]])
        u = self.rng.uniform(high[0], max(high[0], length + low[0]))
        jitter = self.rng.normal(scale=0.04) if self.rng.uniform() < 0.6 else 0.0
        gap = self.rng.uniform(0.03, 0.08) + abs(np.sin(jitter)) * (high[0] - low[0]) / 2
        return yaw + jitter, start + along * u + inward * (gap - low[1])

    def _draw_free_pose(self, low: np.ndarray, high: np.ndarray) -> tuple[float, np.ndarray]:
        return float(self.rng.uniform(0, 2 * np.pi)), self.rng.uniform([0.2, 0.2], self.size[:2] - 0.2)

    def _is_free(self, footprint: np.ndarray) -> bool:
        if (footprint[:2] < 0.02).any() or (footprint[2:] > self.size[:2] - 0.02).any():
            return False
        return not any(
            (footprint[:2] < other[2:] + 0.04).all() and (other[:2] - 0.04 < footprint[2:]).all()
            for other in self.taken
        )

    def _take(self, footprint: np.ndarray) -> None:
        self.taken.append(np.asarray(footprint, dtype=float))

    def _to_room(self, side: int, corners: np.ndarray) -> np.ndarray:
        """Footprint of a rectangle given by two corners (2, 2) in a wall's frame."""
        _, yaw, start, _ = self._wall_frame(side)
        corners = corners @ yaw_rotation(yaw)[:2, :2].T + start
        return np.concatenate([corners.min(axis=0), corners.max(axis=0)])

    def _hang_pictures(self) -> None:
        for side in range(4):
            length, yaw, start, _ = self._wall_frame(side)
            for _ in range(self.rng.integers(1, 4)):
                piece = Piece(self.rng, self.materials)
                w, h = piece.uniform(0.15, 0.45), piece.uniform(0.15, 0.35)
                u = piece.uniform(0.3 + w, length - 0.3 - w)
                z = piece.uniform(1.45, max(1.5, self.size[2] - h - 0.2))
                if any(r.u[0] < u + w and u - w < r.u[1] and r.z[1] > z - h for r in self.recesses[side]):
                    continue
                piece.box((u - w, -0.01, z - h), (u + w, 0.025, z + h), piece.paint("wood", color=np.full(3, 0.3)))
                inner = piece.paint(contrast=0.7, scale=(0.15, 0.3))
                piece.box((u - w + 0.04, 0, z - h + 0.04), (u + w - 0.04, 0.035, z + h - 0.04), inner)
                self.solids += _moved(piece.solids, yaw, np.array([*start, 0.0]))

    def _hang_lamps(self) -> None:
        for _ in range(self.rng.integers(0, 3)):
            piece = Piece(self.rng, self.materials)
            x, y = self.rng.uniform(0.25, 0.75, size=2) * self.size[:2]
            drop, r, height = piece.uniform(0.1, 0.4), piece.uniform(0.12, 0.25), self.size[2]
            piece.frustum((x, y, height - drop), 0.012, drop, piece.paint("stripes"))
            shade = piece.paint(contrast=0.3)
            if piece.uniform(0, 1) < 0.5:
                piece.ellipsoid((x, y, height - drop - 0.6 * r), (r, r, 0.7 * r), shade)
            else:
                piece.frustum((x, y, height - drop - r), r, 1.1 * r, shade, taper=0.4)
            self.solids += piece.solids


def _choose(rng: np.random.Generator, weighted: dict[PieceBuilder, float]) -> PieceBuilder:
    weights = np.array(list(weighted.values()))
    return list(weighted)[rng.choice(len(weights), p=weights / weights.sum())]


def _moved(solids: list[Solid], yaw: float, position: np.ndarray) -> list[Solid]:
    turn = yaw_rotation(yaw)
    return [Solid(s.kind, turn @ s.center + position, turn @ s.rotation, s.half, s.material, s.taper) for s in solids]
