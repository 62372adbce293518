"""Looking on: what it may cost, that it changes nothing, and what a browser shows."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from tests.browser import Browser, find_chromium, wait_for
from tests.fakes import FakeSequence, FakeSlam, run_sequence
from warpslam.camera import Intrinsics
from warpslam.cli import main
from warpslam.config import Config
from warpslam.errors import ConfigError, MissingDependencyError
from warpslam.frames import FrameResult
from warpslam.pipeline import run as pipeline
from warpslam.pipeline.observer import Observer, Observers
from warpslam.runs.record import Progress
from warpslam.synthetic import SyntheticSequence
from warpslam.viewer import live
from warpslam.viewer.live import SHARE, Budget, LiveView
from warpslam.viewer.page import Address

CAMERA = Intrinsics(60.0, 60.0, 39.5, 29.5, 80, 60)
SETTINGS = ["mapping.pixels=200", "mapping.first_iterations=60", "mapping.refinement_rounds=1", "keyframes.every=2"]
ANYWHERE = Address("localhost", 0)


class Clock:
    """Time that passes when it is told to."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_what_is_spent_is_a_share_of_what_passes():
    """Of 100 s that pass, work that asks before it begins gets the share, and one piece at most on top."""
    clock = Clock()
    budget = Budget(clock=clock)
    piece, done = 0.3, 0

    def work() -> None:
        nonlocal done
        clock.now += piece
        done += 1

    while clock.now < 100:
        clock.now += 0.03  # a frame
        if budget.left >= piece:
            assert budget.spend(work) == pytest.approx(piece)
    assert budget.spent == pytest.approx(piece * done)
    assert 0.9 * SHARE * clock.now < budget.spent <= SHARE * clock.now


@pytest.mark.parametrize("frame_seconds", [0.005, 0.04, 1.0])
def test_engine_keeps_its_time(monkeypatch, frame_seconds):
    """A watched run of ten minutes: what the page, the rendering and the blocks take is below a twentieth of it, and
    the camera is shown at least every other second.
    """
    clock, shown, spent = Clock(), [], []

    def costing(seconds, note=None):
        def work(*_):
            clock.now += seconds
            spent.append(seconds)
            if note is not None:
                note.append(clock.now)

        return work

    class Page:
        is_watched = True

    class Stopwatch:
        perf_counter = staticmethod(clock)

    monkeypatch.setattr(live, "time", Stopwatch)
    monkeypatch.setattr(live.Budget.__init__, "__defaults__", (SHARE, clock))
    view = LiveView(ANYWHERE)
    view.page = Page()
    view._show_camera = costing(0.02, shown)
    view._show_rendering = costing(0.4)
    view._show_blocks = costing(0.15)
    view._positions = [np.zeros(3)]
    frames = int(600 / frame_seconds)
    for number in range(frames):
        clock.now += frame_seconds
        view.frame(Progress(number + 1, frames + 1, FrameResult(number, 0.0, np.eye(4)), None, 1.0))
    assert 0.02 * clock.now < sum(spent) < 0.05 * clock.now
    assert max(np.diff(shown)) < 2.0 + frame_seconds + 0.6


def test_addresses():
    """Only this machine unless told otherwise; what is no port is refused."""
    assert Address.parse("") == Address("localhost", 8080)
    assert Address.parse("0.0.0.0:9000") == Address("0.0.0.0", 9000)
    assert Address.parse(":9000") == Address("localhost", 9000)
    assert Address.parse("example") == Address("example", 8080)
    for text in ("a:b", "a:-1", "a:70000"):
        with pytest.raises(ConfigError, match="HOST:PORT"):
            Address.parse(text)


def test_without_viser(monkeypatch, tmp_path, capsys):
    """A line that says what to install, before anything is computed."""
    monkeypatch.setitem(__import__("sys").modules, "viser", None)
    assert main(["demo", "--view", "-o", str(tmp_path / "run")]) == 2
    assert "pip install viser" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
    with pytest.raises(MissingDependencyError):
        LiveView(ANYWHERE).ready(FakeSlam(CAMERA), FakeSequence())


def test_several_look_on():
    """All are told, in their order, of everything that an observer can be told of."""
    told: list[tuple[int, str]] = []

    class Listener(Observer):
        def __init__(self, number: int) -> None:
            for name in vars(Observer):
                if not name.startswith("_"):
                    setattr(self, name, lambda *arguments, name=name: told.append((number, name)))

    names = [name for name in vars(Observer) if not name.startswith("_")]
    both = Observers(Listener(1), Listener(2))
    for name in names:
        getattr(both, name)(*range({"ready": 2, "close": 0}.get(name, 1)))
    assert told == [(number, name) for name in names for number in (1, 2)]


def run_with(observer: Observer, output, count: int = 6):
    config = Config.from_preset("live", [*SETTINGS, "grid.fine_spacing=0.16"])
    return run_sequence(SyntheticSequence(1, count, intrinsics=CAMERA), config, output, observer=observer, device="cpu")


def test_a_page_that_is_watched(monkeypatch, tmp_path):
    """A real run in a real browser: the page opens, its canvas is not empty, the frustum moves, the mesh comes; and
    the trajectory and the map have the bytes of a run that nobody watched.
    """
    pytest.importorskip("viser")
    pictures: list[np.ndarray] = []
    urls: list[str] = []

    class Pause(Observer):
        """Lets the browser look at single frames."""

        def frame(self, progress) -> None:
            for budget in view.budgets:
                budget.spent = -1e9  # what is shown is tested here, not what it costs
            if progress.done == 1:
                browser.open(view.page.url)
                wait_for(lambda: view.page.is_watched, 60)
            if progress.done in (2, 5):
                time.sleep(3.0)  # software draws a few frames a second
                pictures.append(browser.picture(tmp_path / f"{progress.done}.png"))

    view = LiveView(ANYWHERE, urls.append)
    monkeypatch.setattr(live, "_BLOCK_SECONDS", 2.0)
    with Browser(tmp_path / "profile", (800, 600)) as browser:
        watched = run_with(Observers(view, Pause()), tmp_path / "watched")
        time.sleep(3.0)
        pictures.append(browser.picture(tmp_path / "end.png"))
        text = browser.run("document.body.innerText")
        assert urls == [view.page.url] and "localhost" in urls[0]
        ended = threading.Thread(target=view.close)
        ended.start()
        wait_for(lambda: len(urls) == 2, 10)
        assert ended.is_alive()  # it stays while the page is open
        console = browser.console
    ended.join(60)
    assert not ended.is_alive(), "the page was closed"
    scene = [picture[:, : picture.shape[1] * 6 // 10].astype(int) for picture in pictures]
    for picture in scene:
        frustum = (np.abs(picture - [46, 134, 222]).max(axis=2) < 40).sum()
        assert frustum > 60, "no frustum"
    assert (np.abs(scene[-1] - 24).max(axis=2) > 30).mean() > 0.05, "an empty canvas"
    assert (np.abs(scene[0] - scene[1]).max(axis=2) > 30).sum() > 100, "nothing moved"
    for word in ("finished", "follow the camera", "input", "rendering", "mesh", "keyframes"):
        assert word in text
    assert not [line for line in console if "blob:" not in line]
    unwatched = run_with(Observer(), tmp_path / "unwatched")
    for name in ("trajectory.tum", "mesh.ply"):
        assert (watched.folder.path / name).read_bytes() == (unwatched.folder.path / name).read_bytes()


def test_nobody_watches(tmp_path, monkeypatch):
    """A run with a page that nobody opens ends by itself, and neither renders nor meshes."""
    pytest.importorskip("viser")
    asked = []

    class Slam(FakeSlam):
        keyframes: list = []

        def render(self, *arguments, **keywords):
            asked.append("render")
            return super().render(*arguments, **keywords)

    monkeypatch.setattr(pipeline, "build_slam", lambda camera, *others: Slam(camera))
    monkeypatch.setattr(pipeline, "draw_panels", lambda *arguments: None)
    view = LiveView(ANYWHERE)
    run_sequence(FakeSequence(4), Config(), tmp_path / "run", observer=view)
    view.close()
    assert asked == []


def test_chromium_is_there_in_ci():
    """Where the tests of pages are skipped, this says so first."""
    assert find_chromium()
