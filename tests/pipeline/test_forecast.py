"""How long a run will still take."""

from __future__ import annotations

from collections.abc import Sequence

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
    """Renders a pixel in a tenth of a millisecond, any view in some time, and the first one in seconds."""

    keyframes: Sequence[int] = ()

    def __init__(self, clock: Clock, view: float = 0.05, load: float = 3.0) -> None:
        self.clock, self.view, self.load, self.rendered = clock, view, load, 0

    def render(self, T, *, stride=1):
        shape = (-(-CAMERA.height // stride), -(-CAMERA.width // stride))
        self.clock.now += self.view + 1e-4 * shape[0] * shape[1] + (0.0 if self.rendered else self.load)
        self.rendered += 1
        return FakeImage(np.ones(shape), np.ones((*shape, 3)), np.zeros(shape))


def told(monkeypatch, method, *, count=12, sequence=None, evaluates=False, config=None):
    """Seconds left after each frame of 0.1 s, every fifth of which is mapped in 1 s; and the rate in the end."""
    clock = method.clock
    monkeypatch.setattr(module, "time", clock)
    config = config or Config.from_preset("rendering", ["mapping.every=5", "mapping.color_refinement=false"])
    forecast = Forecast(config, sequence or FakeSequence(count), method, count, evaluates=evaluates)
    left = []
    for index in range(count):
        timings = {"tracking": 0.1} | ({} if index % 5 else {"mapping": 1.0})
        clock.now += sum(timings.values())
        left.append(forecast.after_frame(FrameResult(index, index / 30, np.eye(4), timings=timings), index + 1))
    return left, forecast.fps


@pytest.mark.parametrize("view", [0.0, 0.02, 0.5])
def test_pictures_cost_what_small_ones_tell(monkeypatch, view):
    """What every view costs is counted once a picture, not once a ray; loading kernels is not counted; and the time
    that the probe takes is none of the frames'.
    """
    method = Slow(Clock(), view, load=60.0)
    left, fps = told(monkeypatch, method)
    pictures = 4 * (view + 1e-4 * CAMERA.width * CAMERA.height)
    assert left[-1] == pytest.approx(1.15 * pictures + module._PLOTS)
    assert fps == pytest.approx(5 / (5 * 0.1 + 1.0)) and method.rendered == 3


def test_evaluation_is_of_the_processor(monkeypatch):
    """Comparing with a true surface takes its time however fast the map is rendered."""
    pair = [told(monkeypatch, Slow(Clock()), evaluates=evaluates)[0][-1] for evaluates in (False, True)]
    assert pair[1] - pair[0] == pytest.approx(module._EVALUATION + 12 * module._EVALUATION_A_FRAME)


def test_live_frames_do_not_wait_for_a_probe(monkeypatch):
    """Nothing is rendered for a forecast that nobody is told."""
    sequence = FakeSequence(12)
    sequence.is_live = True
    method = Slow(Clock())
    told(monkeypatch, method, sequence=sequence)
    assert method.rendered == 0


def test_methods_that_refine_otherwise(monkeypatch):
    """Fusion has no refinement; that of iMAP* has rounds of its own, each a call."""
    config = Config.from_preset("rendering", ["mapping.every=5"])
    fusion, imap = Slow(Clock()), Slow(Clock())
    fusion.keyframes = None
    imap.name = "imap"
    plain = told(monkeypatch, Slow(Clock()))[0][-1]
    assert told(monkeypatch, fusion, config=config)[0][-1] == pytest.approx(plain)
    assert told(monkeypatch, imap, config=config)[0][-1] == pytest.approx(plain + config.imap.refinement_rounds)


# Seconds of (tracking, a call of mapping, the first call): few seconds on a GPU, minutes on a small CPU, direct loss.
# And what a round of refinement costs, in calls: with the direct loss 42 iterations like the 15 of a call, and 60 of
# rendering, with 48 samples a ray instead of 7.
@pytest.mark.parametrize("seconds", [(0.02, 0.08, 0.6), (0.25, 9.0, 60.0), (0.1, 0.3, 4.0)])
@pytest.mark.parametrize(("preset", "calls"), [("rendering", 1.0), ("default", 42 / 15 + 60 / 15 * 5.4)])
@pytest.mark.parametrize("every", [1, 2, 5])
@pytest.mark.parametrize(("count", "spacing"), [(20, 20), (60, 20), (400, 12), (400, 20), (400, 30)])
def test_right_within_half_after_ten_frames(monkeypatch, seconds, preset, calls, every, count, spacing):
    """Frames, refinement, pictures and plots together, from the tenth frame to the last, within a factor of 1.5."""
    tracking, mapping, first = seconds
    clock = Clock()
    monkeypatch.setattr(module, "time", clock)
    config = Config.from_preset(preset, [f"mapping.every={every}"])
    method = Slow(clock)
    forecast = Forecast(config, FakeSequence(count), method, count, evaluates=False)
    ends, said = [], []
    for index in range(count):
        call = (first if index == 0 else mapping) if index % every == 0 else None
        clock.now += tracking + (call or 0.0)
        timings = {"tracking": tracking} | ({} if call is None else {"mapping": call})
        method.keyframes = range(1 + index // spacing)
        said.append(forecast.after_frame(FrameResult(index, index / 30, np.eye(4), timings=timings), index + 1))
        ends.append(clock.now)
    pictures = 4 * (0.05 + 1e-4 * CAMERA.width * CAMERA.height)
    end = clock.now + 1.05 * config.mapping.rounds_for(len(method.keyframes)) * calls * mapping + pictures + 1.0 + 3.0
    assert said[0] == 0.0 and min(said[1:]) > 0
    for at, left in list(zip(ends, said, strict=True))[9:]:
        assert (end - at) / 1.5 < left < 1.5 * (end - at)
