"""Parametric furniture: each piece is a list of solids in its own frame.

Frame of a piece: origin on the floor in the middle of its footprint, x to the side, y to its front, z up [m].
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from warpslam.synthetic.solids import Solid, yaw_rotation
from warpslam.synthetic.textures import Material, random_material


@dataclass
class Piece:
    """A piece of furniture under construction."""

    rng: np.random.Generator
    """Source of all random choices."""
    materials: list[Material]
    """Materials of the whole room; new ones are appended."""
    solids: list[Solid] = field(default_factory=list)
    """Parts in the frame of the piece."""

    def paint(self, *patterns: str, **options: Any) -> int:
        """Add a random material and return its index (options of `random_material`)."""
        if patterns:
            options["patterns"] = patterns
        self.materials.append(random_material(self.rng, **options))
        return len(self.materials) - 1

    def uniform(self, low: float, high: float) -> float:
        """Draw one number."""
        return float(self.rng.uniform(low, high))

    def box(self, low: ArrayLike, high: ArrayLike, material: int, *, yaw: float = 0.0, tilt: float = 0.0) -> None:
        """Box between two corners [m], turned about its centre."""
        low, high = np.asarray(low, float), np.asarray(high, float)
        self._add("box", (low + high) / 2, (high - low) / 2, material, yaw, tilt)

    def frustum(
        self,
        base: ArrayLike,
        radius: ArrayLike,
        height: float,
        material: int,
        *,
        taper: float = 1.0,
        yaw: float = 0.0,
        tilt: float = 0.0,
    ) -> None:
        """Upright frustum: ``base`` is the centre of its lower disc, ``radius`` one number or (x, y) [m]."""
        rx, ry = np.broadcast_to(radius, 2)
        center = np.asarray(base, float) + [0, 0, height / 2]
        self._add("frustum", center, np.array([rx, ry, height / 2]), material, yaw, tilt, taper)

    def ellipsoid(
        self, center: ArrayLike, half: ArrayLike, material: int, *, yaw: float = 0.0, tilt: float = 0.0
    ) -> None:
        """Ellipsoid; ``half`` is one radius or three [m]."""
        self._add("ellipsoid", np.asarray(center, float), np.broadcast_to(half, 3).astype(float), material, yaw, tilt)

    def _add(
        self,
        kind: str,
        center: np.ndarray,
        half: np.ndarray,
        material: int,
        yaw: float,
        tilt: float,
        taper: float = 1.0,
    ) -> None:
        self.solids.append(Solid(kind, center, yaw_rotation(yaw, tilt), np.asarray(half, float), material, taper))

    def things_on(self, low: ArrayLike, high: ArrayLike, z: float, count: int, *, tall: float = 0.3) -> None:
        """Stand up to ``count`` small objects on the rectangle ``low``-``high`` (x, y) [m] at height ``z``."""
        low, high = np.asarray(low, float), np.asarray(high, float)
        taken: list[np.ndarray] = []
        for _ in range(4 * count):
            if len(taken) == count:
                return
            size = self.uniform(0.04, max(0.05, min(0.12, 0.45 * (high - low).min())))
            if ((high - low) < 2 * size).any():
                continue
            x, y = self.rng.uniform(low + size, high - size)
            if any(np.hypot(x - t[0], y - t[1]) < size + t[2] for t in taken):
                continue
            taken.append(np.array([x, y, size]))
            self._thing(x, y, z, size, self.uniform(0.3, 1.0) * tall)

    def _thing(self, x: float, y: float, z: float, size: float, height: float) -> None:
        height = max(height, 0.04)
        material = self.paint(contrast=0.5, scale=(0.12, 0.25))
        match self.rng.integers(6):
            case 0:  # box
                w, d = size * self.rng.uniform(0.4, 0.7, size=2)
                self.box((x - w, y - d, z), (x + w, y + d, z + height), material, yaw=self.uniform(0, 3.1))
            case 1:  # mug or tin
                self.frustum((x, y, z), 0.7 * size, height, material)
            case 2:  # vase
                self.frustum((x, y, z), 0.45 * size, height / 2, material, taper=1.9)
                self.frustum((x, y, z + height / 2), 0.85 * size, height / 2, material, taper=0.4)
            case 3:  # ball
                self.ellipsoid((x, y, z + 0.8 * size), 0.8 * size, material)
            case 4:  # cone
                self.frustum((x, y, z), 0.8 * size, height, material, taper=0.12)
            case _:  # stack of books
                top = z
                for _ in range(self.rng.integers(1, 4)):
                    w, d = size * self.rng.uniform(0.5, 0.7, size=2)
                    thick = self.uniform(0.02, 0.05)
                    paint = self.paint(contrast=0.4, scale=(0.12, 0.25))
                    self.box((x - w, y - d, top), (x + w, y + d, top + thick), paint, yaw=self.uniform(-0.4, 0.4))
                    top += thick


def table(p: Piece) -> None:
    """Rectangular or round table with things on it."""
    height, thick = p.uniform(0.45, 0.78), p.uniform(0.025, 0.06)
    top, legs = p.paint("wood", "checker", "blotches"), p.paint("wood", "stripes")
    if p.rng.uniform() < 0.35:
        r = p.uniform(0.35, 0.65)
        p.frustum((0, 0, height - thick), r, thick, top)
        p.frustum((0, 0, 0), 0.6 * r, 0.04, legs)
        p.frustum((0, 0, 0.04), p.uniform(0.04, 0.08), height - thick - 0.04, legs)
        p.things_on((-0.6 * r, -0.6 * r), (0.6 * r, 0.6 * r), height, int(p.rng.integers(2, 5)))
        return
    w, d = p.uniform(0.4, 0.9), p.uniform(0.3, 0.5)
    p.box((-w, -d, height - thick), (w, d, height), top)
    leg, inset = p.uniform(0.015, 0.04), p.uniform(0.03, 0.08)
    round_legs = p.rng.uniform() < 0.5
    for x in (-w + inset + leg, w - inset - leg):
        for y in (-d + inset + leg, d - inset - leg):
            if round_legs:
                p.frustum((x, y, 0), leg * 0.8, height - thick, legs, taper=1.4)
            else:
                p.box((x - leg, y - leg, 0), (x + leg, y + leg, height - thick), legs)
    p.things_on((-w, -d), (w, d), height, int(p.rng.integers(2, 7)))


def chair(p: Piece) -> None:
    """Four legs, a seat and a tilted back."""
    w, d, seat = p.uniform(0.19, 0.25), p.uniform(0.19, 0.25), p.uniform(0.42, 0.5)
    frame, cloth = p.paint("wood", "stripes"), p.paint(contrast=0.45)
    for x in (-w + 0.02, w - 0.02):
        for y in (-d + 0.02, d - 0.02):
            p.frustum((x, y, 0), 0.014, seat - 0.04, frame, taper=1.4)
    p.box((-w, -d, seat - 0.04), (w, d, seat), cloth)
    back, tilt = p.uniform(0.35, 0.55), p.uniform(0.02, 0.15)
    y = -d + 0.02 - 0.5 * back * np.sin(tilt)
    if p.rng.uniform() < 0.5:
        p.box((-w, y - 0.015, seat - 0.02), (w, y + 0.015, seat + back), cloth, tilt=tilt)
    else:
        for x in np.linspace(-w + 0.02, w - 0.02, 4):
            p.box((x - 0.015, y - 0.012, seat - 0.02), (x + 0.015, y + 0.012, seat + back), frame, tilt=tilt)
        y_top = y - 0.5 * back * np.sin(tilt)
        p.box((-w, y_top - 0.015, seat + back - 0.08), (w, y_top + 0.015, seat + back), cloth, tilt=tilt)


def sofa(p: Piece) -> None:
    """Seat, back, arms and cushions."""
    w, d, arm = p.uniform(0.6, 1.1), p.uniform(0.38, 0.48), p.uniform(0.1, 0.2)
    seat, back = p.uniform(0.36, 0.45), p.uniform(0.7, 0.95)
    cloth = p.paint(contrast=0.25)
    p.box((-w, -d, 0.05), (w, d, seat - 0.12), cloth)
    p.box((-w, -d, 0.05), (w, -d + 0.2, back), cloth)
    for x in (-w, w - arm):
        p.box((x, -d, 0.05), (x + arm, d, seat + 0.18), cloth)
        p.frustum((x + arm / 2, d - 0.06, 0), 0.03, 0.05, cloth)
    seats = int(p.rng.integers(2, 4))
    edges = np.linspace(-w + arm, w - arm, seats + 1)
    for left, right in zip(edges[:-1], edges[1:], strict=True):
        cushion = p.paint(contrast=0.4)
        p.box((left + 0.01, -d + 0.2, seat - 0.12), (right - 0.01, d + 0.02, seat), cushion)
        if p.rng.uniform() < 0.6:
            x = (left + right) / 2
            p.ellipsoid((x, -d + 0.3, seat + 0.17), (0.22, 0.09, 0.2), p.paint(contrast=0.5), tilt=-0.25)


def shelf(p: Piece) -> None:
    """Open shelf with books, boxes and vases."""
    w, d, height = p.uniform(0.3, 0.75), p.uniform(0.14, 0.2), p.uniform(0.8, 2.1)
    t = p.uniform(0.02, 0.035)
    wood = p.paint("wood", "blotches")
    for x in (-w, w - t):
        p.box((x, -d, 0), (x + t, d, height), wood)
    p.box((-w + t, -d, 0), (w - t, -d + 0.02, height), p.paint("stripes", "checker", "blotches"))
    boards = np.linspace(0.04, height - t, max(3, int(height / 0.36)))
    for z, above in zip(boards, [*boards[1:], None], strict=True):
        p.box((-w + t, -d + 0.02, z), (w - t, d, z + t), wood)
        room = 0.35 if above is None else above - z - t - 0.02
        if room < 0.12:
            continue
        if above is not None and p.rng.uniform() < 0.6:
            _book_row(p, -w + t, w - t, -d + 0.02, d - 0.01, z + t, room)
        else:
            p.things_on((-w + t, -d + 0.03), (w - t, d), z + t, int(p.rng.integers(1, 5)), tall=room)


def _book_row(p: Piece, left: float, right: float, back: float, front: float, z: float, room: float) -> None:
    x = left + p.uniform(0.0, 0.1)
    while x < right - 0.06:
        if p.rng.uniform() < 0.12:
            x += p.uniform(0.05, 0.2)
            continue
        thick = p.uniform(0.025, 0.06)
        height, depth = room * p.uniform(0.6, 0.98), (front - back) * p.uniform(0.6, 0.95)
        p.box((x, back, z), (x + thick, back + depth, z + height), p.paint(contrast=0.4, scale=(0.12, 0.2)))
        x += thick


def bed(p: Piece) -> None:
    """Frame, mattress, blanket, pillows and headboard (at the back)."""
    w, d, height = p.uniform(0.45, 0.9), p.uniform(0.95, 1.05), p.uniform(0.35, 0.5)
    wood, sheet, blanket = p.paint("wood"), p.paint("stripes", contrast=0.15), p.paint(contrast=0.5)
    p.box((-w, -d, 0.1), (w, d, height - 0.18), wood)
    for x in (-w + 0.06, w - 0.06):
        for y in (-d + 0.06, d - 0.06):
            p.frustum((x, y, 0), 0.04, 0.1, wood)
    p.box((-w, -d - 0.05, 0), (w, -d, height + p.uniform(0.3, 0.7)), wood)
    p.box((-w + 0.03, -d, height - 0.18), (w - 0.03, d - 0.03, height), sheet)
    p.box((-w + 0.005, -d + 0.65, height - 0.2), (w - 0.005, d - 0.005, height + 0.04), blanket)
    for x in (-w / 2, w / 2) if w > 0.6 else (0.0,):
        p.ellipsoid((x, -d + 0.27, height + 0.05), (0.3, 0.2, 0.08), p.paint(contrast=0.3), yaw=p.uniform(-0.2, 0.2))


def floor_lamp(p: Piece) -> None:
    """Foot, pole and tapered shade."""
    height = p.uniform(1.2, 1.7)
    metal = p.paint("stripes", contrast=0.2)
    p.frustum((0, 0, 0), 0.14, 0.03, metal)
    p.frustum((0, 0, 0.03), 0.015, height, metal)
    p.frustum((0, 0, height - 0.05), p.uniform(0.15, 0.22), 0.26, p.paint(contrast=0.3), taper=p.uniform(0.4, 0.8))


def cabinet(p: Piece) -> None:
    """Box with doors or drawers that stand proud, handles, and things on top."""
    w, d, height = p.uniform(0.3, 0.9), p.uniform(0.2, 0.3), p.uniform(0.5, 2.0)
    body, door, metal = p.paint("wood"), p.paint("wood", "checker", "blotches"), p.paint("stripes")
    p.box((-w, -d, 0.06), (w, d, height), body)
    p.box((-w + 0.04, -d + 0.04, 0), (w - 0.04, d - 0.05, 0.06), metal)
    columns, rows = max(1, round(2 * w / 0.45)), max(1, round(height / p.uniform(0.3, 0.9)))
    xs, zs = np.linspace(-w, w, columns + 1), np.linspace(0.06, height, rows + 1)
    for left, right in zip(xs[:-1], xs[1:], strict=True):
        for low, high in zip(zs[:-1], zs[1:], strict=True):
            p.box((left + 0.012, d, low + 0.012), (right - 0.012, d + 0.022, high - 0.012), door)
            x, z = (left + right) / 2, (low + high) / 2
            p.box((x - 0.06, d + 0.022, z - 0.012), (x + 0.06, d + 0.05, z + 0.012), metal)
    if height < 1.5:
        p.things_on((-w, -d), (w, d), height, int(p.rng.integers(1, 5)), tall=0.4)


def plant(p: Piece) -> None:
    """Pot, stem and leaves."""
    r, pot = p.uniform(0.1, 0.2), p.uniform(0.2, 0.4)
    p.frustum((0, 0, 0), 0.75 * r, pot, p.paint("stripes", "bricks", "checker"), taper=1.35)
    height = pot + p.uniform(0.3, 0.9)
    p.frustum((0, 0, pot), 0.02, height - pot, p.paint("stripes", color=np.array([0.35, 0.25, 0.12])), taper=0.7)
    for _ in range(p.rng.integers(4, 9)):
        green = p.paint("blotches", color=np.array([p.uniform(0.1, 0.35), p.uniform(0.4, 0.7), p.uniform(0.1, 0.3)]))
        angle, reach, z = p.uniform(0, 2 * np.pi), p.uniform(0.05, 0.18), p.uniform(pot + 0.1, height)
        half = (p.uniform(0.08, 0.17), p.uniform(0.08, 0.17), p.uniform(0.04, 0.15))
        p.ellipsoid(
            (reach * np.cos(angle), reach * np.sin(angle), z), half, green, yaw=angle, tilt=p.uniform(-0.5, 0.5)
        )


def desk(p: Piece) -> None:
    """Desk with a monitor, a keyboard and a drawer block."""
    w, d, height = p.uniform(0.5, 0.8), p.uniform(0.28, 0.38), p.uniform(0.7, 0.76)
    wood, dark = p.paint("wood", "blotches"), p.paint("checker", color=np.array([0.2, 0.22, 0.25]))
    p.box((-w, -d, height - 0.03), (w, d, height), wood)
    p.box((-w, -d, 0), (-w + 0.03, d, height - 0.03), wood)
    p.box((w - 0.38, -d, 0.05), (w, d - 0.02, height - 0.03), p.paint())
    p.box((-0.25, -d + 0.08, height + 0.1), (0.25, -d + 0.11, height + 0.45), dark, yaw=p.uniform(-0.2, 0.2))
    p.frustum((0, -d + 0.08, height + 0.02), 0.02, 0.2, dark)
    p.frustum((0, -d + 0.1, height), 0.1, 0.02, dark)
    p.box((-0.22, d - 0.25, height), (0.22, d - 0.1, height + 0.025), dark)
    p.things_on((0.3, -d), (w, d), height, 2, tall=0.25)
    p.things_on((-w, -d), (-0.3, d), height, 2, tall=0.25)


def box_stack(p: Piece) -> None:
    """One to three turned boxes on top of each other."""
    z, size = 0.0, p.uniform(0.18, 0.32)
    for _ in range(p.rng.integers(1, 4)):
        w, d = size * p.rng.uniform(0.7, 1.0, size=2)
        height = p.uniform(0.15, 0.4)
        p.box((-w, -d, z), (w, d, z + height), p.paint(contrast=0.4), yaw=p.uniform(0, 3.1))
        z, size = z + height, 0.8 * size


def primitive(p: Piece) -> None:
    """A ball, a cone, a drum or a stool."""
    r = p.uniform(0.12, 0.28)
    material = p.paint(contrast=0.5)
    match p.rng.integers(4):
        case 0:
            p.ellipsoid((0, 0, r), r, material)
        case 1:
            p.frustum((0, 0, 0), r, p.uniform(0.3, 0.9), material, taper=p.uniform(0.1, 0.5))
        case 2:
            p.frustum((0, 0, 0), (r, r * p.uniform(0.6, 1.0)), p.uniform(0.3, 0.7), material)
        case _:
            p.frustum((0, 0, 0.4), r, 0.05, material)
            for angle in (0.3, 2.4, 4.5):
                p.frustum((0.6 * r * np.cos(angle), 0.6 * r * np.sin(angle), 0), 0.015, 0.4, material, taper=1.5)


PieceBuilder = Callable[[Piece], None]

AGAINST_WALL: dict[PieceBuilder, float] = {sofa: 1.2, shelf: 2.0, bed: 1.0, cabinet: 1.6, desk: 1.2, floor_lamp: 0.6}
FREE_STANDING: dict[PieceBuilder, float] = {table: 1.6, chair: 2.0, plant: 0.8, box_stack: 1.0, primitive: 1.2}
