"""Grids in blocks: rows where something was seen, values as in a dense grid, and no row that moves."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from warpslam.camera import Intrinsics
from warpslam.config import Config, GridConfig
from warpslam.errors import CheckpointError, ConfigError, MapSizeError
from warpslam.field.decoders import random_decoders
from warpslam.kernels.grid import BLOCK, BLOCK_ROWS, Lattice, row_of, vertex_of
from warpslam.scene.block_grid import BlockGrid, reach_of
from warpslam.scene.feature_grid import FeatureGrid
from warpslam.scene.image_pool import ImagePool
from warpslam.scene.keyframes import PlacedImage
from warpslam.scene.scene_map import SceneMap
from warpslam.slam import Slam
from warpslam.slam_state import state_arrays, state_from_arrays
from warpslam.synthetic import SyntheticSequence

CAMERA = Intrinsics(60.0, 60.0, 39.5, 29.5, 80, 60)
DEVICES = ["cpu", *(str(d) for d in wp.get_cuda_devices())]
LIVE = [
    "tracking.use_given_poses=true", "mapping.pixels=160", "mapping.first_iterations=12", "keyframes.every=2",
    "mapping.refinement_rounds=2", "grid.fine_spacing=0.12", "grid.layout=blocks",
]  # fmt: skip
RENDERED = [
    "tracking.use_given_poses=true", "mapping.pixels=120", "mapping.first_iterations=10", "mapping.iterations=6",
    "mapping.every=1", "mapping.coarse_iterations=1", "mapping.color_refinement=false", "keyframes.every=2",
]  # fmt: skip


@wp.kernel(enable_backward=False)
def rows_and_back(
    lattice: Lattice, vertices: wp.array[wp.vec3i], rows: wp.array[int], back: wp.array[wp.vec3i]
):  # fmt: skip
    tid = wp.tid()
    v = vertices[tid]
    rows[tid] = row_of(lattice, v[0], v[1], v[2])
    if rows[tid] >= lattice.shared:
        back[tid] = vertex_of(lattice, rows[tid])


def vertices_of(grid: FeatureGrid) -> np.ndarray:
    """All vertices of the box, int (n, 3)."""
    return np.stack(np.meshgrid(*(np.arange(n) for n in grid.shape), indexing="ij"), -1).reshape(-1, 3)


def rows(grid: FeatureGrid, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Row of each vertex, and the vertex of each row that is its own."""
    given = wp.array(vertices.astype(np.int32), dtype=wp.vec3i, device=grid.device)
    found = wp.zeros(len(vertices), dtype=int, device=grid.device)
    back = wp.zeros(len(vertices), dtype=wp.vec3i, device=grid.device)
    wp.launch(rows_and_back, len(vertices), [grid.lattice, given], [found, back], device=grid.device)
    return found.numpy(), back.numpy()


def by_vertex(grid: FeatureGrid) -> np.ndarray:
    """Features of all vertices of the box, (n, 32)."""
    return grid.features.numpy()[rows(grid, vertices_of(grid))[0]]


def new_map(device: str = "cpu", **settings) -> SceneMap:
    return SceneMap(random_decoders(0), GridConfig(layout="blocks", **settings), wp.get_device(device), seed=3)


def some_blocks(grid: BlockGrid, count: int) -> np.ndarray:
    """Blocks of the box at random."""
    low, high = grid.first // BLOCK, (grid.first + grid.shape - 1) // BLOCK
    everything = np.stack(np.meshgrid(*(np.arange(a, b + 1) for a, b in zip(low, high, strict=True))), -1)
    return np.random.default_rng(0).permutation(everything.reshape(-1, 3))[:count]


def assert_same_features(blocks: Slam, dense: Slam, tolerance: float = 0.0) -> None:
    """Where blocks have rows these are those of dense grids, and elsewhere dense ones are to the bit as they began."""
    for level, grid in dense.scene.grids.items():
        other = blocks.scene.grids[level]
        is_own = np.ones(grid.row_count, bool)
        if level != "coarse":
            is_own = rows(other, vertices_of(grid))[0] >= BLOCK_ROWS
        of_blocks, of_dense = by_vertex(other)[is_own], by_vertex(grid)[is_own]
        np.testing.assert_allclose(of_blocks, of_dense, rtol=tolerance, atol=tolerance, err_msg=level)
        fresh = FeatureGrid(level, grid.spacing, grid.std, grid.seed, grid.device)
        fresh.update_from(grid, None)
        np.testing.assert_array_equal(fresh.features.numpy()[~is_own], by_vertex(grid)[~is_own], level)


@pytest.fixture(scope="module")
def frames():
    """Five frames of a room."""
    return list(SyntheticSequence(1, 5, intrinsics=CAMERA))


def run(frames, preset: str, settings: list[str], *overrides: str) -> Slam:
    slam = Slam(CAMERA, Config.from_preset(preset, [*settings, *overrides]), "cpu")
    for frame in frames:
        slam.step(frame.rgb, frame.depth, frame.timestamp, frame.T_world_camera)
    return slam


@pytest.mark.parametrize("device", DEVICES)
def test_rows_and_vertices_are_each_others_inverse(device):
    """Vertices of made blocks have rows of their own, from which one finds back; all others share 64."""
    grid = BlockGrid("fine", 0.1, 0.1, 0, wp.get_device(device))
    grid.cover(np.array([-0.75, -1.3, 0.2]), np.array([0.9, 0.35, 1.6]))
    made = some_blocks(grid, 20)
    grid.make(made)
    vertices = vertices_of(grid)
    found, back = rows(grid, vertices)
    is_own = (((vertices + grid.first) // BLOCK)[:, None] == made).all(axis=2).any(axis=1)
    np.testing.assert_array_equal(found >= BLOCK_ROWS, is_own)
    np.testing.assert_array_equal(back[is_own], vertices[is_own])
    assert len(set(found[is_own])) == is_own.sum() > 0 and found.min() >= 0 and found.max() < grid.row_count


@pytest.mark.parametrize("device", DEVICES)
def test_new_blocks_are_what_dense_grids_begin_with(device):
    """Whatever the order, and also rows that begin again: their features come from their place in the world."""
    grid, dense = (kind("fine", 0.1, 0.1, 3, wp.get_device(device)) for kind in (BlockGrid, FeatureGrid))
    for one in (grid, dense):
        one.cover(np.array([-0.75, -1.3, 0.2]), np.array([0.9, 0.35, 1.6]))
    shared = grid.features.numpy()[:BLOCK_ROWS].copy()
    for blocks in np.split(some_blocks(grid, 21), 3):
        grid.make(blocks)
    found = rows(grid, vertices_of(grid))[0]
    is_own = found >= BLOCK_ROWS
    for _ in range(2):
        np.testing.assert_array_equal(by_vertex(grid)[is_own], dense.features.numpy()[is_own])
        np.testing.assert_array_equal(by_vertex(grid)[~is_own], shared[found[~is_own]])
        grid.features[BLOCK_ROWS : grid.row_count].fill_(7.0)
        grid.renew(np.arange(BLOCK_ROWS, grid.row_count))


def test_rows_of_vertices():
    """A mask of vertices in the order of rows; blocks that reach beyond the box have rows that are none."""
    grid = BlockGrid("fine", 0.1, 0.1, 0, wp.get_device("cpu"))
    grid.cover(np.array([-0.75, -1.3, 0.2]), np.array([0.9, 0.35, 1.6]))
    grid.make(some_blocks(grid, 30))
    vertices = np.random.default_rng(2).random(int(np.prod(grid.shape))) < 0.5
    found = rows(grid, vertices_of(grid))[0]
    mask = grid.rows_of(vertices)
    is_own = found >= BLOCK_ROWS
    assert len(mask) == grid.row_count and mask.sum() == vertices[is_own].sum() > 0
    np.testing.assert_array_equal(mask[found[is_own]], vertices[is_own])


def test_growth_moves_no_row():
    """Rows stay where they are when the box grows to all sides and when blocks are added; new ones are appended."""
    grid = BlockGrid("fine", 0.1, 0.1, 0, wp.get_device("cpu"))
    grid.cover(np.zeros(3), np.ones(3))
    made = some_blocks(grid, 9)
    grid.make(made)
    marks = np.random.default_rng(1).normal(size=(grid.row_count - BLOCK_ROWS, 32)).astype(np.float32)
    grid.features[BLOCK_ROWS : grid.row_count].assign(marks)
    world = vertices_of(grid) + grid.first
    before = by_vertex(grid)
    old = grid.first
    grid.cover(np.full(3, -1.37), np.full(3, 2.2))
    grid.make(some_blocks(grid, 40)[~(some_blocks(grid, 40)[:, None] == made).all(axis=2).any(axis=1)])
    assert (grid.first < old).all()
    found = rows(grid, world - grid.first)[0]
    np.testing.assert_array_equal(grid.features.numpy()[found], before)
    np.testing.assert_array_equal(grid.features.numpy()[BLOCK_ROWS : BLOCK_ROWS + len(marks)], marks)


def test_every_sample_of_an_image_has_rows(frames):
    """Corners of the cells at all depths of all pixels, up to a little behind what they measure."""
    scene = new_map(fine_spacing=0.08)
    T, depth = frames[0].T_world_camera.copy(), frames[0].depth.copy()
    T[:3, 3] -= 0.3
    depth[::7, ::5] = 0.0
    depth[::9, ::11] *= 0.5
    v, u = np.nonzero(depth)
    far = CAMERA.backproject(u, v, depth[v, u] + 0.05) @ T[:3, :3].T + T[:3, 3]
    scene.cover(np.minimum(far.min(axis=0), T[:3, 3]), np.maximum(far.max(axis=0), T[:3, 3]))
    pool = ImagePool(CAMERA, wp.get_device("cpu"))
    pool.set(0, frames[0].rgb, depth)
    scene.make_room(pool.arrays, [PlacedImage(0, T)], CAMERA, reach_of(0.05))
    rng = np.random.default_rng(0)
    for level in ("middle", "fine", "color"):
        grid = scene.grids[level]
        for share in (0.0, 1.0, *rng.uniform(0, 1, 30)):
            local = CAMERA.backproject(u, v, share * (depth[v, u] + 0.05))
            points = (local @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
            corner = np.floor(points / np.float32(grid.spacing)).astype(int) - grid.first
            for k in range(8):
                found, _ = rows(grid, corner + [k >> 2, (k >> 1) & 1, k & 1])
                assert (found >= BLOCK_ROWS).all(), (level, share)
        assert len(rows(grid, vertices_of(grid))[0]) > 1.5 * grid.row_count or level == "middle"
    assert not len(scene.grids["fine"].wanted_blocks(pool.arrays, 0, T, CAMERA, reach_of(0.05)))


def test_a_run_is_that_of_dense_grids(frames):
    """The direct loss: every feature, moment and count, and the mesh, to the bit, up to the final refinement, some of
    whose samples lie where nothing has rows.
    """
    blocks = run(frames, "live", LIVE, "mapping.color_refinement=false")
    dense = run(frames, "live", LIVE, "grid.layout=dense", "mapping.color_refinement=false")
    for slam in (blocks, dense):
        slam.finish()
    assert_same_features(blocks, dense)
    for level in ("middle", "fine", "color"):
        grid, other = dense.scene.grids[level], blocks.scene.grids[level]
        vertices = vertices_of(grid)
        of_blocks, of_dense = rows(other, vertices)[0], rows(grid, vertices)[0]
        mine, theirs = blocks.mapper._rows[level], dense.mapper._rows[level]
        np.testing.assert_array_equal(mine.updates.numpy()[of_blocks], theirs.updates.numpy()[of_dense], level)
        np.testing.assert_array_equal(mine.moments.numpy()[of_blocks], theirs.moments.numpy()[of_dense], level)
        assert theirs.updates.numpy().any() and not mine.updates.numpy()[:BLOCK_ROWS].any()
    assert blocks.scene.grids["fine"].own_rows < 0.6 * dense.scene.grids["fine"].row_count
    mesh, expected = blocks.mesh(), dense.mesh()
    np.testing.assert_array_equal(mesh.vertices, expected.vertices)
    np.testing.assert_array_equal(mesh.faces, expected.faces)
    np.testing.assert_array_equal(mesh.visual.vertex_colors, expected.visual.vertex_colors)


def test_a_run_by_rendering_is_nearly_that_of_dense_grids(frames):
    """The rendering loss changes what the frustum selects, and all of that has rows; some of its samples lie beyond."""
    blocks = run(frames, "default", RENDERED, "grid.layout=blocks")
    dense = run(frames, "default", RENDERED, "grid.layout=dense")
    assert_same_features(blocks, dense, 0.02)
    assert blocks.scene.grids["fine"].own_rows < dense.scene.grids["fine"].row_count


def test_refinement_leaves_what_was_not_seen(frames):
    """The final refinement by rendering changes rows of made blocks alone, and all is finite."""
    slam = run(frames, "default", RENDERED[:-2], "grid.layout=blocks", "keyframes.every=2")
    shared = {level: slam.scene.grids[level].features.numpy()[:BLOCK_ROWS].copy() for level in ("fine", "color")}
    before = slam.scene.grids["color"].state().features.copy()
    slam.finish()
    for level, values in shared.items():
        np.testing.assert_array_equal(slam.scene.grids[level].features.numpy()[:BLOCK_ROWS], values)
    after = slam.scene.grids["color"].state().features
    assert np.isfinite(after).all() and (after[: len(before)] != before).any()


def test_memory_follows_what_was_seen():
    """Two rooms 40 m apart take what two rooms take, and a table for what lies between."""
    scene = new_map(fine_spacing=0.08)
    pool = ImagePool(CAMERA, wp.get_device("cpu"))
    depth = np.full((CAMERA.height, CAMERA.width), 2.0, np.float32)
    pool.set(0, np.zeros((*depth.shape, 3), np.uint8), depth)
    sizes = []
    for x in (0.0, 40.0):
        T = np.eye(4)
        T[0, 3] = x
        scene.cover(np.array([x - 2.0, -1.5, 0.0]), np.array([x + 2.0, 1.5, 2.1]))
        scene.make_room(pool.arrays, [PlacedImage(0, T)], CAMERA, reach_of(0.05))
        sizes.append(scene.grids["fine"].bytes)
    assert sizes[1] < 2.2 * sizes[0] < 0.1 * 128 * np.prod(scene.grids["fine"].shape)
    low, high = scene.bounds
    assert 1e9 * scene.gigabytes(low, high) >= sum(grid.bytes for grid in scene.grids.values())


def test_refuses_rows_beyond_the_memory_limit():
    """The error names the setting, and the rows stay as they were."""
    scene = new_map(fine_spacing=0.08, max_gigabytes=0.004)
    pool = ImagePool(CAMERA, wp.get_device("cpu"))
    depth = np.full((CAMERA.height, CAMERA.width), 4.0, np.float32)
    pool.set(0, np.zeros((*depth.shape, 3), np.uint8), depth)
    scene.cover(np.array([-3.0, -3.0, 0.0]), np.array([3.0, 3.0, 4.0]))
    with pytest.raises(MapSizeError, match="max_gigabytes"):
        scene.make_room(pool.arrays, [PlacedImage(0, np.eye(4))], CAMERA, reach_of(0.05))
    assert scene.grids["fine"].own_rows == 0
    with pytest.raises(MapSizeError, match="max_gigabytes"):
        scene.cover(np.full(3, -3000.0), np.full(3, 3000.0))


def test_points_anywhere_are_looked_up():
    """Far outside the box, on its border and on the edges of blocks, every value is finite."""
    scene = new_map()
    scene.cover(np.full(3, -1.0), np.full(3, 1.3))
    scene.grids["fine"].make(some_blocks(scene.grids["fine"], 5))
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(-9e3, 9e3, (100, 3)), 0.16 * rng.integers(-40, 40, (300, 3))])
    assert np.isfinite(scene.query_occupancy(points)).all() and np.isfinite(scene.query_color(points)).all()


@pytest.fixture(scope="module")
def saved(frames):
    """Header and arrays of a map in blocks."""
    return state_arrays(run(frames[:2], "live", LIVE).state())


def test_a_file_holds_the_blocks(saved):
    """State to arrays and back is the same; rows that are shared are not in it."""
    header, arrays = saved
    again = state_arrays(state_from_arrays("file", header, dict(arrays)))
    assert again[1].keys() == arrays.keys()
    for name, array in arrays.items():
        np.testing.assert_array_equal(again[1][name], array, name)
    assert arrays["grid_fine"].shape == (BLOCK_ROWS * len(arrays["grid_fine_blocks"]), 32)
    assert "grid_coarse_blocks" not in arrays


@pytest.mark.parametrize("case", ["twice", "outside", "missing", "rows"])
def test_damaged_blocks_are_refused(saved, case):
    """Blocks that are there twice, outside the grid or without rows; and none at all."""
    header, arrays = saved
    arrays = dict(arrays)
    blocks = arrays["grid_fine_blocks"].copy()
    if case == "twice":
        blocks[0] = blocks[1]
    elif case == "outside":
        blocks[0, 1] += 1000
    elif case == "rows":
        blocks = blocks[:-1]
    arrays["grid_fine_blocks"] = blocks
    if case == "missing":
        del arrays["grid_fine_blocks"]
    with pytest.raises(CheckpointError, match="grid_fine"):
        state_from_arrays("file", header, arrays)


def test_a_map_keeps_its_layout(saved):
    """Settings with another layout do not fit a saved map, and the error says which there is."""
    header, arrays = saved
    config = Config.from_preset("live", [*LIVE, "grid.layout=dense"])
    with pytest.raises(ConfigError, match=r"grid.layout = dense .* blocks"):
        state_from_arrays("file", header, arrays, config=config)
