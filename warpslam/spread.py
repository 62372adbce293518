"""Even choices of a few things out of many."""

from __future__ import annotations

import numpy as np


def spread(count: int, chosen: int) -> np.ndarray:
    """Positions of ``chosen`` things spread evenly over ``count``, the first and the last among them: int, ascending,
    and fewer where there are not so many.
    """
    if count < 1:
        return np.zeros(0, int)
    return np.unique(np.linspace(0, count - 1, chosen).round().astype(int))
