"""A finished run in the browser."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from tests.browser import Browser, wait_for
from tests.fakes import FakeSequence, FakeSlam, run_sequence
from warpslam.cli import main
from warpslam.config import Config
from warpslam.errors import DatasetError
from warpslam.pipeline import run as pipeline
from warpslam.runs.folder import RunFolder
from warpslam.runs.request import Source
from warpslam.viewer import finished
from warpslam.viewer.finished import FinishedView
from warpslam.viewer.page import Address

ANYWHERE = Address("localhost", 0)


@pytest.fixture
def folder(monkeypatch, tmp_path) -> RunFolder:
    """A run of eight frames before a wall, whose input and map can be opened again."""
    monkeypatch.setattr(pipeline, "build_slam", lambda camera, *others: FakeSlam(camera))
    for name in ("draw_plots", "draw_panels", "write_report"):
        monkeypatch.setattr(pipeline, name, lambda *arguments: None)
    monkeypatch.setattr(finished, "open_source", lambda source: FakeSequence(8))
    monkeypatch.setattr(finished, "load_slam", lambda run, device=None: FakeSlam.load(run.map, device))
    run_sequence(FakeSequence(8), Config(), tmp_path / "run", source=Source("somewhere"))
    return RunFolder(tmp_path / "run")


def test_slider_over_a_run(folder, tmp_path):
    """The page opens at the last frame, shows mesh, input and rendering, and the frustum goes where the slider is."""
    pytest.importorskip("viser")
    view = FinishedView(folder, ANYWHERE)
    is_on = threading.Event()
    is_on.set()
    serving = threading.Thread(target=view.serve, args=(is_on.is_set,))
    serving.start()
    try:
        with Browser(tmp_path / "profile", (900, 700)) as browser:
            browser.open(view.page.url)
            wait_for(lambda: view.page.is_watched, 60)
            wait_for(lambda: "frame 7 (8 of 8)" in browser.run("document.body.innerText"), 60)

            def frustum() -> np.ndarray:
                picture = browser.picture(tmp_path / "page.png").astype(int)[:, :540]
                found = np.argwhere(np.abs(picture - [46, 134, 222]).max(axis=2) < 40)
                return found.mean(axis=0) if len(found) > 30 else np.full(2, np.nan)

            wait_for(lambda: np.isfinite(frustum()).all(), 60)
            last = frustum()
            view.show(0)
            wait_for(lambda: "frame 0 (1 of 8)" in browser.run("document.body.innerText"), 60)
            wait_for(lambda: np.linalg.norm(frustum() - last) > 3, 60)
            text = browser.run("document.body.innerText")
            assert all(word in text for word in ("play", "input", "follow the camera", "error 0."))
            wait_for(lambda: "rendering" in browser.run("document.body.innerText"), 60)  # after the slider rested
            assert not [line for line in browser.console if "blob:" not in line]
    finally:
        is_on.clear()
        serving.join(30)
    assert not serving.is_alive()


def test_without_input_and_map(folder, monkeypatch, caplog):
    """What is gone is said, and the rest is shown."""
    pytest.importorskip("viser")

    def gone(*_, **__):
        raise DatasetError("somewhere: no such folder")

    monkeypatch.setattr(finished, "open_source", gone)
    monkeypatch.setattr(finished, "load_slam", gone)
    view = FinishedView(folder, ANYWHERE)
    view.show(3)
    view.serve(lambda: False)
    assert "its input can't be shown" in caplog.text and "its map can't be rendered" in caplog.text


def test_command(folder, monkeypatch, capsys):
    """`warpslam view` says where the page is; what is no run is refused in one line."""
    pytest.importorskip("viser")
    monkeypatch.setattr(FinishedView, "serve", lambda self: self.page.close())
    assert main(["view", str(folder.path), "--at", "localhost:0"]) == 0
    assert "http://localhost:" in capsys.readouterr().out
    assert main(["view", str(folder.path / "nowhere")]) == 2
    assert "is no run folder" in capsys.readouterr().err
    start = time.monotonic()
    assert main(["view", str(folder.path), "--at", "localhost:99999"]) == 2 and time.monotonic() - start < 60
