"""What of the map a mapping call may change, where settings freeze a level."""

from __future__ import annotations

import numpy as np
import pytest

from warpslam.camera import Intrinsics
from warpslam.config import Config
from warpslam.scene.feature_grid import FeatureGrid
from warpslam.slam import Slam
from warpslam.synthetic import SyntheticSequence

CAMERA = Intrinsics(60.0, 60.0, 39.5, 29.5, 80, 60)
SETTINGS = [
    "tracking.use_given_poses=true", "mapping.pixels=100", "mapping.every=2", "mapping.first_iterations=12",
    "mapping.iterations=10", "mapping.coarse_iterations=2", "mapping.refinement_rounds=1", "keyframes.every=2",
]  # fmt: skip


def mapped(*overrides: str) -> Slam:
    """Three frames, mapped and refined."""
    sequence = SyntheticSequence(1, 3, intrinsics=CAMERA)
    slam = Slam(CAMERA, Config.from_preset("rendering", [*SETTINGS, *overrides]), "cpu")
    for frame in sequence:
        slam.step(frame.rgb, frame.depth, frame.timestamp, frame.T_world_camera)
    slam.finish()
    return slam


def changed(slam: Slam, level: str) -> bool:
    """Whether any feature of a level is not, to the bit, what it began as."""
    grid = slam.scene.grids[level]
    initial = FeatureGrid(level, grid.spacing, grid.std, slam.seed, slam.device)
    initial.update_from(grid, None)
    return not np.array_equal(initial.features.numpy(), grid.features.numpy())


@pytest.mark.parametrize("frozen", ["none", "middle", "fine"])
def test_a_frozen_level_stays_as_it_began(frozen):
    """Through first frame, later frames and refinement; the other levels are optimised as ever."""
    slam = mapped() if frozen == "none" else mapped(f"mapping.optimize_{frozen}=false")
    assert {level: changed(slam, level) for level in slam.scene.grids} == {
        "coarse": True, "middle": frozen != "middle", "fine": frozen != "fine", "color": True,
    }  # fmt: skip


def test_no_iteration_is_spent_on_a_frozen_middle_level():
    """The middle stage has nothing to optimise then, and becomes part of the fine one."""

    def stages(*overrides: str) -> list[str]:
        return Slam(CAMERA, Config.from_preset("rendering", overrides), "cpu").mapper._schedule(10, refinement=False)

    assert stages() == ["middle"] * 5 + ["fine"] * 2 + ["color"] * 3
    assert stages("mapping.optimize_middle=false") == ["fine"] * 7 + ["color"] * 3


def test_what_has_moved_away_leaves_the_map():
    """A box in front of a wall is gone after three keyframes: those still show it, and hold it in the map unless their
    rays to it are left out.
    """
    box = np.s_[20:40, 30:50]
    wall = np.full((CAMERA.height, CAMERA.width), 2.0, np.float32)
    with_box = wall.copy()
    with_box[box] = 1.2
    rgb = np.full((*wall.shape, 3), 128, np.uint8)

    def error(*overrides: str) -> float:
        """Mean error of the depth where the box was [m]."""
        settings = [
            "mapping.every=1", "mapping.first_iterations=60", "mapping.iterations=25", "mapping.pixels=300",
            "keyframes.every=1", "mapping.coarse=false", "tracking.use_given_poses=true",
        ]  # fmt: skip
        slam = Slam(CAMERA, Config.from_preset("rendering", [*settings, *overrides]), "cpu")
        for n, depth in enumerate([with_box] * 3 + [wall] * 3):
            slam.step(rgb, depth, float(n), np.eye(4))
        return float(np.abs(slam.render(np.eye(4)).depth - wall)[box].mean())

    assert error("mapping.moved_margin=0.1") < 0.5 * error()
