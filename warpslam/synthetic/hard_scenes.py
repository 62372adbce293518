"""Scenes that are hard to track through, with exact truth.

corridor  white tiles with thin joints, alike all along: colour repeats, depth slides along the walls
cabinet   a box on a floor, both of one colour with slow shading: depth alone tells, and little of it
posters   a flat wall with posters: colour alone tells
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from warpslam.camera import Intrinsics
from warpslam.errors import ConfigError
from warpslam.synthetic.camera_path import look_at
from warpslam.synthetic.render import AntialiasedRenderer
from warpslam.synthetic.sequence import DEFAULT_INTRINSICS, RenderedSequence
from warpslam.synthetic.textures import Material, random_material, value_noise

if TYPE_CHECKING:
    import trimesh

HARD_SCENES = ("corridor", "cabinet", "posters")

STEP = 0.14  # [m] per frame, in the corridor and around the cabinet
TURN = np.radians(7.0)  # per frame around the cabinet
CORRIDOR_LENGTH, CORRIDOR_WIDTH, CORRIDOR_HEIGHT = 22.0, 1.6, 2.6  # [m]
WALK_LENGTH = 20.0  # [m]
TILE, JOINT = 0.3, 0.004  # [m]
POSTER_STEP = 0.08  # [m] per frame

Color = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Colours in [0, 1], shape (N, 3), at places (u, v) [m] of a sheet, each of shape (N,)."""


class HardScene(RenderedSequence):
    """One of `HARD_SCENES`.

    mesh: The surface that is rendered.
    """

    def __init__(
        self,
        kind: str,
        frame_count: int | None = None,
        *,
        seed: int = 0,
        intrinsics: Intrinsics = DEFAULT_INTRINSICS,
        device: str | None = None,
        noise: bool = False,
        exposure: float = 0.0,
    ) -> None:
        """Build the scene and its path; frames are rendered on demand.

        Args:
            kind: One of `HARD_SCENES`.
            frame_count: Frames from the start of the path; all of it if None.
            seed: Of shading, posters and sway.
            intrinsics: Camera.
            device: Warp device that renders, None = Warp's default one.
            noise: Whether depth carries sensor noise.
            exposure: As of `RenderedSequence`.

        Raises:
            ConfigError: There is no such scene.
        """
        if kind not in HARD_SCENES:
            raise ConfigError(f"kind = {kind!r} of hard scene is unknown; choose one of {', '.join(HARD_SCENES)}")
        rng = np.random.default_rng([seed, HARD_SCENES.index(kind)])
        build = {"corridor": _corridor, "cabinet": _cabinet, "posters": _posters}[kind]
        self.mesh, poses = build(rng)
        super().__init__(
            f"{kind}_{seed}",
            AntialiasedRenderer(self.mesh, intrinsics, device=device),
            poses[:frame_count],
            noise_seed=seed if noise else None,
            exposure=exposure,
            depth_range=5.0,  # beyond is missing, as with most sensors: else the far end of a corridor fixes all
        )


def sheet(
    origin: ArrayLike, along: np.ndarray, up: np.ndarray, u_edges: np.ndarray, v_edges: np.ndarray, color: Color
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A flat piece of a surface, cut into cells with colours of their own.

    Args:
        origin: Corner (u, v) = 0 [m], shape (3,).
        along: Unit direction of u, shape (3,).
        up: Unit direction of v, shape (3,); ``along x up`` points to the side that is seen.
        u_edges: Ascending cell borders along u [m].
        v_edges: Ascending cell borders along v [m].
        color: Colour of a place, taken at each cell's corners, just inside: a step at a border is sharp.

    Returns:
        Vertices [m], float64, shape (4 N, 3); faces, int, shape (2 N, 3); colours, uint8, shape (4 N, 3).
    """
    u0, v0 = (side.ravel() for side in np.meshgrid(u_edges[:-1], v_edges[:-1], indexing="ij"))
    u1, v1 = (side.ravel() for side in np.meshgrid(u_edges[1:], v_edges[1:], indexing="ij"))
    u, v = np.stack([u0, u1, u1, u0], axis=1), np.stack([v0, v0, v1, v1], axis=1)
    vertices = np.asarray(origin) + u.reshape(-1, 1) * np.asarray(along) + v.reshape(-1, 1) * np.asarray(up)
    inner = [0.99 * side + 0.01 * side.mean(axis=1, keepdims=True) for side in (u, v)]
    colors = color(inner[0].ravel(), inner[1].ravel())
    first = 4 * np.arange(len(u0))[:, None]
    faces = np.concatenate([first + [0, 1, 2], first + [0, 2, 3]])
    return vertices, faces, np.rint(255 * np.clip(colors, 0.0, 1.0)).astype(np.uint8)


def _joined(sheets: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> trimesh.Trimesh:
    import trimesh  # takes a second, and the list of scenes needs none of it

    vertices, faces, colors = zip(*sheets, strict=True)
    offsets = np.cumsum([0] + [len(part) for part in vertices[:-1]])
    joined = np.concatenate([part + offset for part, offset in zip(faces, offsets, strict=True)])
    return trimesh.Trimesh(np.concatenate(vertices), joined, vertex_colors=np.concatenate(colors), process=False)


def _shading(rng: np.random.Generator, size: float, depth: float) -> Color:
    """A factor from 1 - ``depth`` to 1 that changes over about ``size`` metres, as light from lamps does."""
    shift = rng.uniform(0.0, 100.0, size=3)

    def factor(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        points = np.column_stack([u, v, np.zeros(len(u))]) / size + shift
        return (1.0 - depth * value_noise(points))[:, None]

    return factor


def _plain(rng: np.random.Generator, color: tuple[float, float, float], size: float, depth: float) -> Color:
    shade = _shading(rng, size, depth)
    return lambda u, v: np.array(color) * shade(u, v)


def _picture(material: Material, corner: np.ndarray) -> Color:
    return lambda u, v: material.color_at(corner + np.column_stack([u, np.zeros(len(u)), v]))


def _even(length: float, spacing: float) -> np.ndarray:
    return np.linspace(0.0, length, max(1, round(length / spacing)) + 1)


def _tiled(length: float, size: float) -> np.ndarray:
    """Borders of tiles and joints: a joint around each multiple of ``size``."""
    lines = np.arange(size, length - JOINT, size)
    return np.sort(np.concatenate([[0.0, length], lines - JOINT / 2, lines + JOINT / 2]))


def _tiles(rng: np.random.Generator, color: tuple[float, float, float], size: float) -> Color:
    shade = _shading(rng, 1.8, 0.35)

    def colors(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        to_line = np.minimum(*(np.abs(side - size * np.round(side / size)) for side in (u, v)))
        return np.where(to_line[:, None] < JOINT / 2, 0.55, 1.0) * np.array(color) * shade(u, v)

    return colors


def _box(
    rng: np.random.Generator, low: ArrayLike, high: ArrayLike, color: tuple[float, float, float], shading: float
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """The faces of an upright box but for its bottom."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    x, y, z = np.eye(3)
    w, d, h = high - low
    faces = [
        (low, x, z, w, h),
        (low + d * y + w * x, -x, z, w, h),
        (low + w * x, y, z, d, h),
        (low + d * y, -y, z, d, h),
        (low + h * z, x, y, w, d),
    ]
    sheets = []
    for origin, along, up, u_length, v_length in faces:
        tint = tuple(np.array(color) * rng.uniform(0.85, 1.0))
        cells = _even(u_length, 0.05), _even(v_length, 0.05)
        sheets.append(sheet(origin, along, up, *cells, _plain(rng, tint, 0.5, shading)))
    return sheets


def _corridor(rng: np.random.Generator) -> tuple[trimesh.Trimesh, np.ndarray]:
    """Along x from 0, the middle at y = 0; doors at irregular places, and a plain end wall at either end."""
    x, y, z = np.eye(3)
    half, white = CORRIDOR_WIDTH / 2, (0.93, 0.93, 0.91)
    columns, rows = _tiled(CORRIDOR_LENGTH, TILE), _tiled(CORRIDOR_HEIGHT, TILE)
    floor_lines = _tiled(CORRIDOR_LENGTH, 0.6), _tiled(CORRIDOR_WIDTH, 0.6)
    plain = _even(CORRIDOR_LENGTH, 0.1), _even(CORRIDOR_WIDTH, 0.1)
    end = _even(CORRIDOR_WIDTH, 0.1), _even(CORRIDOR_HEIGHT, 0.1)
    right, left = np.array([0.0, -half, 0.0]), np.array([CORRIDOR_LENGTH, half, 0.0])
    sheets = [
        sheet(right, x, z, columns, rows, _tiles(rng, white, TILE)),
        sheet(left, -x, z, columns, rows, _tiles(rng, white, TILE)),
        sheet(right, x, y, *floor_lines, _tiles(rng, (0.45, 0.44, 0.42), 0.6)),
        sheet(left + CORRIDOR_HEIGHT * z, -x, -y, *plain, _plain(rng, (0.85, 0.85, 0.85), 2.0, 0.2)),
        sheet([0.0, half, 0.0], -y, z, *end, _plain(rng, (0.8, 0.8, 0.78), 1.0, 0.2)),
        sheet([CORRIDOR_LENGTH, -half, 0.0], y, z, *end, _plain(rng, (0.8, 0.8, 0.78), 1.0, 0.2)),
    ]
    for number, place in enumerate(np.arange(2.5, CORRIDOR_LENGTH - 2.0, 4.5) + rng.uniform(-1.0, 1.0, size=4)):
        side = 1.0 if number % 2 else -1.0
        low, high = sorted((side * half, side * (half - 0.03)))
        brown = (0.5, 0.36, 0.25)
        sheets += _box(rng, [place, low, 0.0], [place + 0.9, high, 2.05], brown, 0.15)
        low, high = sorted((side * (half - 0.03), side * (half - 0.09)))
        sheets += _box(rng, [place + 0.78, low, 1.0], [place + 0.84, high, 1.03], (0.3, 0.3, 0.3), 0.1)
    frame_count = round(WALK_LENGTH / STEP) + 1
    along = STEP * np.arange(frame_count)
    phase = rng.uniform(0.0, 2 * np.pi, size=3)
    # 0.45 to 0.8 m from the nearer wall, looking from the one to the other and ahead between.
    aside = 0.35 * np.sin(2 * np.pi * along / 7.0 + phase[0])
    height = 1.45 + 0.03 * np.sin(2 * np.pi * along / 1.4 + phase[1])
    yaw = np.radians(55.0) * np.sin(2 * np.pi * along / 11.0 + phase[2])
    # Swaying adds to the way along the corridor: take it out of the steps.
    steps = np.sqrt(np.maximum(STEP**2 - np.diff(aside) ** 2 - np.diff(height) ** 2, 0.0))
    eyes = np.column_stack([0.8 + np.concatenate([[0.0], np.cumsum(steps)]), aside, height])
    ahead = np.column_stack([np.cos(yaw), np.sin(yaw), np.full(frame_count, -0.12)])
    return _joined(sheets), np.stack([look_at(eye, eye + way) for eye, way in zip(eyes, ahead, strict=True)])


def _cabinet(rng: np.random.Generator) -> tuple[trimesh.Trimesh, np.ndarray]:
    """In the middle of a floor, looked at from a circle that closes and goes on for six frames."""
    x, y, _ = np.eye(3)
    floor = sheet([-8.0, -8.0, 0.0], x, y, *(2 * (_even(16.0, 0.2),)), _plain(rng, (0.55, 0.53, 0.5), 1.6, 0.2))
    body = _box(rng, [-0.45, -0.23, 0.0], [0.45, 0.23, 0.95], (0.78, 0.74, 0.68), 0.12)
    frame_count = round(2 * np.pi / TURN) + 7
    angle = TURN * np.arange(frame_count) + rng.uniform(0.0, 2 * np.pi)
    phase = rng.uniform(0.0, 2 * np.pi, size=2)
    # A chord of 14 cm under 7 degrees.
    radius = STEP / (2 * np.sin(TURN / 2))
    height = 1.25 + 0.05 * np.sin(3 * angle + phase[0])
    eyes = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), height])
    aims = np.column_stack([np.zeros((frame_count, 2)), 0.55 + 0.05 * np.sin(2 * angle + phase[1])])
    return _joined([floor, *body]), np.stack([look_at(eye, aim) for eye, aim in zip(eyes, aims, strict=True)])


def _posters(rng: np.random.Generator) -> tuple[trimesh.Trimesh, np.ndarray]:
    """A wall along x that fills the view, walked along and back, with posters side by side."""
    x, y, z = np.eye(3)
    length, height = 12.0, 3.6
    wall = _even(length, 0.1), _even(height, 0.1)
    sheets = [sheet([0.0, 0.0, -0.4], x, z, *wall, _plain(rng, (0.85, 0.84, 0.8), 1.5, 0.15))]
    place = 0.2
    while place < length - 1.0:
        width, tall = rng.uniform(0.4, 0.8), rng.uniform(0.5, 0.9)
        corner = np.array([place, 0.0, rng.uniform(0.8, 1.9 - tall / 2)])
        material = random_material(rng, contrast=0.8, scale=(0.08, 0.25))
        cells = _even(width, 0.01), _even(tall, 0.01)

        def paint(
            u: np.ndarray, v: np.ndarray, corner: np.ndarray = corner, material: Material = material
        ) -> np.ndarray:
            return material.color_at(corner + u[:, None] * x + v[:, None] * z)

        # Paper lies 1 mm before the wall, so that rays meet it first.
        sheets.append(sheet(corner - 0.001 * y, x, z, *cells, paint))
        place += width + rng.uniform(0.15, 0.5)
    one_way = round(8.0 / POSTER_STEP)
    there = POSTER_STEP * np.concatenate([np.arange(one_way), one_way - np.arange(one_way)])
    time = np.arange(len(there))
    sway = [np.sin(2 * np.pi * time / period + rng.uniform(0.0, 2 * np.pi)) for period in (31.0, 23.0, 47.0, 37.0)]
    eyes = np.column_stack([2.0 + there, -1.3 + 0.15 * sway[0], 1.4 + 0.05 * sway[1]])
    aims = np.column_stack([eyes[:, 0] + 0.3 * sway[2], np.zeros(len(there)), 1.4 + 0.1 * sway[3]])
    return _joined(sheets), np.stack([look_at(eye, aim) for eye, aim in zip(eyes, aims, strict=True)])
