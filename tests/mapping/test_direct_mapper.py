"""Mapping by the direct loss: a map in few iterations, the same bytes every time, and state that survives."""

from __future__ import annotations

import numpy as np
import pytest

from warpslam.camera import Intrinsics
from warpslam.config import Config
from warpslam.mapping.direct_mapper import DirectMapper
from warpslam.mapping.mapper import Mapper
from warpslam.scene.scene_map import new_grid
from warpslam.slam import Slam
from warpslam.synthetic import SyntheticSequence

CAMERA = Intrinsics(60.0, 60.0, 39.5, 29.5, 80, 60)
SETTINGS = [
    "tracking.use_given_poses=true", "mapping.pixels=160", "mapping.first_iterations=12", "keyframes.every=2",
    "mapping.refinement_rounds=2", "grid.fine_spacing=0.16",
]  # fmt: skip
LAYOUTS = ["grid.layout=dense", "grid.layout=blocks"]


@pytest.fixture(scope="module")
def frames():
    """Six frames of a room."""
    return list(SyntheticSequence(1, 6, intrinsics=CAMERA))


def new(*overrides: str) -> Slam:
    return Slam(CAMERA, Config.from_preset("live", [*SETTINGS, *overrides]), "cpu")


def step(slam: Slam, frames) -> Slam:
    for frame in frames:
        slam.step(frame.rgb, frame.depth, frame.timestamp, frame.T_world_camera)
    return slam


def assert_same(one: Slam, other: Slam) -> None:
    """Every feature, the colour decoder and the optimiser are the same to the bit."""
    for level, grid in one.scene.grids.items():
        for field, value in vars(grid.state()).items():
            np.testing.assert_array_equal(value, getattr(other.scene.grids[level].state(), field), f"{level} {field}")
    decoders = one.scene.decoders["color"].weights, other.scene.decoders["color"].weights
    np.testing.assert_array_equal(*(weights.numpy() for weights in decoders))
    states = one.mapper.state(), other.mapper.state()
    for name, state in states[0].items():
        for field, value in vars(state).items():
            np.testing.assert_array_equal(value, getattr(states[1][name], field), f"{name} {field}")


def test_the_loss_chooses_the_mapper():
    """The preset `live` has the direct one, the paper's have theirs."""
    assert isinstance(new().mapper, DirectMapper)
    assert isinstance(Slam(CAMERA, Config.from_preset("paper_scannet"), "cpu").mapper, Mapper)


def test_the_logit_becomes_the_signed_distance(frames):
    """After one frame: zero where it measured, slope times distance about it, and below the band's before it."""
    slam = step(new("mapping.first_iterations=60", "mapping.pixels=800"), frames[:1])
    frame = frames[0]
    v, u = (n.ravel() for n in np.mgrid[4:56:4, 4:76:4])
    depth = frame.depth[v, u].astype(np.float64)
    known = depth > 0

    def logit(s: float) -> np.ndarray:
        points = CAMERA.backproject(u, v, depth + s)[known]
        T = frame.T_world_camera
        return slam.scene.query_occupancy(points @ T[:3, :3].T + T[:3, 3])

    assert np.median(np.abs(logit(0.0))) < 0.08  # 1 cm
    assert np.median(logit(0.03)) == pytest.approx(0.24, abs=0.1)
    assert np.median(logit(-0.06)) == pytest.approx(-0.48, abs=0.15)
    assert np.mean(logit(-0.4) < -0.5) > 0.9


@pytest.mark.parametrize("layout", LAYOUTS)
def test_two_runs_are_the_same(frames, layout):
    """Threads and places of rows leave no trace."""
    assert_same(*(step(new(layout), frames[:4]) for _ in range(2)))


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_saved_map_goes_on_as_if_it_had_not_been(frames, tmp_path, layout):
    """Moments, step counts and the colour decoder's are in the file: what follows, refinement too, is the same."""
    whole = step(new(layout), frames[:3])
    whole.save(tmp_path / "map.safetensors")
    resumed = Slam.load(tmp_path / "map.safetensors", "cpu")
    assert_same(resumed, whole)
    for slam in (whole, resumed):
        step(slam, frames[3:]).finish()
    assert_same(resumed, whole)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_beside_tracking_the_tracker_gets_the_rows_that_changed(frames, layout):
    """With the overlapped schedule both maps are the same when all is taken over, and after the final refinement."""
    slam = step(new("schedule=overlapped", layout), frames[:4])
    slam.wait()
    assert slam.mapper.scene is not slam.scene
    for last in (slam.wait, slam.finish):
        last()
        for level, grid in slam.mapper.scene.grids.items():
            for field, value in vars(grid.state()).items():
                np.testing.assert_array_equal(
                    value, getattr(slam.scene.grids[level].state(), field), f"{level} {field}"
                )


@pytest.mark.parametrize("frozen", ["middle", "fine"])
def test_a_frozen_level_stays_as_it_began(frames, frozen):
    """The other levels are optimised, and the coarse one waits for the end."""
    slam = step(new(f"mapping.optimize_{frozen}=false"), frames[:2])
    for level, grid in slam.scene.grids.items():
        initial = new_grid(level, slam.config.grid, slam.seed, slam.device, slam.scene.decoder_weights)
        initial.update_from(grid, None)
        is_same = np.array_equal(initial.state().features, grid.state().features)
        assert is_same == (level in ("coarse", frozen)), level


def test_what_has_moved_away_leaves_the_map():
    """A box that is gone: rays of keyframes that show it are left out where the current depth contradicts them."""
    box = np.s_[20:40, 30:50]
    wall = np.full((CAMERA.height, CAMERA.width), 2.0, np.float32)
    with_box = wall.copy()
    with_box[box] = 1.2
    rgb = np.full((*wall.shape, 3), 128, np.uint8)

    def logit(*overrides: str) -> float:
        """Mean logit where the front of the box was."""
        slam = new("keyframes.every=1", "mapping.iterations=10", "mapping.pixels=400", *overrides)
        for n, depth in enumerate([with_box] * 3 + [wall] * 3):
            slam.step(rgb, depth, float(n), np.eye(4))
        v, u = (index.ravel() for index in np.mgrid[box])
        return float(slam.scene.query_occupancy(CAMERA.backproject(u, v, np.full(len(u), 1.2))).mean())

    left_out, kept = logit("mapping.moved_margin=0.1"), logit()
    assert left_out < -0.3 and left_out < kept - 0.1, (left_out, kept)
