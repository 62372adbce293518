"""What mapped frames saw, kept small for the mesh and for figures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

SEEN_STRIDE = 4


@dataclass(frozen=True)
class SeenDepth:
    """What a mapped frame saw, kept small: it tells the mesher which space was observed.

    index: Frame number. millimetres: Every 4th row and column of the depth, uint16.
    """

    index: int
    millimetres: np.ndarray

    @classmethod
    def of(cls, index: int, depth: np.ndarray) -> SeenDepth:
        """From a full depth image [m], float32 (H, W)."""
        return cls(index, np.rint(1000.0 * depth[::SEEN_STRIDE, ::SEEN_STRIDE]).astype(np.uint16))

    def depth(self) -> np.ndarray:
        """Depth [m], float32."""
        return self.millimetres.astype(np.float32) / 1000.0
