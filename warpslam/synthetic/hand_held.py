"""Path of a camera that a walking person holds: pauses, hurry, quick looks aside, sway and roll.

A curve of poses is laid out in fine steps of time, twenty a frame, and frames are taken from it one frame's time apart,
or earlier where the camera would otherwise move or turn further than it may between two frames.
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from warpslam.errors import InputError

MEAN_STEP, MAX_STEP = 0.08, 0.25  # [m] per frame
MEAN_TURN, MAX_TURN = 4.0, 17.0  # [deg] per frame
_FINE = 20  # steps of time a frame
_LOOK_AHEAD = 1.2  # [m]
_PAUSE_SHARE = 0.08


def hand_held(
    waypoints: np.ndarray, *, seed: int = 0, eye_height: float = 1.5, pitch: float = 14.0, max_frames: int | None = None
) -> np.ndarray:
    """Walk through points with the camera in the hand: 8 cm and 4 degrees a frame, at most 25 cm and 17 degrees.

    Args:
        waypoints: Points of the path seen from above [m], shape (n, 2), n >= 2.
        seed: Of pace, looks and sway.
        eye_height: Mean height of the camera [m].
        pitch: Mean angle by which it looks down [deg].
        max_frames: The path ends after so many frames; at its last waypoint if None.

    Returns:
        T_world_camera, float64, shape (N, 4, 4), OpenCV axes.

    Raises:
        InputError: Fewer than two waypoints, or two alike in a row.
    """
    waypoints = np.asarray(waypoints, dtype=np.float64)
    legs = np.linalg.norm(np.diff(waypoints, axis=0), axis=1) if waypoints.ndim == 2 else np.zeros(0)
    if len(legs) < 1 or legs.min() <= 0:
        raise InputError("a hand-held walk needs at least two waypoints, no two alike in a row")
    # Quick turns are far above the mean, so how far the looks go decides the mean: found by halving.
    low, high = 0.0, 3.0
    for _ in range(12):
        poses = _frames(_curve(waypoints, legs, np.random.default_rng(seed), eye_height, pitch, (low + high) / 2))
        low, high = (low, (low + high) / 2) if turns(poses).mean() > MEAN_TURN else ((low + high) / 2, high)
    return poses[:max_frames]


def steps(poses: np.ndarray) -> np.ndarray:
    """Distances between neighbours of (N, 4, 4) poses [m], shape (N - 1,)."""
    return np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)


def turns(poses: np.ndarray) -> np.ndarray:
    """Angles between neighbours of (N, 4, 4) poses [deg], shape (N - 1,)."""
    relative = poses[:-1, :3, :3].transpose(0, 2, 1) @ poses[1:, :3, :3]
    return np.degrees(Rotation.from_matrix(relative).magnitude())


def _curve(
    waypoints: np.ndarray, legs: np.ndarray, rng: np.random.Generator, eye_height: float, pitch: float, look: float
) -> np.ndarray:
    """Poses in fine steps of time, shape (M, 4, 4)."""
    knots = np.concatenate([[0.0], np.cumsum(legs)])
    spline = CubicSpline(knots, waypoints, bc_type="natural")
    fine = spline(np.linspace(0.0, knots[-1], 400 * len(waypoints)))
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(fine, axis=0), axis=1))])
    count = int(np.ceil(length[-1] / MEAN_STEP)) * _FINE
    pace = np.minimum(np.exp(0.6 * _noise(rng, count, 12)), 1.3 * MAX_STEP / MEAN_STEP)
    pace *= 1.0 - _pulses(rng, count, round(_PAUSE_SHARE * count / _FINE / 10), 10)
    distance = np.concatenate([[0.0], np.cumsum(pace)[:-1]])
    distance *= length[-1] / distance[-1]

    def at(along: np.ndarray) -> np.ndarray:
        ahead = np.maximum(along - length[-1], 0.0)[:, None] * (fine[-1] - fine[-2]) / (length[-1] - length[-2])
        return np.column_stack([np.interp(along, length, fine[:, axis]) for axis in range(2)]) + ahead

    here, way = at(distance), at(distance + _LOOK_AHEAD)
    heading = np.unwrap(np.arctan2(*(way - here).T[::-1]))
    number = max(2, count // _FINE // 24)
    aside = look * np.radians(55.0) * (_pulses(rng, count, number, 8) - _pulses(rng, count, number, 6))
    yaw = heading + aside + np.radians(3.0) * _noise(rng, count, 5)
    down = np.radians(pitch) + np.radians(6.0) * _noise(rng, count, 9)
    roll = np.radians(4.0) * _noise(rng, count, 7)
    bob = 0.02 * np.sin(2 * np.pi * distance / 0.7)  # a step of 0.7 m
    eyes = np.column_stack([here + 0.02 * _noise(rng, count, 8)[:, None], eye_height + bob])
    # Camera axes at yaw 0: forward = world x, right = -world y, down = -world z.
    base = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    rotation = Rotation.from_euler("ZYX", np.column_stack([yaw, down, roll])).as_matrix() @ base
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotation, eyes
    return poses


def _frames(curve: np.ndarray) -> np.ndarray:
    """Frames taken from the curve, within the limits from one to the next."""
    effort = np.maximum(steps(curve) / MAX_STEP, turns(curve) / MAX_TURN)
    taken, done, waited = [0], 0.0, 0
    for index, part in enumerate(effort, start=1):
        if done + part > 1.0 or waited == _FINE:
            taken.append(index - 1)
            done, waited = 0.0, 0
        done, waited = done + part, waited + 1
    return curve[taken]


def _noise(rng: np.random.Generator, count: int, frames: float) -> np.ndarray:
    """Smooth noise of unit variance that changes within so many frames, shape (count,)."""
    knots = int(np.ceil(count / (_FINE * frames))) + 4
    return CubicSpline(np.arange(knots), rng.normal(size=knots))(np.arange(count) / (_FINE * frames))


def _pulses(rng: np.random.Generator, count: int, number: int, frames: int) -> np.ndarray:
    """0, and smoothly up to 1 and back to 0 at random places, each so many frames long; shape (count,)."""
    result = np.zeros(count)
    shape = np.sin(np.linspace(0.0, np.pi, frames * _FINE)) ** 2
    for start in rng.integers(0, max(1, count - len(shape)), size=number):
        part = result[start : start + len(shape)]
        np.maximum(part, shape[: len(part)], out=part)
    return result
