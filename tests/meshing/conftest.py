"""Devices and the mesh of the whole room, made once."""

from __future__ import annotations

import pytest
import warp as wp

from tests.meshing.ball_room import BallRoom, views_of_everything
from warpslam.meshing import extract_mesh


@pytest.fixture(scope="session", params=["cpu"] + (["cuda:0"] if wp.is_cuda_available() else []))
def device(request):
    """Every Warp device of this machine."""
    return request.param


@pytest.fixture(scope="session")
def everything():
    """All views of the room."""
    return views_of_everything()


@pytest.fixture(scope="session")
def mesh(everything, device):
    """The room at 2 cm with everything seen."""
    return extract_mesh(BallRoom(), everything, device=device)
