"""What a finished map still gives: more refinement, and a mesh with a forecast."""

from __future__ import annotations

import numpy as np
import pytest

from warpslam.camera import Intrinsics
from warpslam.config import Config
from warpslam.errors import InputError
from warpslam.slam import Slam
from warpslam.synthetic import SyntheticSequence

CAMERA = Intrinsics(60.0, 60.0, 39.5, 29.5, 80, 60)
SETTINGS = [
    "tracking.use_given_poses=true",
    "tracking.ignore_edge_u=4",
    "tracking.ignore_edge_v=4",
    "mapping.pixels=200",
    "mapping.every=2",
    "mapping.first_iterations=60",
    "mapping.iterations=10",
    "mapping.coarse_iterations=4",
    "mapping.refinement_rounds=1",
    "keyframes.every=2",
    "meshing.voxel=0.04",
]


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """A finished map of three frames in a file."""
    sequence = SyntheticSequence(1, 3, intrinsics=CAMERA)
    slam = Slam(CAMERA, Config.from_preset("default", SETTINGS), "cpu")
    for n in range(3):
        frame = sequence[n]
        slam.step(frame.rgb, frame.depth, frame.timestamp, frame.T_world_camera)
    slam.finish()
    path = tmp_path_factory.mktemp("map") / "map.npz"
    slam.save(path)
    return path


def features(slam: Slam, level: str = "fine") -> np.ndarray:
    return slam.scene.grids[level].features.numpy()


def test_refinement_goes_on_with_new_draws(saved):
    """It changes the map, repeatably, further with more rounds, and by other random draws than `finish`."""
    once, again, twice = (Slam.load(saved, "cpu") for _ in range(3))
    before = features(once).copy()
    once.refine(1), again.refine(1), twice.refine(2)
    assert not np.array_equal(before, features(once))
    np.testing.assert_array_equal(features(once), features(again))
    assert not np.array_equal(features(once), features(twice))
    same_draws = Slam.load(saved, "cpu")
    same_draws._refine(2, 0, 1)
    assert not np.array_equal(features(once), features(same_draws))


def test_an_empty_map_can_not_be_refined():
    """The message says what is missing."""
    with pytest.raises(InputError, match="no keyframe"):
        Slam(CAMERA, Config.from_preset("default", SETTINGS), "cpu").refine()


def test_mesh_with_forecast(saved):
    """The coarse level adds cyan faces to the same seen mesh."""
    slam = Slam.load(saved, "cpu")
    seen, mesh = slam.mesh(), slam.mesh(forecast=True)
    count = mesh.metadata["forecast_faces"]
    assert count > 0 and len(mesh.faces) == len(seen.faces) + count
    assert np.array_equal(mesh.vertices[mesh.faces[:-count]], seen.vertices[seen.faces])
    cyan = (mesh.visual.vertex_colors == [0, 255, 255, 255]).all(axis=1)
    assert cyan[mesh.faces[-count:]].any() and not cyan[mesh.faces[:-count]].any()
