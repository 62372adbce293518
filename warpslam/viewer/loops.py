"""Loops as lines between the keyframes that show one place."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

LOOP_COLOR = (232, 126, 4)


def loop_lines(pairs: Iterable[tuple[int, int]], positions: np.ndarray) -> np.ndarray:
    """Ends of the line of each loop, (L, 2, 3) [m].

    Args:
        pairs: Frames of the two keyframes of each loop.
        positions: Of all frames (N, 3) [m]; loops with a frame beyond them are left out.
    """
    inside = [pair for pair in pairs if max(pair) < len(positions)]
    return np.asarray(positions, np.float32)[np.array(inside, np.int64).reshape(-1, 2)]


def loops_of(method: Any) -> list[tuple[int, int]]:
    """Loops that a method has closed and that hold; empty for one that closes none."""
    closer = getattr(method, "loops", None)
    return [] if closer is None else closer.edges
