"""The levels of an image pyramid: sizes, cameras, and how many points each gives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from warpslam.camera import Intrinsics
from warpslam.kernels.direct.images import Level

LARGEST_WIDTH = 320
"""Level 0 is about this wide [px]: larger images cost time and gain nothing."""
MAX_LEVELS = 5
MIN_WIDTH, MIN_HEIGHT = 16, 10
MAX_POINTS = 2133
"""Of a level: one in a square of 6 x 6 pixels at 320 x 240."""
GATES = (0.10, 0.15, 0.25, 0.4, 0.6)
"""Depths that differ by more are no pair, by level [m]."""
ITERATIONS = (8, 8, 10, 12, 12)
"""At most, by level."""


@dataclass(frozen=True)
class PyramidPlan:
    """What a pyramid of a camera's images looks like."""

    edge: int
    """Pixels of the image along a pixel of level 0."""
    levels: np.ndarray
    """One `Level` each, the largest first."""

    @classmethod
    def of(cls, camera: Intrinsics) -> PyramidPlan:
        """For images of a camera."""
        edge = 2 ** max(0, round(np.log2(camera.width / LARGEST_WIDTH)))
        count = 1
        while count < MAX_LEVELS and _fits(camera, edge << count):
            count += 1
        levels = records(Level, count)
        pixel = point = 0
        width, height = camera.width // edge, camera.height // edge
        for n, level in enumerate(levels):
            scale = 1.0 / (edge << n)
            block = int(np.ceil(np.sqrt(width * height / MAX_POINTS)))
            level["first"], level["width"], level["height"] = pixel, width, height
            level["fx"], level["fy"] = camera.fx * scale, camera.fy * scale
            level["cx"], level["cy"] = (camera.cx + 0.5) * scale - 0.5, (camera.cy + 0.5) * scale - 0.5
            level["first_point"], level["block"], level["columns"] = point, block, width // block
            level["points"] = (width // block) * (height // block)
            level["radius"], level["gate"] = max(1, 3 >> n), GATES[n]
            pixel, point = pixel + width * height, point + int(level["points"])
            width, height = width // 2, height // 2
        return cls(edge, levels)

    @property
    def top(self) -> int:
        """The smallest level."""
        return len(self.levels) - 1

    @property
    def middle(self) -> int:
        """Where registration begins if the motion can be foretold: two levels below the smallest, but no further down
        than level 1, where poses are judged, if there is one.
        """
        return max(self.top - 2, min(1, self.top))

    @property
    def pixels(self) -> int:
        """Pixels of all levels."""
        last = self.levels[-1]
        return int(last["first"] + last["width"] * last["height"])

    @property
    def points(self) -> int:
        """Points of all levels."""
        return int(self.levels[-1]["first_point"] + self.levels[-1]["points"])

    @property
    def iterations(self) -> tuple[int, ...]:
        """At most, by level."""
        return ITERATIONS[: len(self.levels)]

    def to_device(self, device: wp.Device) -> wp.array:
        """The levels as kernels read them."""
        return wp.array(self.levels, dtype=Level, device=device)


def _fits(camera: Intrinsics, edge: int) -> bool:
    return camera.width // edge >= MIN_WIDTH and camera.height // edge >= MIN_HEIGHT


def records(struct: Any, count: int = 1) -> Any:
    """A structured array of zeros for a struct of Warp, (count,)."""
    return np.zeros(count, struct.numpy_dtype())
