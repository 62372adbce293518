"""Constants of the sparse features, one set for all cameras and scenes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class FeatureSettings:
    """Settings of detection, matching and pose; lengths in pixels are those of the image as it comes in."""

    halved_from: int = 480
    """Features of images so wide [px] and more are detected at half the size: half the cost, and no less accurate."""
    detected: int = 4000
    """Corners that ORB is asked for, before the strongest of each cell are chosen."""
    fast_threshold: int = 7
    """Grey values between a corner and its surroundings."""
    octaves: int = 5
    """Levels of ORB's pyramid."""
    octave_factor: float = 1.2
    """Scale between levels."""
    edge: int = 19
    """Border of a level in which nothing is detected [px of the level]."""
    cell: int = 20
    """Edge of the cells of the image [px]."""
    per_cell: int = 3
    """Corners kept in a cell, the strongest."""
    max_depth: float = 8.0
    """Larger depth counts as missing [m]."""
    pixel_sigma: float = 1.0
    """Standard deviation of a position in octave 0 [px]; it grows with the octave's scale."""
    depth_sigma: float = 0.01
    """Standard deviation of inverse depth at the start [1/m]; from then on it is learnt."""
    edge_factor: float = 4.0
    """It is this times larger where depth steps beside the feature."""
    local_keyframes: int = 5
    """Keyframes that a frame is matched with."""

    @property
    def scales(self) -> np.ndarray:
        """Scale of each octave, float64 (octaves,)."""
        return self.octave_factor ** np.arange(self.octaves)
