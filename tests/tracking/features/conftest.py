"""Rendered views of a room that the tests of features share."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from warpslam.sequences import Frame
from warpslam.synthetic import SyntheticSequence


@pytest.fixture(scope="session")
def room() -> tuple[SyntheticSequence, list[Frame]]:
    """A furnished room of 320 x 240 and ten frames of a walk through it."""
    sequence = SyntheticSequence(3, 90)
    return sequence, [sequence[n] for n in range(10)]


@pytest.fixture(scope="session")
def grey() -> object:
    """Grey image of a frame."""
    return lambda frame: cv2.cvtColor(np.ascontiguousarray(frame.rgb), cv2.COLOR_RGB2GRAY)
