"""Frames are read and decoded while the one before is worked on."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from types import TracebackType

    from warpslam.sequences.base import Frame, RgbdSequence


class ReadAhead:
    """Reads frames of a sequence in the order given, one ahead of the one asked for; used in a ``with`` block.

    Args:
        sequence: Input; one that is rendered by kernels, or live, is not read ahead.
        indices: Frames in the order in which `take` returns them.
    """

    def __init__(self, sequence: RgbdSequence, indices: Sequence[int]) -> None:
        self.sequence, self.indices = sequence, indices
        self._taken = 0
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="warpslam-reading")
        self._ahead: Future[Frame] | None = None

    def __enter__(self) -> ReadAhead:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._worker.shutdown(wait=True, cancel_futures=True)

    def take(self) -> Frame:
        """The next frame.

        Raises:
            DatasetError: It can't be read; the next call goes on with the one after it.
            EndOfFrames: A live sequence has none any more.
        """
        number, self._taken = self._taken, self._taken + 1
        if self.sequence.is_live or not self.sequence.can_read_ahead:
            return self.sequence[self.indices[number]]
        current = self._ahead or self._start(number)
        self._ahead = self._start(number + 1) if number + 1 < len(self.indices) else None
        return current.result()

    def _start(self, number: int) -> Future[Frame]:
        return self._worker.submit(self.sequence.__getitem__, self.indices[number])
