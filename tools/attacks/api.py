"""Public functions of a `Slam`, given what nobody should give them."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np

from tools.attacks import scene
from tools.attacks.isolation import Attempt
from tools.attacks.values import DOUBLES, OBJECTS, numbers


def prepare(name: str) -> Attempt:
    """On one small map."""
    slam = scene.small_slam()
    good = slam.trajectory.poses[0]
    depth = scene.frames()[0].depth

    def pose(rng: np.random.Generator) -> Any:
        kind = rng.integers(0, 5)
        if kind == 0:
            return OBJECTS[rng.integers(0, len(OBJECTS))]
        T = copy.deepcopy(good)
        if kind == 1:
            T[rng.integers(0, 4), rng.integers(0, 4)] = rng.choice(DOUBLES)
        elif kind == 2:
            T[:3, 3] = numbers(rng, (3,))
        elif kind == 3:
            T = numbers(rng, (4, 4), 0.1)
        else:
            T[:3, 3] = rng.normal(size=3) * 10.0 ** rng.uniform(-1, 5)
        return _as_tensor(T, rng)

    def points(rng: np.random.Generator) -> Any:
        if rng.random() < 0.2:
            return OBJECTS[rng.integers(0, len(OBJECTS))]
        return _as_tensor(numbers(rng, (int(rng.integers(0, 50)), 3), rng.choice([0.0, 0.1])), rng)

    def attempt(rng: np.random.Generator) -> str:
        kind = rng.integers(0, 5)
        if kind == 0:
            stride = rng.choice([1, 4, 7]) if rng.random() < 0.6 else OBJECTS[rng.integers(0, len(OBJECTS))]
            image = slam.render(pose(rng), stride=stride if rng.random() < 0.5 else int(rng.integers(-2, 90)))
            assert np.isfinite(image.depth).all() and np.isfinite(image.rgb).all(), "an image that is not finite"
            return "rendered"
        if kind == 1:
            guide = numbers(rng, (60, 80), 0.3) if rng.random() < 0.7 else OBJECTS[rng.integers(0, len(OBJECTS))]
            image = slam.render(good, depth=guide if rng.random() < 0.8 else depth[:-1], stride=4)
            assert np.isfinite(image.depth).all() and np.isfinite(image.rgb).all(), "an image that is not finite"
            return "rendered"
        if kind == 2:
            assert np.isfinite(
                slam.scene.query_occupancy(points(rng), rng.choice(["fine", "middle", "coarse", "x"]))
            ).all()
            return "asked"
        if kind == 3:
            assert np.isfinite(slam.scene.query_color(points(rng))).all(), "a colour that is not finite"
            return "asked"
        voxel = rng.choice([0.2, 0.3, 1e-9, 1e-4, *DOUBLES]) if rng.random() < 0.6 else None
        slam.mesh(OBJECTS[rng.integers(1, len(OBJECTS))] if voxel is None else voxel)
        return "meshed"

    return attempt


def _as_tensor(array: np.ndarray, rng: np.random.Generator) -> Any:
    if rng.random() > 0.1:
        return array
    import torch

    return torch.tensor(array, requires_grad=True)
