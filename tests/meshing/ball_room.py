"""An analytic scene: a ball in a box room, seen by cameras whose depth is computed in closed form."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from warpslam.camera import Intrinsics
from warpslam.meshing import ObservedView

ROOM = np.array([1.2, 1.0, 0.8])  # half extents [m]
OFFSET = np.array([0.013, -0.007, 0.004])  # keeps the walls off the lattice planes
RADIUS = 0.3
CAMERA = Intrinsics(40.0, 40.0, 39.5, 29.5, 80, 60)


@dataclass
class BallRoom:
    """Free between the walls and outside the ball; the logit is 10 times the distance [m] into the solid."""

    bounds: tuple = (-ROOM - 0.3, ROOM + 0.3)
    poison: float = 0.0
    asked: int = 0

    def distance(self, points):
        """Signed distance (N,) to the nearest surface [m], positive in free space."""
        p = np.asarray(points, dtype=np.float64) - OFFSET
        return np.minimum((ROOM - np.abs(p)).min(axis=1), np.linalg.norm(p, axis=1) - RADIUS)

    def query_occupancy(self, points, level="fine"):
        """Logits; the value `poison` is added where x > 0, to damage the field."""
        assert points.dtype == np.float32
        self.asked += len(points)
        logits = (-10.0 * self.distance(points)).astype(np.float32)
        logits[points[:, 0] > 0] += np.float32(self.poison)
        return logits

    def query_color(self, points):
        """A colour that changes with the place."""
        return (0.5 + 0.25 * points).astype(np.float32)


def look(position, target):
    """Camera at `position` that looks at `target`, world z up."""
    position, target = np.asarray(position, float) + OFFSET, np.asarray(target, float) + OFFSET
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    T[:3, 3] = position
    return T


def render(T, camera=CAMERA):
    """Exact z-depth of the room with the ball, from inside it."""
    v, u = np.mgrid[: camera.height, : camera.width]
    local = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    ray, origin = local @ T[:3, :3].T, T[:3, 3] - OFFSET
    with np.errstate(divide="ignore", invalid="ignore"):
        wall = np.where(ray != 0, (np.sign(ray) * ROOM - origin) / ray, np.inf).min(axis=-1)
        a, b, c = (ray**2).sum(-1), ray @ origin, origin @ origin - RADIUS**2
        ball = (-b - np.sqrt(b * b - a * c)) / a
    return np.where(ball > 0, np.minimum(wall, ball), wall).astype(np.float32)


def view(position, target, camera=CAMERA):
    """The observed view from `position` to `target`."""
    T = look(position, target)
    return ObservedView(render(T, camera), camera, T)


def views_of_everything():
    """Cameras in the corners that look across the room: every wall and the whole ball are seen."""
    corners = [(x, y, z) for x in (-1, 1) for y in (-0.8, 0.8) for z in (-0.6, 0.6)]
    outward = [view((0.3 * x, 0.8 * y, 0.5 * z), (1.2 * x, y, 0.8 * z)) for x, y, z in corners]
    return [view(corner, (0, 0, 0)) for corner in corners] + outward


def open_edges(faces):
    """Directed edges without exactly one opposite edge."""
    count = Counter(map(tuple, np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).tolist()))
    return [edge for edge, n in count.items() if n != 1 or count[edge[::-1]] != 1]
