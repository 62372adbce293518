"""Frames of a video file, by number."""

from __future__ import annotations

from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np

from warpslam.errors import DatasetError
from warpslam.reading import check_regular

_KEPT = 8  # decoded images; a frame is often read twice, by the check and by the run


class Video:
    """A video whose frames can be asked for in any order; asked for one after another, each is decoded once.

    Args:
        path: Any file that OpenCV reads.

    Raises:
        DatasetError: It can't be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._capture: Any = None
        self._next = 0
        self._cache: OrderedDict[int, np.ndarray] = OrderedDict()
        try:
            check_regular(path)
        except OSError as error:
            raise DatasetError(f"{path}: can't be read ({error.strerror}); is it a video?") from error
        import cv2

        self.frame_count = int(self._opened().get(cv2.CAP_PROP_FRAME_COUNT))
        self.rate = float(self._opened().get(cv2.CAP_PROP_FPS)) or 30.0
        if self.frame_count < 1:
            raise DatasetError(f"{path}: no video that OpenCV reads; convert it with ffmpeg, or to a folder of images")

    def __getitem__(self, index: int) -> np.ndarray:
        """Frame, uint8 (H, W, 3), RGB order.

        Raises:
            DatasetError: The video ends before, or is damaged.
        """
        if index in self._cache:
            return self._cache[index]
        if index < self._next:  # a seek by number lands on a key frame in some codecs; reading from the start does not
            self._capture = None
        capture = self._opened()
        while self._next <= index:
            read = capture.grab()
            self._next += 1
            if not read:
                raise DatasetError(f"{self.path}: ends or is damaged at frame {self._next - 1} of {self.frame_count}")
        found, image = capture.retrieve()
        if not found:
            raise DatasetError(f"{self.path}: frame {index} can't be decoded")
        self._cache[index] = np.ascontiguousarray(image[..., ::-1])
        while len(self._cache) > _KEPT:
            self._cache.popitem(last=False)
        return self._cache[index]

    def _opened(self) -> Any:
        if self._capture is None:
            import cv2

            self._capture, self._next = cv2.VideoCapture(str(self.path)), 0
            self._capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        return self._capture
