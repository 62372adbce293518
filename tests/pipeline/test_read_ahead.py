"""Frames that are read before they are asked for."""

import threading

import numpy as np
import pytest

from warpslam.camera import Intrinsics
from warpslam.errors import DatasetError
from warpslam.pipeline.read_ahead import ReadAhead
from warpslam.sequences.base import Frame, RgbdSequence


class Watched(RgbdSequence):
    """Says which frames were read, and by which thread."""

    name, intrinsics = "watched", Intrinsics(10.0, 10.0, 3.5, 2.5, 8, 6)

    def __init__(self) -> None:
        self.read: list[int] = []
        self.threads: set[str] = set()
        self.is_read = threading.Semaphore(0)

    def __len__(self) -> int:
        return 9

    def __getitem__(self, index: int) -> Frame:
        self.read.append(index)
        self.threads.add(threading.current_thread().name)
        self.is_read.release()
        if index == 4:
            raise DatasetError("frame 4 is torn")
        return Frame(index, float(index), np.zeros((6, 8, 3), np.uint8), np.ones((6, 8), np.float32), None)


def test_one_ahead_and_no_further():
    """The next frame is read without being asked for, the one after it is not."""
    sequence = Watched()
    with ReadAhead(sequence, range(0, 9, 2)) as reader:
        assert reader.take().index == 0
        for _ in range(2):
            assert sequence.is_read.acquire(timeout=10)
        assert sequence.read == [0, 2]
        assert reader.take().index == 2
        with pytest.raises(DatasetError, match="torn"):
            reader.take()
        assert [reader.take().index for _ in range(2)] == [6, 8]
    assert sequence.read == [0, 2, 4, 6, 8] and threading.current_thread().name not in sequence.threads


def test_what_kernels_render_is_read_when_it_is_asked_for():
    """No second thread launches kernels."""
    sequence = Watched()
    sequence.can_read_ahead = False
    with ReadAhead(sequence, [3, 1]) as reader:
        assert [reader.take().index for _ in range(2)] == [3, 1]
    assert sequence.threads == {threading.current_thread().name}
