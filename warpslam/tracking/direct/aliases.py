"""Whether a frame tells where it is along the directions that its depth leaves open.

A corridor's length, the plane of a wall: there grey values alone hold the camera, and where they repeat themselves a
place further on fits as well, or would if it were in view. So a frame is compared with itself from other places along
these directions. If nothing much changes, what it was found to be near after a loss may as well be another tile.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from warpslam.kernels.direct.registration import OUT_OF_VIEW
from warpslam.poses import motion_between
from warpslam.tracking.direct.measures import Measures
from warpslam.tracking.direct.registrar import Registrar, new_tasks

OPEN = 0.02
"""A direction is left open by depth if its information is less than this share of the best determined one's."""
REACH = 80.0
"""Of the grid of places [px of the middle level at the mean depth]: half of the view."""
STEP, COARSE_STEP = 1.5, 3.0
"""Of the grid [the same], along one direction or along two."""
KEPT = 6
"""Places that are registered further."""
LEAST_VIEW = 0.5
"""Share of the points that must be in view from another place."""


def difference_elsewhere(
    registrar: Registrar, row: int, scratch: int, weights: tuple[float, float], apart: float
) -> float:
    """How much a frame differs from itself where it is most like itself elsewhere.

    Args:
        registrar: Holds the frame's images.
        row: Where these are.
        scratch: Row of points that may be overwritten.
        weights: Of grey values and depth, as tasks take them.
        apart: What is nearer is the same place [m].

    Returns:
        Mean robust cost of a point in view, infinite where depth holds the camera or nothing else can be compared.
    """
    registrar.select(row, scratch)
    places = _cheapest_places(registrar, row, scratch, weights, apart)
    if not places:
        return math.inf
    tasks = _tasks(row, scratch, np.array(places), weights)
    tasks["top"], tasks["low"], tasks["cost_level"] = registrar.plan.middle, 0, 0
    least = math.inf
    for result in registrar.register(tasks):
        view = Measures.of(result["record_0"]).view
        step, _ = motion_between(np.eye(4), np.asarray(result["T"], np.float64))
        if result["ok"] and step > apart and view > LEAST_VIEW:
            least = min(least, (float(result["end_cost"]) - OUT_OF_VIEW * (1.0 - view)) / view)
    return least


def _tasks(row: int, keyframe: int, transforms: np.ndarray, weights: tuple[float, float]) -> Any:
    tasks = new_tasks(len(transforms))
    tasks["row"], tasks["keyframe"], tasks["T"] = row, keyframe, transforms
    tasks["grey"], tasks["depth"] = weights
    return tasks


def _open_directions(registrar: Registrar, row: int, keyframe: int) -> np.ndarray:
    """Unit vectors in the frame's axes along which depth does not hold the camera, (n, 3)."""
    task = _tasks(row, keyframe, np.eye(4)[None], (0.0, 1.0))
    task["top"] = task["low"] = registrar.plan.middle
    task["iterations"] = -1
    H = np.asarray(registrar.register(task)[0]["H"], np.float64)[:3, :3]
    if not np.isfinite(H).all():
        return np.zeros((0, 3))
    values, vectors = np.linalg.eigh(H)
    return np.asarray(vectors.T[values < OPEN * max(values[-1], 1e-9)])


def _cheapest_places(
    registrar: Registrar, row: int, keyframe: int, weights: tuple[float, float], apart: float
) -> list[np.ndarray]:
    """Transforms (4, 4) along the open directions that cost least."""
    axes = _open_directions(registrar, row, keyframe)[:2]
    if not len(axes):
        return []
    middle = registrar.plan.middle
    pixel = registrar.mean_depth(row) / float(registrar.plan.levels[middle]["fx"])
    step = STEP if len(axes) == 1 else COARSE_STEP
    steps = step * pixel * np.arange(-int(REACH / step), int(REACH / step) + 1)
    shifts = np.stack(np.meshgrid(*[steps] * len(axes), indexing="ij"), axis=-1).reshape(-1, len(axes)) @ axes
    shifts = shifts[np.linalg.norm(shifts, axis=1) > apart]
    transforms = np.tile(np.eye(4), (len(shifts), 1, 1))
    transforms[:, :3, 3] = shifts
    tasks = _tasks(row, keyframe, transforms, weights)
    tasks["top"] = tasks["low"] = tasks["cost_level"] = middle
    tasks["iterations"] = -2
    costs = registrar.register(tasks)["start_cost"]
    found: list[np.ndarray] = []
    for n in np.argsort(costs, kind="stable"):
        if all(motion_between(other, transforms[n])[0] > apart for other in found):
            found.append(transforms[n])
        if len(found) == KEPT:
            break
    return found
