"""Small images of frames, by whose likeness keyframes are chosen for relocalisation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

THUMBNAIL = (12, 16)  # rows, columns
GREY_WEIGHT = 2.0  # how much a difference in grey, 0..1, counts beside a relative difference in depth
MIN_SHARED = 0.3  # share of cells that two thumbnails must both have depth in


@dataclass(frozen=True)
class Thumbnail:
    """A frame at 12 x 16 cells: mean depth [m], NaN where less than half a cell has depth, and mean grey, 0..1."""

    depth: np.ndarray
    grey: np.ndarray

    @classmethod
    def of(cls, rgb: np.ndarray, depth: np.ndarray) -> Thumbnail:
        """From uint8 (H, W, 3) and float32 (H, W) [m], 0 = missing."""
        known = _cell_means((depth > 0).astype(np.float64))
        with np.errstate(divide="ignore", invalid="ignore"):
            mean = np.where(known >= 0.5, _cell_means(depth.astype(np.float64)) / known, np.nan)
        return cls(mean, _cell_means(rgb.mean(axis=2) / 255.0))

    def difference(self, other: Thumbnail) -> float:
        """Mean relative difference in depth and, apart from the exposure, in grey; infinite if little is shared."""
        both = np.isfinite(self.depth) & np.isfinite(other.depth)
        if both.mean() < MIN_SHARED:
            return np.inf
        a, b = self.depth[both], other.depth[both]
        # Cells that straddle an edge differ by much and tell little.
        depth = np.minimum(np.abs(a - b) / np.minimum(a, b), 0.5).mean()
        grey = np.abs((self.grey - self.grey.mean()) - (other.grey - other.grey.mean())).mean()
        return float(depth + GREY_WEIGHT * grey)


def _cell_means(image: np.ndarray) -> np.ndarray:
    rows, columns = (np.linspace(0, image.shape[axis], THUMBNAIL[axis] + 1).astype(int) for axis in (0, 1))
    sums = np.pad(image.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    corners = sums[np.ix_(rows, columns)]
    areas = np.outer(np.diff(rows), np.diff(columns))
    return (corners[1:, 1:] - corners[:-1, 1:] - corners[1:, :-1] + corners[:-1, :-1]) / np.maximum(areas, 1)
