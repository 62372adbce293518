"""Runs on cameras that are running: fakes of a camera and of the SDKs."""

from __future__ import annotations

import sys
import threading
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from tests.fakes import CAMERA
from tests.pipeline.test_pipeline import fake_slam  # noqa: F401
from warpslam import cli
from warpslam.errors import DatasetError, MissingDependencyError
from warpslam.pipeline.live import run_live
from warpslam.sequences import open_sequence
from warpslam.sequences.base import EndOfFrames
from warpslam.sequences.live import LiveCamera, LiveImages, LiveSequence


class FakeCamera(LiveCamera):
    """Counts its images in red, each when it is let, and ends or fails after the last."""

    intrinsics = CAMERA

    def __init__(self, count: int, error: Exception | None = None) -> None:
        self.count, self.error, self.next, self.closed = count, error, 0, False
        self.go = threading.Semaphore(0)
        self.taken = threading.Semaphore(0)

    def read(self) -> LiveImages | None:
        self.taken.release()
        assert self.go.acquire(timeout=20)
        if self.next == self.count:
            if self.error is not None:
                raise self.error
            return None
        rgb = np.full((CAMERA.height, CAMERA.width, 3), 40 + self.next, np.uint8)
        self.next += 1
        return LiveImages(rgb, np.full(rgb.shape[:2], 2.0, np.float32), self.next / 30)

    def close(self) -> None:
        self.closed = True

    def send(self, count: int) -> None:
        """Let it take so many images, and wait until the last has been handed over."""
        for _ in range(count):
            assert self.taken.acquire(timeout=20)
            self.go.release()
        assert self.taken.acquire(timeout=20)
        self.taken.release()


def test_the_newest_is_used_and_the_others_are_counted(tmp_path):
    """While the engine is busy with one frame three come; it gets the last, and two are counted as dropped."""
    camera = FakeCamera(5)
    sequence = LiveSequence(camera, tmp_path / "run" / "recording")
    camera.send(1)
    assert sequence[0].rgb[0, 0, 0] == 40
    camera.send(3)
    frame = sequence[1]
    assert frame.rgb[0, 0, 0] == 43 and frame.index == 1 and sequence.dropped == 2
    camera.send(1)
    assert sequence[2].rgb[0, 0, 0] == 44
    camera.go.release()
    with pytest.raises(EndOfFrames):
        sequence[3]
    # What was used can be read again, here and as a folder.
    np.testing.assert_array_equal(sequence[1].rgb, frame.rgb)
    sequence.close()
    assert camera.closed
    again = open_sequence(tmp_path / "run" / "recording")
    assert len(again) == 3 and again.intrinsics == CAMERA
    np.testing.assert_array_equal(again[2].rgb, np.full((CAMERA.height, CAMERA.width, 3), 44, np.uint8))
    np.testing.assert_allclose(again[2].depth, 2.0, atol=2e-4)


def test_a_camera_that_fails(tmp_path):
    """Its error reaches who waits for images."""
    camera = FakeCamera(0, OSError("unplugged"))
    sequence = LiveSequence(camera, tmp_path / "recording")
    camera.go.release()
    with pytest.raises(DatasetError, match="the camera failed: unplugged"):
        sequence[0]


class FreeCamera(FakeCamera):
    """Runs by itself."""

    def __init__(self, count: int) -> None:
        super().__init__(count)
        for _ in range(count + 1):
            self.go.release()


@pytest.mark.usefixtures("fake_slam")
def test_a_live_run_writes_everything(tmp_path, caplog):
    """It ends with the camera, and its figures count the frames that there were."""
    result = run_live(FreeCamera(200), tmp_path / "run", device="cpu")
    metrics = result.metrics
    used = metrics.frames.processed
    assert result.status == "finished" and 1 <= used <= 200
    assert f"{used} frames used, {200 - used} dropped" in caplog.text
    assert result.folder.trajectory.is_file() and result.folder.mesh.is_file() and result.folder.report.is_file()
    assert len(open_sequence(tmp_path / "run-recording")) == used


def fake_realsense() -> ModuleType:
    """The part of pyrealsense2 that is used: two streams of a D435 that ends after three frames."""
    rs = ModuleType("pyrealsense2")
    rs.stream = SimpleNamespace(depth="depth", color="color")
    rs.format = SimpleNamespace(z16="z16", rgb8="rgb8")
    asked: list[tuple] = []
    k = SimpleNamespace(fx=60.0, fy=61.0, ppx=15.5, ppy=11.5, width=CAMERA.width, height=CAMERA.height)
    video = SimpleNamespace(as_video_stream_profile=lambda: SimpleNamespace(get_intrinsics=lambda: k))
    sensor = SimpleNamespace(get_depth_scale=lambda: 0.00025)
    profile = SimpleNamespace(
        get_device=lambda: SimpleNamespace(first_depth_sensor=lambda: sensor), get_stream=lambda stream: video
    )

    class Pipeline:
        def __init__(self) -> None:
            self.count = 0

        def start(self, config):
            return profile

        def wait_for_frames(self):
            self.count += 1
            if self.count > 3:
                raise RuntimeError("Frame didn't arrive within 5000")
            return self.count

        def stop(self):
            asked.append(("stop",))

    class Align:
        def __init__(self, stream) -> None:
            asked.append(("align", stream))

        def process(self, count):
            rgb = np.full((CAMERA.height, CAMERA.width, 3), 60 + count, np.uint8)
            depth = np.full(rgb.shape[:2], 8000, np.uint16)
            color = SimpleNamespace(get_data=lambda: rgb, get_timestamp=lambda: 1000.0 * count / 30)
            return SimpleNamespace(
                get_color_frame=lambda: color, get_depth_frame=lambda: SimpleNamespace(get_data=lambda: depth)
            )

    rs.pipeline, rs.align, rs.asked = Pipeline, Align, asked
    rs.config = lambda: SimpleNamespace(enable_stream=lambda *arguments: asked.append(arguments))
    return rs


def test_realsense(monkeypatch):
    """Streams, unit, camera and times of the SDK; depth is aligned to colour."""
    from warpslam.sequences.live_realsense import RealSenseCamera

    rs = fake_realsense()
    monkeypatch.setitem(sys.modules, "pyrealsense2", rs)
    camera = RealSenseCamera((848, 480), 60)
    assert ("depth", 848, 480, "z16", 60) in rs.asked and ("align", "color") in rs.asked
    assert (camera.intrinsics.fx, camera.intrinsics.cx) == (60.0, 15.5)
    images = camera.read()
    assert images.timestamp == pytest.approx(1 / 30) and images.rgb[0, 0, 0] == 61
    np.testing.assert_allclose(images.depth, 2.0)
    camera.close()
    assert ("stop",) in rs.asked


def test_missing_packages_and_cameras(monkeypatch, capsys):
    """What to install, and that nothing is plugged in."""
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    monkeypatch.setitem(sys.modules, "record3d", None)
    for name, package in (("realsense", "pyrealsense2"), ("record3d", "record3d")):
        assert cli.main(["live", name]) == 2
        assert f"pip install {package}" in capsys.readouterr().err
    stream = SimpleNamespace(get_connected_devices=lambda: [])
    monkeypatch.setitem(sys.modules, "record3d", SimpleNamespace(Record3DStream=stream))
    from warpslam.sequences.live_record3d import Record3dCamera

    with pytest.raises(DatasetError, match="no device with Record3D"):
        Record3dCamera()
    with pytest.raises(MissingDependencyError):
        monkeypatch.setitem(sys.modules, "record3d", None)
        Record3dCamera()
