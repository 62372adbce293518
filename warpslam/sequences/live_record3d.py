"""An iPhone that runs Record3D and is plugged in, through the package record3d."""

from __future__ import annotations

import threading
import time

import cv2
import numpy as np

from warpslam.camera import Intrinsics
from warpslam.errors import DatasetError, MissingDependencyError
from warpslam.sequences.live import LiveCamera, LiveImages

_PATIENCE = 10.0  # [s]


class Record3dCamera(LiveCamera):
    """The first device on which Record3D streams over USB; colour is brought to the size of depth.

    Raises:
        MissingDependencyError: record3d is not installed.
        DatasetError: There is no device, or it does not stream.
    """

    def __init__(self) -> None:
        try:
            from record3d import Record3DStream
        except ImportError as error:
            raise MissingDependencyError("Record3D over USB needs record3d; type: pip install record3d") from error
        devices = Record3DStream.get_connected_devices()
        if not devices:
            raise DatasetError("no device with Record3D is plugged in; switch USB streaming on in the app")
        self._arrived, self._ended = threading.Semaphore(0), False
        self._stream = Record3DStream()
        self._stream.on_new_frame = self._arrived.release
        self._stream.on_stream_stopped = self._end
        self._stream.connect(devices[0])
        first = self.read()
        if first is None:
            raise DatasetError(f"Record3D sends nothing for {_PATIENCE:g} s; press the record button in the app")

    def read(self) -> LiveImages | None:
        """The next pair of images."""
        if not self._arrived.acquire(timeout=_PATIENCE) or self._ended:
            return None
        rgb, depth = np.array(self._stream.get_rgb_frame()), np.array(self._stream.get_depth_frame(), np.float32)
        k, (height, width) = self._stream.get_intrinsic_mat(), depth.shape
        camera = Intrinsics(k.fx, k.fy, k.tx, k.ty, rgb.shape[1], rgb.shape[0])
        self.intrinsics = camera.scaled(width, height)
        rgb = cv2.resize(rgb, (width, height), interpolation=cv2.INTER_AREA)
        return LiveImages(rgb, np.where(np.isfinite(depth), depth, np.float32(0)), time.monotonic())

    def _end(self) -> None:
        self._ended = True
        self._arrived.release()
