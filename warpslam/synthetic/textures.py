"""Procedural colours: every material is a function of position, so that any point of a surface has a colour."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

PATTERNS = ("checker", "stripes", "blotches", "bricks", "wood", "dots")


@dataclass(frozen=True)
class Material:
    """A two-colour pattern with noise on top."""

    pattern: str
    """One of `PATTERNS`."""
    colors: np.ndarray
    """The two colours, shape (2, 3), in [0, 1]."""
    scale: float
    """Size of a pattern cell [m]."""
    rotation: np.ndarray
    """World-to-pattern rotation, shape (3, 3)."""
    phase: np.ndarray
    """Shift of the pattern, shape (3,), in cells."""
    noise: float
    """Amplitude of the noise added to the brightness."""

    def color_at(self, points: np.ndarray) -> np.ndarray:
        """Colours in [0, 1], float32, shape (N, 3), at ``points`` [m], shape (N, 3)."""
        points = np.asarray(points, dtype=np.float64)
        cells = points @ self.rotation.T / self.scale + self.phase
        mix = _MIX[self.pattern](cells)[:, None]
        color = self.colors[0] * (1 - mix) + self.colors[1] * mix
        # Two octaves at fixed sizes give every surface gradients to track, whatever the size of its pattern.
        seed = self.phase[0]
        shade = value_noise(points / 0.45 + 7.3 * seed) + 0.7 * value_noise(points / 0.16 + 3.1 * seed) - 0.85
        return np.clip(color * (1 + self.noise * shade[:, None]), 0.0, 1.0).astype(np.float32)


def random_material(
    rng: np.random.Generator,
    patterns: tuple[str, ...] = PATTERNS,
    *,
    color: np.ndarray | None = None,
    contrast: float = 0.3,
    scale: tuple[float, float] = (0.2, 0.5),
    noise: float = 0.5,
) -> Material:
    """Draw a material.

    Args:
        patterns: Patterns to choose from.
        color: Main colour, shape (3,), in [0, 1]; None draws a random one.
        contrast: Difference between the two colours, 0..1.
        scale: Range of the pattern's cell size [m]; cells much below 0.15 m alias on vertex-coloured meshes.
        noise: Amplitude of the brightness noise.
    """
    if color is None:
        color = _color_from_hue(rng.uniform(), rng.uniform(0.1, 0.75), rng.uniform(0.4, 0.95))
    color = np.asarray(color, dtype=np.float64)
    direction = rng.normal(size=3)
    second = color + 0.6 * contrast * direction / np.linalg.norm(direction)
    second += np.where(color.mean() > 0.5, -0.5, 0.5) * contrast
    yaw = rng.uniform(0, 2 * np.pi)
    c, s = np.cos(yaw), np.sin(yaw)
    # Patterns on axis-aligned planes stay recognisable when they turn about the vertical only.
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]) if rng.uniform() < 0.4 else np.eye(3)
    return Material(
        pattern=str(rng.choice(patterns)),
        colors=np.clip(np.stack([color, second]), 0.03, 1.0),
        scale=float(rng.uniform(*scale)),
        rotation=rotation,
        phase=rng.uniform(0.1, 9.9, size=3),
        noise=noise,
    )


def _soft_square(x: np.ndarray) -> np.ndarray:
    """Square wave of period 2 with rounded edges: hard ones would alias between the vertices of a mesh."""
    return np.tanh(2.5 * np.sin(np.pi * x))


def _checker(cells: np.ndarray) -> np.ndarray:
    return 0.5 + 0.5 * _soft_square(cells).prod(axis=1)


def _stripes(cells: np.ndarray) -> np.ndarray:
    return 0.5 + 0.5 * _soft_square(cells[:, 0] + cells[:, 1] + 0.35 * cells[:, 2])


def _blotches(cells: np.ndarray) -> np.ndarray:
    return 1.0 / (1.0 + np.exp(-12.0 * (value_noise(1.2 * cells) - 0.5)))


def _bricks(cells: np.ndarray) -> np.ndarray:
    row = np.floor(2 * cells[:, 2])
    along = cells[:, 0] + cells[:, 1] + 0.5 * row
    shade = _hash(np.floor(along), row, np.zeros_like(row))
    joint = np.minimum(np.abs(along - np.round(along)), np.abs(2 * cells[:, 2] - np.round(2 * cells[:, 2])))
    return np.where(joint < 0.06, 1.0, 0.7 * shade)


def _wood(cells: np.ndarray) -> np.ndarray:
    bend = value_noise(0.6 * cells)
    return 0.5 + 0.5 * np.sin(2 * np.pi * (cells[:, 0] + 0.25 * cells[:, 1] + 0.4 * cells[:, 2] + 1.5 * bend))


def _dots(cells: np.ndarray) -> np.ndarray:
    offset = cells - np.round(cells)
    return 1.0 / (1.0 + np.exp(25.0 * (np.sqrt((offset**2).sum(axis=1)) - 0.42)))


_MIX = {
    "checker": _checker,
    "stripes": _stripes,
    "blotches": _blotches,
    "bricks": _bricks,
    "wood": _wood,
    "dots": _dots,
}


def _hash(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Pseudo-random value in [0, 1) of an integer lattice point."""
    h = (
        x.astype(np.int64).astype(np.uint32) * np.uint32(0x8DA6B343)
        ^ y.astype(np.int64).astype(np.uint32) * np.uint32(0xD8163841)
        ^ z.astype(np.int64).astype(np.uint32) * np.uint32(0xCB1AB31F)
    )
    h ^= h >> np.uint32(15)
    h *= np.uint32(0x2C1B3C6D)
    h ^= h >> np.uint32(12)
    h *= np.uint32(0x297A2D39)
    h ^= h >> np.uint32(15)
    return h * (1.0 / 2**32)


def value_noise(points: np.ndarray) -> np.ndarray:
    """Trilinear blend of hashed lattice values, in [0, 1], shape (N,)."""
    low = np.floor(points)
    t = points - low
    t = t * t * (3 - 2 * t)
    total = np.zeros(len(points))
    for dx in (0, 1):
        wx = t[:, 0] if dx else 1 - t[:, 0]
        for dy in (0, 1):
            wxy = wx * (t[:, 1] if dy else 1 - t[:, 1])
            for dz in (0, 1):
                w = wxy * (t[:, 2] if dz else 1 - t[:, 2])
                total += w * _hash(low[:, 0] + dx, low[:, 1] + dy, low[:, 2] + dz)
    return total


def _color_from_hue(hue: float, saturation: float, value: float) -> np.ndarray:
    wheel = np.abs((hue * 6 + np.array([0.0, 4.0, 2.0])) % 6 - 3) - 1
    return value * (1 - saturation + saturation * np.clip(wheel, 0, 1))
