"""What a finished map still gives: more refinement, and a mesh with a forecast."""

from __future__ import annotations

import math

import numpy as np
import pytest

from warpslam.camera import Intrinsics
from warpslam.config import Config
from warpslam.errors import InputError
from warpslam.evaluation import psnr
from warpslam.mapping.window import keyframes_in_turn
from warpslam.scene.keyframes import Keyframe
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
    return slam.scene.grids[level].state().features


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


def test_refinement_takes_the_haze_away():
    """Views that were mapped render better after `finish` than before: their colours, and depth at the surface."""
    sequence = SyntheticSequence(1, 4, intrinsics=CAMERA)
    slam = Slam(CAMERA, Config.from_preset("default", [*SETTINGS, "mapping.pixels=600", "mapping.every=1"]), "cpu")
    frames = [sequence[n] for n in range(4)]
    for frame in frames:
        slam.step(frame.rgb, frame.depth, frame.timestamp, frame.T_world_camera)

    def errors() -> tuple[float, float]:
        views = [slam.render(frame.T_world_camera, depth=frame.depth) for frame in frames]
        known = [frame.depth > 0 for frame in frames]
        depth = [np.abs(view.depth - f.depth)[k].mean() for view, f, k in zip(views, frames, known, strict=True)]
        return float(np.mean(depth)), float(np.mean([psnr(v.rgb, f.rgb) for v, f in zip(views, frames, strict=True)]))

    before, coarse = errors(), features(slam, "coarse").copy()
    slam.finish()
    after = errors()
    assert after[0] < 0.8 * before[0] and after[1] > before[1] + 0.3, (before, after)
    assert not np.array_equal(coarse, features(slam, "coarse"))


def test_every_keyframe_takes_part():
    """In as many rounds as `rounds_for` says, whatever their number; no fewer rounds than are asked for."""
    config = Config.from_preset("default", ["mapping.window=3", "mapping.refinement_rounds=2"]).mapping
    for count in (1, 4, 5, 11, 31):
        keyframes = [Keyframe(n, np.eye(4), n) for n in range(count)]
        rounds, size = config.rounds_for(count), min(config.refinement_frames - 1, count)
        shown = [
            one.index
            for number in range(rounds)
            for one in keyframes_in_turn(keyframes, number * 5, size, np.random.default_rng(0))
        ]
        assert set(shown) == set(range(count)) and rounds == max(2, math.ceil(count / 5))


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
