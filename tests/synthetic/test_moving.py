"""The sequence with a moving object: what moves, what stands still, and what is exact."""

from __future__ import annotations

import numpy as np
import pytest
from trimesh.proximity import closest_point_naive

from warpslam.camera import Intrinsics
from warpslam.errors import InputError
from warpslam.synthetic import MovingObjectSequence

CAMERA = Intrinsics(50.0, 50.0, 31.5, 23.5, 64, 48)


@pytest.fixture(scope="module")
def sequence() -> MovingObjectSequence:
    return MovingObjectSequence(2, 40, intrinsics=CAMERA)


def world_points(sequence: MovingObjectSequence, index: int) -> np.ndarray:
    """World points of every pixel, shape (H, W, 3)."""
    frame, k = sequence[index], sequence.intrinsics
    v, u = np.mgrid[: k.height, : k.width]
    rays = np.stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones(u.shape)], axis=-1)
    T = frame.T_world_camera
    return (rays * frame.depth[..., None]) @ T[:3, :3].T + T[:3, 3]


def test_an_object_of_furniture_size_crosses_the_view(sequence):
    """The object is seen in every frame, and goes more than half a metre, in the middle three fifths of the frames."""
    shares = [sequence.object_mask(index).mean() for index in range(0, 40, 4)]
    assert min(shares) > 0.01 and 0.04 < max(shares) < 0.5
    steps = np.linalg.norm(np.diff(sequence.object_poses[:, :3, 3], axis=0), axis=1)
    assert steps.sum() > 0.5
    assert sequence.moving_frames == range(8, 32)
    assert (steps[:8] == 0).all() and (steps[31:] == 0).all() and (steps[10:28] > 0).all()
    assert 0.3 < np.ptp(sequence.object_mesh.bounds, axis=0).max() < 1.6


def test_masked_pixels_lie_on_the_object_and_the_others_on_the_room(sequence):
    """Depth, pose, mask and object pose agree: masked points, moved into the object's frame, lie on its mesh."""
    index = 20
    points, mask = world_points(sequence, index), sequence.object_mask(index)
    T = np.linalg.inv(sequence.object_poses[index])
    local = points[mask][::7] @ T[:3, :3].T + T[:3, 3]
    assert closest_point_naive(sequence.object_mesh, local)[1].max() < 1e-3
    still = sequence.static_frame(index)
    np.testing.assert_array_equal(sequence[index].depth[~mask], still.depth[~mask])
    assert (sequence[index].depth[mask] < still.depth[mask]).all()
    assert (sequence[index].rgb[mask] != still.rgb[mask]).any(axis=1).mean() > 0.9


def test_the_object_touches_neither_room_nor_camera(sequence):
    """All along its way the object's vertices are in free space, and the camera keeps its distance."""
    for index in range(0, 40, 3):
        T = sequence.object_poses[index]
        vertices = sequence.object_mesh.vertices @ T[:3, :3].T + T[:3, 3]
        assert sequence.room.free_space(vertices).all()
        eye = sequence.ground_truth()[index, :3, 3]
        assert np.linalg.norm(vertices - eye, axis=1).min() > 0.3


def test_seeds_decide(sequence):
    """The same seeds give the same frames, another object seed another object in the same room."""
    again = MovingObjectSequence(2, 40, intrinsics=CAMERA)
    np.testing.assert_array_equal(again[17].depth, sequence[17].depth)
    np.testing.assert_array_equal(again[17].rgb, sequence[17].rgb)
    other = MovingObjectSequence(2, 40, intrinsics=CAMERA, object_seed=1)
    np.testing.assert_array_equal(other.static_frame(17).depth, sequence.static_frame(17).depth)
    assert not np.array_equal(other.object_mask(17), sequence.object_mask(17))


def test_too_few_frames_are_refused():
    """Nothing can move in nine frames."""
    with pytest.raises(InputError, match="frame_count = 9"):
        MovingObjectSequence(0, 9)
