"""The estimated camera trajectory."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Trajectory:
    """Poses of all frames so far.

    timestamps: [s], float64 (N,). poses: T_world_camera, float64 (N, 4, 4). status: "OK", "LOST" or "SKIPPED" of each
    frame.
    """

    timestamps: np.ndarray
    poses: np.ndarray
    status: list[str]
