"""Smooth camera paths in closed form."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline

from warpslam.errors import InputError
from warpslam.synthetic.rooms import Room

STEP = 0.013  # [m] per frame along the path
MAX_TURN = np.radians(0.65)  # per frame
EYE_HEIGHT = 1.5  # [m] above the floor
CLEARANCE = 0.3  # [m] between the camera and any solid


def look_at(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Upright camera at ``eye`` that looks at ``target``, world z up.

    Args:
        eye: Camera centre [m], shape (3,).
        target: Point on the optical axis [m], shape (3,).

    Returns:
        T_world_camera, float64, shape (4, 4), OpenCV axes.

    Raises:
        InputError: The view direction is vertical or zero.
    """
    eye, target = np.asarray(eye, dtype=np.float64), np.asarray(target, dtype=np.float64)
    forward = target - eye
    right = np.cross(forward, [0.0, 0.0, 1.0])
    if np.linalg.norm(right) < 1e-9 * max(1.0, float(np.linalg.norm(forward))):
        raise InputError(f"look_at from {eye} to {target}: the direction must not be vertical or zero")
    forward = forward / np.linalg.norm(forward)
    right = right / np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    T[:3, 3] = eye
    return T


def orbit(
    center: np.ndarray,
    radii: tuple[float, float],
    frame_count: int,
    *,
    turn: float,
    start: float = 0.0,
    aim: float | np.ndarray = 1.2,
    sway: float = 0.03,
    phase: float = 0.0,
    progress: np.ndarray | None = None,
) -> np.ndarray:
    """Walk along an ellipse while looking across it, with the sway of a hand.

    Args:
        center: Middle of the ellipse [m], shape (3,).
        radii: Half axes along x and y [m].
        turn: Angle walked per frame [rad].
        start: Angle of the first frame [rad].
        aim: Height of the point above or below the centre that the camera looks at [m], or that point, shape (3,).
        sway: Amplitude of the vertical sway [m].
        phase: Shift of the sway [rad].
        progress: Frames' worth of walking done at each frame, shape (frame_count,); steady walking if None.

    Returns:
        T_world_camera, float64, shape (frame_count, 4, 4), OpenCV axes.
    """
    if frame_count < 1:
        raise InputError(f"frame_count = {frame_count} must be at least 1")
    center = np.asarray(center, dtype=np.float64)
    target = np.asarray(aim, dtype=np.float64)
    if target.ndim == 0:
        target = np.array([center[0], center[1], float(target)])
    poses = np.empty((frame_count, 4, 4))
    for index in range(frame_count):
        angle = start + turn * (index if progress is None else float(progress[index]))
        # Periods (57, 83, 101 frames) without a common one keep the sway from repeating within a short path.
        bob = [np.sin(2 * np.pi * index / period + phase) for period in (83.0, 57.0, 101.0)]
        eye = center + [radii[0] * np.cos(angle), radii[1] * np.sin(angle), sway * bob[0]]
        sideways = np.array([-np.sin(angle), np.cos(angle), 0.0])
        poses[index] = look_at(eye, target + 0.8 * sway * bob[1] * sideways + [0.0, 0.0, 1.5 * sway * bob[2]])
    return poses


def walk(
    waypoints: np.ndarray,
    frame_count: int,
    *,
    eye_height: float = EYE_HEIGHT,
    look_ahead: float = 1.5,
    drop: float = 0.35,
) -> np.ndarray:
    """Walk along a smooth curve through points at a steady pace, looking along the way and a little down.

    Args:
        waypoints: Points of the path seen from above [m], shape (n, 2), n >= 2.
        frame_count: Number of poses, spread evenly over the length of the path.
        eye_height: Height of the camera [m].
        look_ahead: The camera looks at the point of the path that is so far ahead [m]; at the end, straight on.
        drop: That point lies so far below the camera [m].

    Returns:
        T_world_camera, float64, shape (frame_count, 4, 4), OpenCV axes.

    Raises:
        InputError: Fewer than two waypoints, two alike in a row, or no frame.
    """
    waypoints = np.asarray(waypoints, dtype=np.float64)
    legs = np.linalg.norm(np.diff(waypoints, axis=0), axis=1)
    if frame_count < 1 or len(legs) < 1 or legs.min() <= 0:
        raise InputError("a walk needs a frame, and at least two waypoints, no two alike in a row")
    curve = CubicSpline(np.concatenate([[0.0], np.cumsum(legs)]), waypoints, bc_type="natural")
    knots = np.linspace(0.0, legs.sum(), 50 * len(waypoints))
    fine = curve(knots)
    direction = fine[-1] - fine[-2]
    direction /= np.linalg.norm(direction)
    fine = np.concatenate([fine, fine[-1:] + 2.0 * look_ahead * direction])
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(fine, axis=0), axis=1))])
    here = np.linspace(0.0, length[-2], frame_count)

    def at(distance: np.ndarray, height: float) -> np.ndarray:
        x, y = (np.interp(distance, length, fine[:, axis]) for axis in range(2))
        return np.column_stack([x, y, np.full(len(distance), height)])

    eyes, targets = at(here, eye_height), at(here + look_ahead, eye_height - drop)
    return np.stack([look_at(eye, target) for eye, target in zip(eyes, targets, strict=True)])


def room_trajectory(room: Room, frame_count: int, seed: int = 0, progress: np.ndarray | None = None) -> np.ndarray:
    """Hand-held-like path inside a room's free space, looking across the room.

    The eye moves 1-2 cm (less in a very small room) and turns less than a degree per frame, 1.4-1.6 m above the floor.

    Args:
        room: Room to walk in.
        frame_count: Number of poses.
        seed: Where the path starts and which way it turns.
        progress: Frames' worth of walking done at each frame, shape (frame_count,); steady walking if None.

    Returns:
        T_world_camera, float64, shape (frame_count, 4, 4), OpenCV axes.

    Raises:
        InputError: No ellipse of 0.25 m radius fits into the free space.
    """
    rng = np.random.default_rng(seed)
    center, radii = _widest_ellipse(room)
    # On the short side of the ellipse the view turns faster than the angle grows.
    turn = min(MAX_TURN * min(radii) / max(radii), STEP / float(np.mean(radii)))
    return orbit(
        center,
        radii,
        frame_count,
        turn=turn * (1 if rng.uniform() < 0.5 else -1),
        start=rng.uniform(0, 2 * np.pi),
        aim=float(center[2] - 0.25),
        phase=rng.uniform(0, 2 * np.pi),
        progress=progress,
    )


def _widest_ellipse(room: Room) -> tuple[np.ndarray, tuple[float, float]]:
    """Centre [m] and half axes [m] of the best ellipse at eye height whose rim keeps clear of solids."""
    low, high = room.interior_bounds
    middle = (low + high) / 2
    angles = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    rim = np.column_stack([np.cos(angles), np.sin(angles)])
    candidates = []
    for x in np.linspace(-0.25, 0.25, 9) * (high - low)[0]:
        for y in np.linspace(-0.25, 0.25, 9) * (high - low)[1]:
            for rx, ry in ((a, b) for a in _RADII for b in _RADII if 0.65 < a / b < 1.55):
                # Large is good (parallax), but the opposite wall has to stay within depth range: centre it.
                candidates.append((np.sqrt(rx * ry) - 0.25 * np.hypot(x, y), x, y, rx, ry))
    for _, x, y, rx, ry in sorted(candidates, reverse=True):
        center = np.array([middle[0] + x, middle[1] + y, low[2] + EYE_HEIGHT])
        if room.free_space(
            np.column_stack([center[:2] + rim * (rx, ry), np.full(len(rim), center[2])]), CLEARANCE
        ).all():
            return center, (rx, ry)
    raise InputError("the room has no free space for a camera path; use another seed")


_RADII = (0.25, 0.35, 0.45, 0.6, 0.75, 0.9, 1.1, 1.3)
