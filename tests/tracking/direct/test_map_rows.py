"""Points of a frame against the surface of a map, as rows of the pose's normal equations."""

import numpy as np
import pytest
import warp as wp

from tests.tracking.direct.conftest import CAMERA, ROOM
from warpslam import Slam
from warpslam.camera import FrameMotion
from warpslam.config import Config
from warpslam.kernels.direct import registration
from warpslam.poses import inverse, motion_between, motion_of, twist_of
from warpslam.tracking.direct.map_rows import MapRows
from warpslam.tracking.direct.pyramid import records
from warpslam.tracking.direct.tracker import SCRATCH

AWAY = np.array([0.012, -0.008, 0.015, 0.004, -0.006, 0.003])


@pytest.fixture(scope="module", params=wp.get_devices(), ids=str)
def mapped(request) -> Slam:
    """A map of the room, from one frame by the direct loss; the frame is in slot 0 and in the registrar."""
    sharp = ["supervision.near_samples=8", "supervision.free_samples=4"]
    config = Config.from_preset("live", ["mapping.pixels=400", *sharp])
    slam = Slam(CAMERA, config, request.param)
    slam.step(*ROOM.take(CAMERA, np.eye(4), FrameMotion()), T_world_camera=np.eye(4))
    return slam


def rows_at(slam: Slam, T_frame_reference: np.ndarray, T_world_reference: np.ndarray) -> np.ndarray:
    registrar = slam.direct.registrar
    registrar.select(slam.direct.row_of(0), SCRATCH)
    pose = records(registration.Result)
    pose["T"] = T_frame_reference
    poses = wp.array(pose, dtype=registration.Result, device=slam.device)
    rows = wp.zeros(2, dtype=registration.OtherRows, device=slam.device)
    MapRows(registrar, 0, 1.0).add(slam.scene.arrays(), poses, T_world_reference, SCRATCH, rows, 1)
    return rows.numpy()[1]


@pytest.mark.parametrize("reference", [np.zeros(6), np.array([0.4, -0.2, 0.3, 0.5, -0.3, 0.2])])
def test_steps_lead_back(mapped, reference):
    """From a pose that is 2 cm and half a degree off, steps of the rows lead back, wherever the reference is."""
    W = motion_of(reference)
    true, T = W, motion_of(AWAY) @ W  # the frame was taken at the world's origin
    found, first = rows_at(mapped, T, W), T
    for _ in range(4):
        H, g = found["H"].astype(np.float64), found["g"].astype(np.float64)
        np.testing.assert_allclose(found["T"], T, atol=1e-6)
        np.testing.assert_allclose(H, H.T, rtol=1e-3, atol=1e-3 * np.abs(H).max())
        T = motion_of(-np.linalg.solve(H + 1e-3 * np.diag(H.diagonal()), g)) @ T
        found = rows_at(mapped, T, W)
    before, after = (twist_of(one @ inverse(true)) for one in (first, T))
    # As far as depth sees it: along a wall nothing leads back.
    assert after @ H @ after < 0.1 * (before @ H @ before)
    assert np.linalg.norm(after[3:]) < 0.5 * np.linalg.norm(before[3:])


def test_what_no_frame_has_mapped_says_nothing(mapped):
    """A camera that looks from far outside gets no rows."""
    found = rows_at(mapped, inverse(motion_of(np.array([50.0, 0, 0, 0, 0, 0]))), np.eye(4))
    assert not found["H"].any() and not found["g"].any()


def test_joined_by_the_map_it_still_tracks():
    """With the map's rows in the system the camera is found as well as without, and differently."""
    paths = [motion_of(n * np.array([0.02, 0.004, 0.01, 0.003, -0.01, 0.002])) for n in range(4)]
    ends = []
    for weight in (0.0, 1.0):
        config = Config.from_preset("live", ["mapping.pixels=400", f"direct.map_weight={weight}"])
        slam = Slam(CAMERA, config, "cpu")
        for n, pose in enumerate(paths):
            result = slam.step(*ROOM.take(CAMERA, pose, FrameMotion()), T_world_camera=pose if n == 0 else None)
        step, turn = motion_between(result.T_world_camera, paths[-1])
        assert step < 4e-3 and turn < 0.2
        ends.append(result.T_world_camera)
    assert (ends[0] != ends[1]).any()
