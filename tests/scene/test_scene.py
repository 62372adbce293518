"""The map: lattices that grow, queries, limits."""

import numpy as np
import pytest
import warp as wp

from warpslam.config import GridConfig
from warpslam.errors import CheckpointError, InputError, MapSizeError
from warpslam.field.decoder_files import load_decoders
from warpslam.field.decoders import random_decoders
from warpslam.field.feature_fit import MAX_FREE_LOGIT, free_feature
from warpslam.runtime.environment import free_gigabytes
from warpslam.scene.block_grid import BlockGrid
from warpslam.scene.scene_map import SceneMap

DEVICES = ["cpu", *(str(d) for d in wp.get_cuda_devices())]


def new_map(device: str, **settings) -> SceneMap:
    return SceneMap(random_decoders(0), GridConfig(**{"layout": "dense", **settings}), wp.get_device(device), seed=3)


@pytest.mark.parametrize("device", DEVICES)
def test_growth_changes_nothing_that_was_there(device):
    """After growth every point of the old map has the same occupancy and colour."""
    scene = new_map(device)
    scene.cover(np.array([-1.0, -1.0, 0.0]), np.array([1.0, 1.0, 1.0]))
    points = np.random.default_rng(0).uniform([-1, -1, 0], [1, 1, 1], (500, 3)).astype(np.float32)
    before = scene.query_occupancy(points), scene.query_color(points), scene.query_occupancy(points, "coarse")
    assert scene.cover(np.array([-3.0, -1.0, -2.0]), np.array([1.0, 2.5, 1.0]))
    after = scene.query_occupancy(points), scene.query_color(points), scene.query_occupancy(points, "coarse")
    for a, b in zip(before, after, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("device", DEVICES)
def test_features_do_not_depend_on_the_order_of_growth(device):
    """A map grown in steps equals a map made at once, bit for bit."""
    low, high = np.array([-2.0, -1.5, -1.0]), np.array([2.0, 1.0, 1.0])
    at_once, in_steps = new_map(device), new_map(device)
    at_once.cover(low, high)
    in_steps.cover(low / 4, high / 4)
    in_steps.cover(low, high)
    for level in at_once.grids:
        a, b = at_once.grids[level], in_steps.grids[level]
        assert a.shape == b.shape and (a.first == b.first).all()
        np.testing.assert_array_equal(a.features.numpy(), b.features.numpy())


def test_cover_is_idle_inside_the_bounds_and_bounds_are_lattice_planes():
    """A box inside needs no growth; bounds are multiples of the middle spacing around the box and its margin."""
    scene = new_map("cpu")
    scene.cover(np.zeros(3), np.ones(3))
    low, high = scene.bounds
    assert (low <= -0.6).all() and (high >= 1.6).all()
    np.testing.assert_allclose(
        np.concatenate([low, high]) / 0.32, np.rint(np.concatenate([low, high]) / 0.32), atol=1e-9
    )
    assert not scene.cover(np.full(3, 0.2), np.full(3, 0.8))


def test_spacing_is_exact():
    """Vertices lie on the world lattice: origin + index * spacing, at every level."""
    scene = new_map("cpu")
    scene.cover(np.zeros(3), np.ones(3))
    for grid in scene.grids.values():
        np.testing.assert_allclose(np.array(grid.lattice.origin), grid.first * grid.spacing, atol=1e-6)
        np.testing.assert_allclose(1.0 / np.array(grid.lattice.inverse_spacing), grid.spacing, rtol=1e-6)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("layout", ("dense", "blocks"))
def test_middle_level_begins_as_free_space(device, layout):
    """A.2: every middle vertex has the one vector, wherever and whenever it is made, in a copy, after a restart and
    when it begins again; the field is free there; other levels are as ever.
    """
    decoders, other = load_decoders(), random_decoders(0)
    free = GridConfig(layout=layout, middle_start="free")
    scene = SceneMap(decoders, free, wp.get_device(device), seed=3)
    noise = SceneMap(decoders, GridConfig(layout=layout), wp.get_device(device), seed=3)
    expected = free_feature(decoders.middle)

    def vertices(scene: SceneMap) -> np.ndarray:
        grid = scene.grids["middle"]
        if isinstance(grid, BlockGrid):
            grid.make(grid.wanted_in_box(scene.low, 0.3 * scene.low))
        return grid.features.numpy()[: grid.row_count]

    scene.cover(np.full(3, -0.5), np.full(3, 0.5))
    assert (vertices(scene) == expected).all()
    restored = SceneMap(decoders, free, wp.get_device(device), seed=3)
    restored.restore(scene.state())
    for one in (scene, restored, scene.copy()):
        one.cover(np.array([-2.0, -0.5, -0.5]), np.array([0.5, 1.5, 0.5]))
        assert (vertices(one) == expected).all()
    grid = scene.grids["middle"]
    own = np.arange(grid.row_count - grid.own_rows, grid.row_count)
    grid.features.fill_(7.0)
    grid.renew(own)
    assert (grid.features.numpy()[own] == expected).all()
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (500, 3))
    assert restored.query_occupancy(points, "middle").max() < MAX_FREE_LOGIT
    assert restored.query_occupancy(points).max() < MAX_FREE_LOGIT
    noise.cover(np.full(3, -0.5), np.full(3, 0.5))
    noise.cover(np.array([-2.0, -0.5, -0.5]), np.array([0.5, 1.5, 0.5]))
    assert noise.query_occupancy(points, "middle").max() > MAX_FREE_LOGIT
    for level in ("coarse", "fine", "color"):
        rows = noise.grids[level].row_count
        ours, theirs = (one.grids[level].features.numpy()[:rows] for one in (restored, noise))
        np.testing.assert_array_equal(ours, theirs)
    with pytest.raises(CheckpointError, match="middle_start"):
        SceneMap(other, free, wp.get_device(device))


def test_refuses_to_grow_beyond_the_memory_limit():
    """The error names the setting, and the map stays as it was."""
    scene = new_map("cpu", max_gigabytes=0.2)
    scene.cover(np.zeros(3), np.ones(3))
    before = scene.bounds[1].copy()
    with pytest.raises(MapSizeError, match="max_gigabytes"):
        scene.cover(np.zeros(3), np.full(3, 100.0))
    np.testing.assert_array_equal(scene.bounds[1], before)


def test_refuses_to_grow_beyond_what_is_free(monkeypatch):
    """The error says what is needed and what there is, and the map stays as it was."""
    scene = new_map("cpu")
    scene.cover(np.zeros(3), np.ones(3))
    before = scene.bounds[1].copy()
    monkeypatch.setattr("warpslam.scene.scene_map.free_gigabytes", lambda device: 0.01)
    with pytest.raises(MapSizeError, match=r"needs \d\.\d GB more, and cpu has 0.0 GB free"):
        scene.cover(np.zeros(3), np.full(3, 8.0))
    np.testing.assert_array_equal(scene.bounds[1], before)
    monkeypatch.setattr("warpslam.scene.scene_map.free_gigabytes", lambda device: None)
    assert scene.cover(np.zeros(3), np.full(3, 2.0))


def test_free_memory_is_told():
    """More than nothing, and less than any machine has."""
    assert 0.0 < (free_gigabytes(wp.get_device("cpu")) or 1.0) < 1e5


def test_query_errors():
    """An empty map, a wrong shape and a wrong level are refused; no points give no values."""
    scene = new_map("cpu")
    with pytest.raises(InputError, match="empty"):
        scene.query_occupancy(np.zeros((1, 3)))
    scene.cover(np.zeros(3), np.ones(3))
    with pytest.raises(InputError, match="shape"):
        scene.query_occupancy(np.zeros(3))
    with pytest.raises(InputError, match="level"):
        scene.query_occupancy(np.zeros((1, 3)), "color")
    assert scene.query_color(np.zeros((0, 3))).shape == (0, 3)
