"""How long a run will still take."""

from __future__ import annotations

import pytest

from warpslam.pipeline.loop import RecentRate


def test_the_first_frame_does_not_count_for_long():
    """After a first frame of a minute the time left is right within a factor of 1.5 from the tenth frame on."""
    rate, clock, found = RecentRate(100.0), 100.0, []
    for index in range(60):
        clock += 60.0 if index == 0 else (2.0 if index % 5 == 0 else 0.25)
        found.append(rate.after_frame(clock))
    true = 5 / (2.0 + 4 * 0.25)
    assert found[0] == pytest.approx(1 / 60)
    assert all(true / 1.5 < value < 1.5 * true for value in found[9:])
