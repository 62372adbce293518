"""Loops that were closed, in all that shows a run."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from tests.fakes import FakeSequence, FakeSlam, run_sequence
from warpslam.config import Config
from warpslam.pipeline import run as pipeline
from warpslam.runs.folder import RunFolder
from warpslam.storage.tum import read_tum
from warpslam.viewer import finished, page
from warpslam.viewer.finished import FinishedView
from warpslam.viewer.live import LiveView
from warpslam.viewer.loops import LOOP_COLOR, loop_lines, loops_of
from warpslam.viewer.page import Address
from warpslam.viewer.recording import RerunRecording

ANYWHERE = Address("localhost", 0)
FRAMES = 8
LATER = 5
"""Frame at which the loop between the frames 4 and 0 is closed."""


class Looping(FakeSlam):
    """Closes a loop in the sixth frame, and moves frame 0 in the last one."""

    def __init__(self, intrinsics, **settings):
        super().__init__(intrinsics, **settings)
        self.loops = SimpleNamespace(edges=[])

    def step(self, *frame, **more):
        result = super().step(*frame, **more)
        if result.index == LATER:
            self.loops.edges.append((0, 4))
        return result

    @property
    def trajectory(self):
        trajectory = super().trajectory
        if len(self.results) == FRAMES:
            trajectory.poses[0, 1, 3] += 0.25
        return trajectory


@pytest.fixture
def looping(monkeypatch):
    """Runs are of that."""
    monkeypatch.setattr(pipeline, "build_slam", lambda camera, *others: Looping(camera))
    for name in ("draw_plots", "draw_panels", "write_report"):
        monkeypatch.setattr(pipeline, name, lambda *arguments: None)


@pytest.fixture
def drawn(monkeypatch):
    """The scene of a page: the lines that it was sent, and None where they were taken away."""
    viser = pytest.importorskip("viser")
    sent: list[np.ndarray | None] = []
    add, remove = viser.SceneApi.add_line_segments, viser.SceneApi.remove_by_name

    def note(self, name, points, colors, *others, **more):
        if name == "/loops/lines":
            assert colors == LOOP_COLOR
            sent.append(np.array(points))
        return add(self, name, points, colors, *others, **more)

    def forget(self, name):
        if name == "/loops/lines":
            sent.append(None)
        remove(self, name)

    monkeypatch.setattr(viser.SceneApi, "add_line_segments", note)
    monkeypatch.setattr(viser.SceneApi, "remove_by_name", forget)
    return sent


def test_lines_are_between_the_frames_of_a_loop():
    """Loops with a frame that is not there yet are left out; a method that closes none has none."""
    positions = np.arange(12.0).reshape(4, 3)
    lines = loop_lines([(0, 3), (1, 4), (2, 1)], positions)
    np.testing.assert_array_equal(lines, [[positions[0], positions[3]], [positions[2], positions[1]]])
    assert loop_lines([], positions).shape == (0, 2, 3) and loops_of(object()) == []
    assert loops_of(SimpleNamespace(loops=None)) == []


def test_recording(looping, tmp_path):
    """A line from the frame in which the loop was closed, and again where its poses have moved."""
    pytest.importorskip("rerun")
    from rerun.chunk import RrdReader

    run_sequence(FakeSequence(FRAMES), Config(), tmp_path / "run", observer=RerunRecording(tmp_path / "run.rrd"))
    found = {}
    for chunk in RrdReader(tmp_path / "run.rrd").stream().to_chunks():
        if str(chunk.entity_path) == "/world/loops":
            table = chunk.to_record_batch().to_pydict()
            strips = table[next(name for name in table if name.endswith("strips"))]
            found |= dict(zip(table["frame"], strips, strict=True))
    _, poses = read_tum(tmp_path / "run" / "trajectory.tum")
    assert sorted(found) == [LATER, FRAMES - 1]
    np.testing.assert_allclose(found[FRAMES - 1], [poses[[0, 4], :3, 3]], atol=1e-5)
    shift = np.array(found[FRAMES - 1]) - found[LATER]
    np.testing.assert_allclose(shift, [[[0, 0.25, 0], [0, 0, 0]]], atol=1e-5)


def test_live_page(looping, drawn, monkeypatch, tmp_path):
    """The line comes when the loop is closed, and follows its keyframes."""
    monkeypatch.setattr(page.Page, "is_watched", True)
    monkeypatch.setattr(page.Page, "wait_while_watched", lambda self: None)
    monkeypatch.setattr("warpslam.viewer.live._MIN_INTERVAL", 0.0)
    monkeypatch.setattr("warpslam.viewer.live._MAX_INTERVAL", 0.0)
    run_sequence(FakeSequence(FRAMES), Config(), tmp_path / "run", observer=LiveView(ANYWHERE))
    _, poses = read_tum(tmp_path / "run" / "trajectory.tum")
    assert len(drawn) == 2
    np.testing.assert_allclose(drawn[1], [poses[[0, 4], :3, 3]], atol=1e-5)
    np.testing.assert_allclose(drawn[1] - drawn[0], [[[0, 0.25, 0], [0, 0, 0]]], atol=1e-5)


@pytest.mark.parametrize("before", [0, 3])
def test_finished_page(looping, drawn, monkeypatch, tmp_path, before):
    """`warpslam view`: the loop is there from the later of its frames on, also where the map has frames of its own."""
    run_sequence(FakeSequence(FRAMES), Config(), tmp_path / "run")
    _, poses = read_tum(tmp_path / "run" / "trajectory.tum")
    earlier = np.tile(np.eye(4), (before, 1, 1))
    earlier[:, 0, 3] = -1.0 - np.arange(before)
    loaded = SimpleNamespace(trajectory=SimpleNamespace(poses=np.concatenate([earlier, poses])))
    monkeypatch.setattr(finished, "open_source", lambda source: FakeSequence(FRAMES))
    monkeypatch.setattr(finished, "load_slam", lambda run, device=None: loaded)
    view = FinishedView(RunFolder(tmp_path / "run"), ANYWHERE)
    try:
        everything = np.concatenate([earlier, poses])
        np.testing.assert_allclose(drawn[-1], [everything[[0, 4], :3, 3]], atol=1e-5)
        view.show(4 - before)
        assert drawn[-1] is not None
        view.show(3 - before)
        assert drawn[-1] is None
    finally:
        view.page.close()
