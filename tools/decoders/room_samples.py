"""Training data: points, labels and rays of procedural rooms, computed once in worker processes and kept on disk.

Everything is in the room's own frame [m], centred, float32 (float16 would round by 4 mm at 5 m, as much as the labels
near a surface resolve). Random placement in the world happens when a batch is drawn.
"""

from __future__ import annotations

import importlib.util
import multiprocessing
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

HELD_OUT_SEED = 1_000_000
"""Rooms with seeds from here on are for evaluation only."""

_ROOMS_FILE = Path(__file__).resolve().parents[2] / "warpslam" / "synthetic" / "rooms.py"


@dataclass(frozen=True)
class SampleSizes:
    """How much to draw from each room."""

    surface: int = 40_000
    points: int = 120_000  # labelled; the first half near the surface, the others anywhere in the room
    cameras: int = 24
    rays: int = 500


def make_samples(room: Any, seed: int, sizes: SampleSizes) -> dict[str, np.ndarray]:
    """Draw from one room.

    Args:
        room: Has `bounds` (2, 3) [m], `occupancy(points) -> bool (N,)`, `sample_surface(count, rng)`.
        seed: Seed of the draws.
        sizes: Numbers of samples.

    Returns:
        float32 arrays `surface`, `normals`, `colors` (N, 3); `points` (M, 3) with bool `occupied` (M,);
        `origins` (C, 3), `directions`, `ray_colors`, `ray_normals` (C, R, 3) and `distances` (C, R) along unit
        directions, 0 = miss. Colours and normals of rays are those of the nearest sampled surface point.
    """
    rng = np.random.default_rng([seed, 17])
    lower, upper = np.asarray(room.bounds, dtype=np.float64)
    surface, normals, colors = room.sample_surface(sizes.surface, rng)
    colors = np.asarray(colors, dtype=np.float64)[:, :3]
    if colors.max() > 1.5:
        colors = colors / 255.0
    half = sizes.points // 2
    pick = rng.integers(0, len(surface), half)
    # Two bands: the surface itself to a few cm, and what the ray samples of +-5 % of the depth reach.
    spread = np.where(rng.random(half) < 0.5, 0.025, 0.10)
    near = surface[pick] + rng.normal(0.0, 1.0, (half, 3)) * spread[:, None]
    near = np.clip(near, lower, upper)
    uniform = rng.uniform(lower, upper, (sizes.points - half, 3))
    points = np.concatenate([near, uniform])
    origins, directions, distances = _cast_views(room, rng, lower, upper, sizes)
    hits = (origins[:, None] + directions * distances[..., None]).reshape(-1, 3)
    nearest = cKDTree(surface).query(hits, workers=1)[1]
    centre = (lower + upper) / 2
    samples = {
        "surface": surface - centre,
        "normals": normals,
        "colors": colors,
        "points": points - centre,
        "origins": origins - centre,
        "directions": directions,
        "distances": distances,
        "ray_colors": colors[nearest].reshape(directions.shape),
        "ray_normals": normals[nearest].reshape(directions.shape),
    }
    samples = {name: np.ascontiguousarray(array, dtype=np.float32) for name, array in samples.items()}
    return samples | {"occupied": np.asarray(room.occupancy(points), dtype=bool)}


def prepare_rooms(folder: Path, seeds: list[int], sizes: SampleSizes, workers: int) -> Iterator[tuple[int, Path]]:
    """Make the samples of rooms that are not in the folder yet; yields (seed, file) as each is there."""
    folder.mkdir(parents=True, exist_ok=True)
    jobs = [(seed, folder / f"room_{seed:07d}.npz", sizes) for seed in seeds]
    missing = [job for job in jobs if not job[1].exists()]
    yield from ((seed, path) for seed, path, _ in jobs if path.exists())
    if workers <= 1:
        yield from map(_prepare_room, missing)
        return
    with multiprocessing.get_context("spawn").Pool(workers) as pool:
        yield from pool.imap_unordered(_prepare_room, missing)


def load_room(path: Path) -> dict[str, np.ndarray]:
    """Samples of one room, as written by `prepare_rooms`."""
    with np.load(path) as archive:
        return dict(archive)


def _prepare_room(job: tuple[int, Path, SampleSizes]) -> tuple[int, Path]:
    seed, path, sizes = job
    samples = make_samples(_room_maker()(seed), seed, sizes)
    # Written under another name first: a killed run leaves no half file that looks complete.
    temporary = path.with_suffix(".tmp.npz")
    np.savez(temporary, **samples)
    temporary.replace(path)
    return seed, path


def _room_maker() -> Callable[[int], Any]:
    try:
        from warpslam.synthetic.rooms import make_room
    except ImportError:
        # A machine that only trains may lack what the package imports; the rooms themselves need NumPy alone.
        spec = importlib.util.spec_from_file_location("decoder_rooms", _ROOMS_FILE)
        if spec is None or spec.loader is None:
            raise
        module = importlib.util.module_from_spec(spec)
        sys.modules[spec.name] = module
        spec.loader.exec_module(module)
        make_room = module.make_room
    return make_room


def _cast_views(
    room: Any, rng: np.random.Generator, lower: np.ndarray, upper: np.ndarray, sizes: SampleSizes
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cameras in free space, each with rays in a cone of 90 x 70 degrees around a nearly level axis."""
    origins = _free_positions(room, rng, lower, upper, sizes.cameras)
    yaw, pitch = rng.uniform(-np.pi, np.pi, sizes.cameras), rng.normal(-0.2, 0.25, sizes.cameras)
    forward = np.stack([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)], axis=1)
    right = np.stack([np.sin(yaw), -np.cos(yaw), np.zeros_like(yaw)], axis=1)
    up = np.cross(right, forward)
    across, along = (
        rng.uniform(-1.0, 1.0, (2, sizes.cameras, sizes.rays, 1)) * np.array([1.0, 0.7])[:, None, None, None]
    )
    directions = forward[:, None] + across * right[:, None] + along * up[:, None]
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    starts = np.repeat(origins, sizes.rays, axis=0)
    longest = float(np.linalg.norm(upper - lower))
    distances = march(room.occupancy, starts, directions.reshape(-1, 3), longest)
    return origins, directions, distances.reshape(sizes.cameras, sizes.rays)


def _free_positions(
    room: Any, rng: np.random.Generator, lower: np.ndarray, upper: np.ndarray, count: int
) -> np.ndarray:
    """Points at least 0.25 m from anything solid along the axes, in the middle half of the height."""
    offsets = 0.25 * np.concatenate([np.eye(3), -np.eye(3), np.zeros((1, 3))])
    inset = np.array([0.1, 0.1, 0.25]) * (upper - lower)
    found: list[np.ndarray] = []
    for _ in range(200):
        candidates = rng.uniform(lower + inset, upper - inset, (64, 3))
        solid = room.occupancy((candidates[:, None] + offsets).reshape(-1, 3)).reshape(64, 7).any(axis=1)
        found.extend(candidates[~solid])
        if len(found) >= count:
            return np.array(found[:count])
    raise RuntimeError(f"Found only {len(found)} of {count} free camera positions in the room.")


def march(
    occupancy: Callable[[np.ndarray], np.ndarray],
    origins: np.ndarray,
    directions: np.ndarray,
    longest: float,
    step: float = 0.02,
) -> np.ndarray:
    """Distance to the first solid along rays (N, 3) [m], to about 0.3 mm; 0 where nothing is hit within `longest`."""
    reach = np.zeros(len(origins))
    hit = np.zeros(len(origins), dtype=bool)
    active = np.arange(len(origins))
    ahead = step * np.arange(1, 17)
    while len(active):
        distance = reach[active, None] + ahead
        solid = occupancy((origins[active, None] + directions[active, None] * distance[..., None]).reshape(-1, 3))
        solid = solid.reshape(len(active), -1)
        found = solid.any(axis=1)
        reach[active] = np.where(found, distance[np.arange(len(active)), solid.argmax(axis=1)] - step, distance[:, -1])
        hit[active[found]] = True
        active = active[~found & (distance[:, -1] < longest)]
    low, high = reach[hit], reach[hit] + step
    for _ in range(6):
        middle = (low + high) / 2
        inside = occupancy(origins[hit] + directions[hit] * middle[:, None])
        low, high = np.where(inside, low, middle), np.where(inside, middle, high)
    distances = np.zeros(len(origins))
    distances[hit] = (low + high) / 2
    return distances
