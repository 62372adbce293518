"""Mapping anew what a loop has moved: the rest stays to the byte, the surface is where the keyframes now see it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.kernels.swept_room import SweptRoom
from warpslam import Slam
from warpslam.camera import FrameMotion, Intrinsics
from warpslam.config import Config
from warpslam.mapping.remapping import MadePoses, MovedView, Remapping, moved_views, touched_vertices
from warpslam.mapping.scheduler import MappingTask
from warpslam.poses import motion_of

CAMERA = Intrinsics(70.0, 70.0, 39.5, 29.5, 80, 60)
COUNT, FIRST_MOVED = 12, 8
SHIFT = 0.3
"""By which the poses of the last frames are wrong [m]."""
SETTINGS = [
    "tracking.use_given_poses=true", "mapping.pixels=240", "mapping.first_iterations=30", "mapping.iterations=8",
    "keyframes.every=1", "grid.fine_spacing=0.16", "mapping.refinement_rounds=1",
]  # fmt: skip
RENDERING = ["mapping.loss=rendering", "mapping.coarse=false", "mapping.iterations=6", "mapping.first_iterations=20"]

DENSE = ["grid.layout=dense"]


@pytest.fixture(scope="module")
def path() -> list[np.ndarray]:
    """Once around, looking outwards."""
    return [motion_of(np.array([0.0, 0.0, 0.0, 0.0, 2 * np.pi * n / COUNT, 0.0])) for n in range(COUNT)]


@pytest.fixture(scope="module")
def frames(path) -> list[tuple[np.ndarray, np.ndarray]]:
    room = SweptRoom()
    return [room.take(CAMERA, pose, FrameMotion()) for pose in path]


def wrong(path: list[np.ndarray]) -> list[np.ndarray]:
    """The last frames are believed to be elsewhere."""
    # Outwards: the true walls count as free there.
    offset = motion_of(np.array([-SHIFT, 0.0, 0.1, 0.0, 0.0, 0.0]))
    return [offset @ pose if n >= FIRST_MOVED else pose for n, pose in enumerate(path)]


def mapped(frames, poses, *overrides: str) -> Slam:
    """A map from given poses."""
    slam = Slam(CAMERA, Config.from_preset("live", [*SETTINGS, *overrides]), "cpu")
    for (rgb, depth), pose in zip(frames, poses, strict=True):
        slam.step(rgb, depth, T_world_camera=pose)
    slam.wait()
    return slam


def map_again(slam: Slam, path: list[np.ndarray]) -> None:
    """Keyframes go to where they are, and the map with them."""
    poses = [keyframe.pose.copy() for keyframe in slam.keyframes]
    views = [
        MovedView(seen.index, seen.depth(), poses[n], path[n])
        for n, seen in enumerate(slam._seen) if n >= FIRST_MOVED
    ]  # fmt: skip
    for keyframe, pose in zip(slam.keyframes, path, strict=True):
        keyframe.pose = pose
    shifts = np.where(np.arange(COUNT) < FIRST_MOVED, 0.0, SHIFT)
    remapping = Remapping(CAMERA, views, shifts, 0.08, 12, 0)
    slam.scheduler.start(MappingTask("again", COUNT - 1, path[-1], remapping=remapping), slam.keyframes)
    slam.wait()


def surface_errors(slam: Slam, frames, path, numbers) -> np.ndarray:
    """|logit| where frames have their surface."""
    errors = []
    for n in numbers:
        depth = frames[n][1]
        v, u = (k.ravel() for k in np.mgrid[6:54:6, 6:74:6])
        points = CAMERA.backproject(u, v, depth[v, u].astype(np.float64))
        errors.append(np.abs(slam.scene.query_occupancy(points @ path[n][:3, :3].T + path[n][:3, 3])))
    return np.concatenate(errors)


def contents(slam: Slam) -> dict[str, np.ndarray]:
    """All that mapping may change, by name."""
    found = {"decoder": slam.scene.decoders["color"].weights.numpy().copy()}
    for level in ("coarse", "middle", "fine", "color"):
        grid = slam.scene.grids[level]
        for name, array in ((level, grid.features), (f"{level} seen", grid.seen)):
            found[name] = array.numpy()[: grid.row_count].copy()
    for level, rows in getattr(slam.mapper, "_rows", {}).items():
        count = slam.scene.grids[level].row_count
        for name, array in (("updates", rows.updates), ("moments", rows.moments)):
            found[f"{level} {name}"] = array.numpy()[:count].copy()
    return found


def test_what_moved_is_where_it_is_now(frames, path):
    """The surface that the moved frames see fits as well as in a map that was right from the start, nearly."""
    last = range(FIRST_MOVED + 1, COUNT - 1)
    right = surface_errors(mapped(frames, path), frames, path, last)
    slam = mapped(frames, wrong(path))
    before = surface_errors(slam, frames, path, last)
    map_again(slam, path)
    after = surface_errors(slam, frames, path, last)
    assert np.median(after) < 0.25 * np.median(before)
    assert np.median(after) < 2.0 * np.median(right)


@pytest.mark.parametrize("overrides", [DENSE, RENDERING, []], ids=["dense", "rendering", "blocks"])
def test_the_rest_stays_to_the_byte(frames, path, overrides):
    """Vertices that no moved view reaches, the coarse level, the colour decoder, the current image; two runs agree."""
    both = []
    for _ in range(2):
        slam = mapped(frames, wrong(path), *overrides)
        small = CAMERA.strided(4)
        image = [array.numpy()[0].copy() for array in slam.images.arrays]
        shape = slam.scene.grids["fine"].shape
        before = contents(slam)
        map_again(slam, path)
        assert slam.scene.grids["fine"].shape == shape, "a map that grows has other rows: compare another one"
        after = contents(slam)
        for level in ("middle", "fine", "color"):
            grid = slam.scene.grids[level]
            views = [
                (seen.depth(), pose)
                for poses in (wrong(path), path)
                for seen, pose in zip(slam._seen[FIRST_MOVED:], poses[FIRST_MOVED:], strict=True)
            ]
            free = touched_vertices(grid, small, views)
            assert 0.05 < free.mean() < 0.9
            # Rows of blocks that were made meanwhile come last.
            free = grid.rows_of(free)[: len(before[level])]
            for name in (level, f"{level} seen", f"{level} updates", f"{level} moments"):
                if name in before:
                    np.testing.assert_array_equal(after[name][: len(free)][~free], before[name][~free], name)
            assert (after[level][: len(free)][free] != before[level][free]).any()
        for name in ("coarse", "decoder"):
            np.testing.assert_array_equal(after[name], before[name], name)
        for array, kept in zip(slam.images.arrays, image, strict=True):
            np.testing.assert_array_equal(array.numpy()[0], kept)
        both.append(after)
    for name, array in both[0].items():
        np.testing.assert_array_equal(array, both[1][name], name)


def test_blocks_are_mapped_again_as_dense_rows_are(frames, path):
    """Also where views now see what had no rows: surfaces are the same to the bit."""
    both = []
    for layout in ("dense", "blocks"):
        slam = mapped(frames, wrong(path), f"grid.layout={layout}")
        map_again(slam, path)
        both.append(slam.mesh())
    np.testing.assert_array_equal(both[0].vertices, both[1].vertices)
    np.testing.assert_array_equal(both[0].visual.vertex_colors, both[1].visual.vertex_colors)


@pytest.mark.parametrize("layout", ["dense", "blocks"])
def test_beside_tracking_both_maps_are_the_same(frames, path, layout):
    """With the overlapped schedule the tracker's map gets all rows that were begun again."""
    slam = mapped(frames, wrong(path), "schedule=overlapped", f"grid.layout={layout}")
    map_again(slam, path)
    assert slam.mapper.scene is not slam.scene
    for level, grid in slam.mapper.scene.grids.items():
        mine, theirs = grid.state(), slam.scene.grids[level].state()
        np.testing.assert_array_equal(mine.features, theirs.features, level)
        np.testing.assert_array_equal(mine.seen, theirs.seen, level)
    assert np.median(surface_errors(slam, frames, path, range(FIRST_MOVED + 1, COUNT - 1))) < 0.1


def test_those_that_moved_most_come_first_and_who_sees_them_too(frames, path, monkeypatch):
    """Then those that only see what begins again; keyframes that look elsewhere are not mapped."""
    slam = mapped(frames, wrong(path))
    order = []
    original = slam.mapper.map_again

    def noted(images, keyframe, *rest):
        order.append(keyframe.index)
        return original(images, keyframe, *rest)

    monkeypatch.setattr(slam.mapper, "map_again", noted)
    seen = slam._seen[10]
    shifts = np.zeros(COUNT)
    shifts[[9, 10]] = 0.2, 0.4
    views = [MovedView(10, seen.depth(), slam.keyframes[10].pose.copy(), path[10])]
    Remapping(CAMERA, views, shifts, 0.08, 1, 0).run(slam.mapper, slam.images, slam.keyframes)
    assert order[:2] == [10, 9] and 11 in order and not set(order) & {3, 4, 5}


def test_poses_of_the_map(frames):
    """Views that moved less than asked for stay; a turn moves what is far away; it is saved and read."""
    slam = mapped(frames[:2], [np.eye(4)] * 2)
    made = MadePoses()
    made.note(0, np.eye(4))
    made.note_new([replace(slam.keyframes[0], pose=motion_of(np.array([9.0, 0, 0, 0, 0, 0]))), slam.keyframes[1]])
    again = MadePoses()
    again.restore(**made.arrays())
    small, large = (motion_of(np.array([x, 0, 0, 0, 0, 0])) for x in (0.05, 0.15))
    turn = motion_of(np.array([0, 0, 0, 0, 0.06, 0]))
    for one in (made, again):
        assert [view.index for view in moved_views(one, slam._seen, [small, large], 0.1)] == [1]
        found = moved_views(one, slam._seen, [turn, small], 0.1)
        assert [view.index for view in found] == [0]
        np.testing.assert_array_equal(found[0].before, np.eye(4))
        np.testing.assert_array_equal(found[0].after, turn)
