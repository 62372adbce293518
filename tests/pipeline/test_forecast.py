"""How long a run will still take."""

from __future__ import annotations

import numpy as np
import pytest

from tests.fakes import CAMERA, FakeImage, FakeSequence
from warpslam.config import Config
from warpslam.frames import FrameResult
from warpslam.pipeline import forecast as module
from warpslam.pipeline.forecast import Forecast, RecentRate


def test_the_first_frame_does_not_count_for_long():
    """After a first frame of a minute the time left is right within a factor of 1.5 from the tenth frame on."""
    rate, clock, found = RecentRate(100.0, 5), 100.0, []
    for index in range(60):
        clock += 60.0 if index == 0 else (2.0 if index % 5 == 0 else 0.25)
        found.append(rate.after_frame(clock))
    true = 5 / (2.0 + 4 * 0.25)
    assert found[0] == pytest.approx(1 / 60)
    assert all(true / 1.5 < value < 1.5 * true for value in found[9:])


class Clock:
    """Time that passes when it is told to."""

    def __init__(self) -> None:
        self.now = 50.0

    def perf_counter(self) -> float:
        return self.now


class Slow:
    """Renders a pixel in a tenth of a millisecond."""

    def __init__(self, clock: Clock) -> None:
        self.clock = clock

    def render(self, T, *, stride=1):
        shape = (-(-CAMERA.height // stride), -(-CAMERA.width // stride))
        self.clock.now += 1e-4 * shape[0] * shape[1]
        return FakeImage(np.ones(shape), np.ones((*shape, 3)), np.zeros(shape))


# Seconds of (tracking, a call of mapping, the first call): few seconds on a GPU, minutes on a small CPU, direct loss.
@pytest.mark.parametrize("seconds", [(0.02, 0.08, 0.6), (0.25, 9.0, 60.0), (0.1, 0.3, 4.0)])
@pytest.mark.parametrize("every", [1, 2, 5])
@pytest.mark.parametrize("count", [20, 60, 400])
def test_right_within_half_after_ten_frames(monkeypatch, seconds, every, count):
    """Frames, refinement, pictures and plots together, from the tenth frame to the last, within a factor of 1.5."""
    tracking, mapping, first = seconds
    clock = Clock()
    monkeypatch.setattr(module, "time", clock)
    config = Config.from_preset("default", [f"mapping.every={every}"])
    forecast = Forecast(config, FakeSequence(count), Slow(clock), count, evaluates=False)
    ends, told = [], []
    for index in range(count):
        call = (first if index == 0 else mapping) if index % every == 0 else None
        clock.now += tracking + (call or 0.0)
        timings = {"tracking": tracking} | ({} if call is None else {"mapping": call})
        told.append(forecast.after_frame(FrameResult(index, index / 30, np.eye(4), timings=timings), index + 1))
        ends.append(clock.now)
    pictures = 4 * 1e-4 * CAMERA.width * CAMERA.height
    end = clock.now + 1.05 * config.mapping.refinement_rounds * mapping + pictures + 1.0 + 3.0
    for at, left in list(zip(ends, told, strict=True))[9:]:
        assert (end - at) / 1.5 < left < 1.5 * (end - at)
