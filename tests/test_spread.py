"""Even choices."""

from __future__ import annotations

import numpy as np
import pytest

from warpslam.spread import spread


@pytest.mark.parametrize(
    ("count", "chosen", "expected"),
    [(8, 4, [0, 2, 5, 7]), (3, 9, [0, 1, 2]), (1, 4, [0]), (5, 1, [0]), (0, 4, []), (7, 0, []), (9, 9, [*range(9)])],
)
def test_first_and_last_are_chosen_and_none_twice(count, chosen, expected):
    """Ascending whole numbers, as even as rounding allows."""
    positions = spread(count, chosen)
    assert positions.tolist() == expected and positions.dtype == int


def test_steps_differ_by_one_at_most():
    """An even choice of many has no holes."""
    for chosen in range(2, 60):
        steps = np.diff(spread(100, chosen))
        assert steps.max() - steps.min() <= 1
