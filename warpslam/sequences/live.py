"""Frames of a camera that is running: the newest is used, those that came meanwhile are dropped and counted."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from warpslam.camera import Intrinsics
from warpslam.errors import DatasetError, OutputError
from warpslam.sequences.base import EndOfFrames, Frame, RgbdSequence
from warpslam.sequences.calibration import CAMERA_FILE, Calibration

MAX_FRAMES = 1_000_000
_UNITS = 5000.0  # stored units a metre of what is recorded: 13 m in 16 bits
_PATIENCE = 10.0  # [s] without an image before the camera counts as gone


@dataclass(frozen=True)
class LiveImages:
    """What a camera saw at one moment."""

    rgb: np.ndarray
    """uint8 (H, W, 3), RGB order."""
    depth: np.ndarray
    """z-depth registered to colour [m], float32 (H, W), 0 = missing."""
    timestamp: float
    """[s]."""


class LiveCamera(ABC):
    """A camera to run SLAM on.

    intrinsics: Of its colour images, and of depth, which is registered to them.
    """

    intrinsics: Intrinsics

    @abstractmethod
    def read(self) -> LiveImages | None:
        """Wait for the next images; None where there will be no more."""

    def close(self) -> None:  # noqa: B027
        """Let the camera go."""


class LiveSequence(RgbdSequence):
    """The frames of a camera, as fast as they can be used. Those that are used are kept in a folder, from which they
    can be read again, also by another run.

    Args:
        camera: The camera.
        folder: Folder to record into; color/, depth/ and camera.yaml, as `warpslam run` reads it.
        max_frames: Frames to use at most.

    Raises:
        OutputError: The folder can't be written.
    """

    is_live = True

    def __init__(self, camera: LiveCamera, folder: Path, max_frames: int = MAX_FRAMES) -> None:
        self.name = folder.parent.name or "live"
        self.intrinsics = camera.intrinsics
        self.dropped = 0
        self.timestamps = np.zeros(0)
        self._camera, self._folder, self._max_frames = camera, folder, max_frames
        self._times: list[float] = []
        self._newest: LiveImages | None = None
        self._error: BaseException | None = None
        self._ended = self._stopped = False
        self._changed = threading.Condition()
        try:
            for name in ("color", "depth"):
                (folder / name).mkdir(parents=True, exist_ok=True)
            text = Calibration(camera.intrinsics, _UNITS).to_yaml()
            (folder / CAMERA_FILE).write_text(text, encoding="utf-8")
        except OSError as error:
            raise OutputError(f"{folder}: can't be written ({error.strerror})") from error
        self._thread = threading.Thread(target=self._watch, name="camera", daemon=True)
        self._thread.start()

    def __len__(self) -> int:
        return self._max_frames

    def __getitem__(self, index: int) -> Frame:
        """A frame that was used, or, at the end of them, the newest there is.

        Raises:
            EndOfFrames: The camera has ended.
            DatasetError: It gives no images.
        """
        if index < len(self._times):
            return self._recorded(index)
        images = self._take()
        index = len(self._times)
        self._record(index, images)
        return Frame(index, images.timestamp, images.rgb, images.depth)

    def close(self) -> None:
        """Stop the camera."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()
        self._thread.join(timeout=_PATIENCE)
        self._camera.close()

    def _watch(self) -> None:
        """Read the camera in a thread of its own, so that none of its images is old when it is used."""
        try:
            while not self._stopped and (images := self._camera.read()) is not None:
                with self._changed:
                    self.dropped += self._newest is not None
                    self._newest = images
                    self._changed.notify_all()
        except BaseException as error:  # handed to the thread that waits for images
            self._error = error
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def _take(self) -> LiveImages:
        with self._changed:
            arrived = self._changed.wait_for(lambda: self._newest is not None or self._ended, timeout=_PATIENCE)
            images, self._newest = self._newest, None
        if images is not None:
            return images
        if self._error is not None:
            raise DatasetError(f"the camera failed: {self._error}") from self._error
        if arrived:
            raise EndOfFrames
        raise EndOfFrames(f"no image for {_PATIENCE:g} s")

    def _record(self, index: int, images: LiveImages) -> None:
        import cv2

        depth = np.clip(np.rint(images.depth * _UNITS), 0, 65535).astype(np.uint16)
        color = np.ascontiguousarray(images.rgb[..., ::-1])
        fast = [cv2.IMWRITE_PNG_COMPRESSION, 1]
        for kind, image in (("color", color), ("depth", depth)):
            if not cv2.imwrite(str(self._folder / kind / f"{index:06d}.png"), image, fast):
                raise OutputError(f"{self._folder}: can't be written; check that the disk has room")
        self._times.append(images.timestamp)
        self.timestamps = np.array(self._times)

    def _recorded(self, index: int) -> Frame:
        from warpslam.sequences.image_files import read_depth, read_rgb

        rgb = read_rgb(self._folder / "color" / f"{index:06d}.png")
        depth = read_depth(self._folder / "depth" / f"{index:06d}.png") / np.float32(_UNITS)
        return Frame(index, self._times[index], rgb, depth.astype(np.float32))
