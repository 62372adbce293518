"""Whole images: what they take."""

from __future__ import annotations

import numpy as np
import pytest

from tests.test_slam import CAMERA, new_slam
from warpslam.field import rendering
from warpslam.field.ray_batch import RayBatch
from warpslam.synthetic import SyntheticSequence


@pytest.fixture(scope="module")
def seen():
    """A map of a frame, and the pose of that."""
    slam = new_slam("mapping.first_iterations=10")
    frame = SyntheticSequence(1, 4, intrinsics=CAMERA)[0]
    slam.step(frame.rgb, frame.depth, frame.timestamp, frame.T_world_camera)
    return slam, frame.T_world_camera


@pytest.mark.parametrize("stride", [1, 5])
def test_no_more_rays_than_pixels(seen, monkeypatch, stride):
    """A small image takes no room for rays that it does not have, which would change nothing of it."""
    room = []

    def batch(capacity, *others):
        room.append(capacity)
        return RayBatch(max(room[-1], least), *others)

    slam, pose = seen
    monkeypatch.setattr(rendering, "RayBatch", batch)
    least = 0
    tight = slam.render(pose, stride=stride)
    least = rendering.RAYS_PER_CHUNK
    roomy = slam.render(pose, stride=stride)
    assert max(room) <= tight.depth.size
    for name in ("depth", "rgb", "variance"):
        np.testing.assert_array_equal(getattr(tight, name), getattr(roomy, name))
