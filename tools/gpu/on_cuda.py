"""A pytest plugin: every `Slam` that a test makes runs on the GPU, whatever device the test names.

    PYTHONPATH=tools/gpu python -m pytest -p on_cuda tests/test_slam.py

Tests that ask for the same bytes twice are expected to fail where sums are formed by atomics; they are kept, because
that is what the run is to show.
"""

from __future__ import annotations

import inspect
import os
from collections.abc import Iterator
from typing import Any

import pytest


@pytest.fixture(autouse=True, scope="session")
def slam_on_the_gpu() -> Iterator[None]:
    """Replace the device of `Slam` by the one that CHECK_DEVICE names (cuda:0)."""
    from warpslam.slam import Slam

    device = os.environ.get("CHECK_DEVICE", "cuda:0")
    original = Slam.__init__
    signature = inspect.signature(original)

    def init(*arguments: Any, **keywords: Any) -> None:
        bound = signature.bind(*arguments, **keywords)
        bound.arguments["device"] = device
        original(*bound.args, **bound.kwargs)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Slam, "__init__", init)
        yield
