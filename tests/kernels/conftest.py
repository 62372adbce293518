"""Fixtures of the kernel tests: every device there is, and the scene recorded from the authors' implementation."""

from __future__ import annotations

import pytest
import warp as wp

from tests.reference.golden import GoldenScene


@pytest.fixture(scope="session", params=[device.alias for device in wp.get_devices()])
def device(request) -> wp.Device:
    """The CPU always, and each CUDA device."""
    return wp.get_device(request.param)


@pytest.fixture(scope="session")
def scene(golden) -> GoldenScene:
    """The recorded scene in warpslam's conventions."""
    return GoldenScene.load(golden)
