"""The mesh of the room with the ball: where its surface lies, where it ends, and what is an error."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from tests.meshing.ball_room import CAMERA, OFFSET, RADIUS, ROOM, BallRoom, open_edges, view
from warpslam.camera import Intrinsics
from warpslam.errors import InputError, MeshError
from warpslam.meshing import ObservedView, extract_mesh
from warpslam.meshing.marching_cubes import Surface
from warpslam.meshing.views import Evidence


def test_vertices_lie_on_the_surface(mesh):
    """Within 3 mm at 2 cm voxels; next to the room's edges, where the field has a kink, within a voxel."""
    error = np.abs(BallRoom().distance(mesh.vertices))
    to_walls = np.sort(ROOM - np.abs(mesh.vertices - OFFSET), axis=1)
    smooth = to_walls[:, 1] > 0.03
    assert smooth.sum() > 10000 and (~smooth).sum() > 100
    assert error[smooth].max() < 0.003
    assert error.max() < 0.02


def test_whole_room_is_watertight(mesh):
    """Two closed surfaces without cracks between blocks, with the area of the room and of the ball."""
    assert open_edges(mesh.faces) == []
    parts = sorted(mesh.split(only_watertight=False), key=lambda part: part.area)
    assert len(parts) == 2
    x, y, z = 2 * ROOM
    assert parts[0].area == pytest.approx(4 * np.pi * RADIUS**2, rel=0.01)
    assert parts[1].area == pytest.approx(2 * (x * y + y * z + z * x), rel=0.01)


def test_normals_point_to_free_space(mesh):
    """One centimetre along a normal is farther from the solid, by the winding and by the stored normals."""
    scene = BallRoom()
    assert (scene.distance(mesh.vertices + 0.01 * mesh.vertex_normals) > 0).all()
    assert (scene.distance(mesh.triangles_center + 0.01 * mesh.face_normals) > 0).all()
    assert np.linalg.norm(mesh.vertex_normals, axis=1) == pytest.approx(1.0, abs=1e-6)


def test_colors_are_those_of_the_field(mesh):
    """Vertex colours are the field's, rounded to 8 bits, opaque."""
    expected = np.rint((0.5 + 0.25 * mesh.vertices) * 255)
    colors = mesh.visual.vertex_colors
    assert colors.dtype == np.uint8 and (colors[:, 3] == 255).all()
    assert np.abs(colors[:, :3] - expected).max() <= 1


@pytest.mark.parametrize("block_cells", [7, 33, 500])
def test_block_size_changes_nothing(everything, mesh, device, block_cells):
    """The same mesh, bit for bit, from other blocks than the default 64 cells."""
    voxel = {7: 0.05}.get(block_cells, 0.02)
    reference = mesh if voxel == 0.02 else extract_mesh(BallRoom(), everything, voxel=voxel, device=device)
    other = extract_mesh(BallRoom(), everything, voxel=voxel, block_cells=block_cells, device=device)
    assert np.array_equal(reference.vertices, other.vertices)
    assert np.array_equal(reference.faces, other.faces)
    assert np.array_equal(reference.visual.vertex_colors, other.visual.vertex_colors)


def test_band_changes_nothing_but_the_cost(everything, mesh, device):
    """Asking the field everywhere gives the same mesh; the band asks it less often."""
    near, full = BallRoom(), BallRoom()
    banded = extract_mesh(near, everything, voxel=0.04, device=device)
    complete = extract_mesh(full, everything, voxel=0.04, band=None, device=device)
    assert np.array_equal(banded.vertices, complete.vertices)
    assert np.array_equal(banded.faces, complete.faces)
    assert near.asked < 0.75 * full.asked


def test_unseen_regions_have_no_faces(device):
    """One camera: its mesh ends where its sight ends, and nothing is behind the ball or behind the camera."""
    single = view((-1.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    mesh = extract_mesh(BallRoom(), [single], device=device)
    p = mesh.vertices - OFFSET
    assert (p[:, 0] > -1.0).all()
    on_ball = np.linalg.norm(p, axis=1) < RADIUS + 0.02
    assert on_ball.any() and (~on_ball).any()
    # The tangent cone from the camera touches the ball at x = -R^2 / 1 m; the margin is 10 cm behind a surface.
    assert p[on_ball, 0].max() < -(RADIUS**2) + 0.1
    # The ball's shadow on the far wall has the radius 2.2 tan(asin(0.3)).
    shadow = (p[:, 0] > 1.15) & (np.linalg.norm(p[:, 1:], axis=1) < 2.2 * np.tan(np.arcsin(RADIUS)) - 0.1)
    assert not shadow.any()
    # No closing sheet at the border: what is there lies on the true surface.
    assert np.abs(BallRoom().distance(mesh.vertices)).max() < 0.02


def test_open_edges_only_at_the_border_of_sight(device):
    """Every open edge of a single view's mesh has an unobserved lattice point within one cell."""
    single = view((-1.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    mesh = extract_mesh(BallRoom(), [single], device=device, cull_back_faces=False, min_component_area=0.0)
    middles = np.array([mesh.vertices[list(edge)].mean(axis=0) for edge in open_edges(mesh.faces)])
    assert len(middles) > 20
    lo, hi = (np.floor(corner / 0.02).astype(int) for corner in BallRoom().bounds)
    evidence = Evidence([single], 0.1, 0.15, device)
    observed, _ = evidence.classify(lo, tuple(hi - lo + 1), np.zeros(1, np.int32), 0.02)
    cell = np.floor(middles / 0.02).astype(int) - lo
    for i, j, k in cell:
        assert not observed[i - 1 : i + 3, j - 1 : j + 3, k - 1 : k + 3].all()


def test_grazing_floor_has_no_holes(device):
    """A floor seen at 6 to 20 degrees from a low camera keeps the lattice layer below it."""
    low = view((-1.1, 0.5, -0.55), (1.2, 0.5, -0.7), Intrinsics(160.0, 160.0, 159.5, 119.5, 320, 240))
    # This voxel puts a lattice plane 17 mm below the floor, which 10 cm along z does not reach beyond 1.5 m.
    mesh = extract_mesh(BallRoom(), [low], voxel=0.0271, device=device)
    x, y = np.meshgrid(np.linspace(-0.3, 1.1, 50), np.linspace(0.4, 0.6, 10))
    start = np.stack([x.ravel(), y.ravel(), np.full(x.size, -0.7)], axis=1) + OFFSET
    floor = mesh.vertices[np.abs(mesh.vertices[:, 2] - (OFFSET - ROOM)[2]) < 0.003]
    gap = np.linalg.norm(floor[None, :, :2] - start[:, None, :2], axis=2).min(axis=1)
    assert gap.max() < 0.0271


def test_shell_behind_a_wall_is_culled(everything, device):
    """A field that turns free again 5 cm inside the solid makes a second shell, which no camera sees from the front."""

    class Shell(BallRoom):
        def query_occupancy(self, points, level="fine"):
            d = self.distance(points)
            return np.where(d < -0.025, 10 * (d + 0.05), -10 * d).astype(np.float32)

    culled = extract_mesh(Shell(), everything, device=device)
    kept = extract_mesh(Shell(), everything, cull_back_faces=False, device=device)
    assert Shell().distance(kept.vertices).min() < -0.04
    assert Shell().distance(culled.vertices).min() > -0.025
    assert culled.area == pytest.approx(extract_mesh(BallRoom(), everything, device=device).area, rel=0.01)


def test_missing_depth_is_no_evidence(device):
    """Where the sensor gave nothing (0, NaN, negative) there is no mesh; the caller's array is left alone."""
    whole = view((0.0, -0.9, 0.0), (0.0, -0.2, 0.0))
    depth = whole.depth.copy()
    depth[:, :20], depth[:, 20:30], depth[:, 30:40] = 0.0, np.nan, -1.0
    before = depth.copy()
    mesh = extract_mesh(BallRoom(), [replace(whole, depth=depth)], device=device)
    assert np.array_equal(depth, before, equal_nan=True)
    assert mesh.vertices[:, 0].min() > OFFSET[0] - 0.03
    assert extract_mesh(BallRoom(), [whole], device=device).vertices[:, 0].min() < -0.5


class Floater(BallRoom):
    """A second ball of 10 cm in free space, which no camera measured: they look through it."""

    def query_occupancy(self, points, level="fine"):
        d = np.linalg.norm(points - np.array([0.7, 0.5, 0.3]) - OFFSET, axis=1) - 0.1
        return np.maximum(super().query_occupancy(points, level), -10 * d).astype(np.float32)


def test_small_components_are_dropped_unless_measured(everything, device):
    """Of two balls, both below the least area, the one that the depth images show stays and the floating one goes."""
    settings = {"voxel": 0.04, "band": None, "device": device}
    mesh = extract_mesh(Floater(), everything, min_component_area=2.0, **settings)
    floating = np.linalg.norm(mesh.vertices - OFFSET - [0.7, 0.5, 0.3], axis=1) < 0.15
    on_ball = np.linalg.norm(mesh.vertices - OFFSET, axis=1) < 0.35
    assert on_ball.sum() > 500 and not floating.any()
    kept = extract_mesh(Floater(), everything, min_component_area=0.05, **settings)
    assert (np.linalg.norm(kept.vertices - OFFSET - [0.7, 0.5, 0.3], axis=1) < 0.15).sum() > 50


def test_small_and_unmeasured_is_an_error(everything, device):
    """A surface 8 cm in front of everything that was measured, all of whose pieces are too small."""
    with pytest.raises(MeshError, match="min_component_area"):
        extract_mesh(BallRoom(), everything, voxel=0.04, level_set=-0.8, min_component_area=500.0, device=device)


def test_level_set_moves_the_surface(everything, device):
    """At logit -0.5 (5 cm before the solid, 10 per metre) the vertices lie 5 cm in free space."""
    mesh = extract_mesh(BallRoom(), everything, level_set=-0.5, device=device)
    assert np.median(BallRoom().distance(mesh.vertices)) == pytest.approx(0.05, abs=1e-4)


def test_bounds_limit_the_mesh(everything, device):
    """Nothing is asked or meshed outside the scene's bounds."""
    lo, hi = np.array([-2.0, -2.0, -2.0]), np.array([0.5, 2.0, 2.0])
    mesh = extract_mesh(BallRoom(bounds=(lo, hi)), everything, voxel=0.04, device=device)
    assert mesh.vertices[:, 0].max() <= 0.5 + 1e-6


@pytest.mark.parametrize("seed", range(3))
def test_any_field_gives_a_closed_surface(seed):
    """Random signs reach all 256 cases: the tables agree on every shared face."""
    n = 24
    logits = np.random.default_rng(seed).normal(size=(n, n, n)).astype(np.float32)
    logits[[0, -1]] = logits[:, [0, -1]] = logits[:, :, [0, -1]] = -1.0
    surface = Surface(np.zeros(3, int), np.full(3, n - 1), 0.1)
    surface.add_block(logits, np.ones((n - 1,) * 3, bool), np.zeros(3, int), 0.0)
    vertices, faces, _ = surface.merged()
    directed = Counter(map(tuple, np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).tolist()))
    assert len(faces) > 10000 and all(directed[b, a] == n for (a, b), n in directed.items())
    volume = trimesh.Trimesh(vertices, faces, process=False).volume
    assert volume > 0.3 * (0.1 * (n - 2)) ** 3 * 0.5


def test_progress_is_reported(everything, device):
    """The callback counts every block once."""
    calls = []
    extract_mesh(BallRoom(), everything, voxel=0.05, block_cells=20, device=device, progress=lambda *c: calls.append(c))
    assert len(calls) > 4 and calls == [(n + 1, len(calls)) for n in range(len(calls))]


def test_nothing_to_mesh_is_an_error(everything):
    """No views, views without depth, bounds elsewhere, and a field without a surface each say what to do."""
    with pytest.raises(MeshError, match="no view"):
        extract_mesh(BallRoom(), [])
    blind = ObservedView(np.zeros((60, 80), np.float32), CAMERA, np.eye(4))
    with pytest.raises(MeshError, match="no view"):
        extract_mesh(BallRoom(), [blind])
    with pytest.raises(MeshError, match="no lattice point was observed"):
        extract_mesh(BallRoom(bounds=(np.full(3, 50.0), np.full(3, 51.0))), everything, voxel=0.05)
    with pytest.raises(MeshError, match="no surface.*level_set"):
        extract_mesh(BallRoom(), everything, voxel=0.05, level_set=99.0)


def test_inside_out_field_is_an_error(device):
    """A field whose solid and free sides are swapped has only back faces."""

    class InsideOut(BallRoom):
        def query_occupancy(self, points, level="fine"):
            return -super().query_occupancy(points, level)

    with pytest.raises(MeshError, match="inside out"):
        extract_mesh(InsideOut(), [view((0.4, 0.2, 0), (1.2, 0.2, 0))], voxel=0.05, band=None, device=device)


@pytest.mark.parametrize("poison", [np.nan, np.inf])
def test_damaged_field_is_an_error(everything, poison):
    """NaN and infinite logits are named, with the method and a place."""
    with pytest.raises(MeshError, match=r"query_occupancy returned NaN or infinite occupancy logits at \d+ of"):
        extract_mesh(BallRoom(poison=poison), everything, voxel=0.05)


@pytest.mark.parametrize(
    ("name", "value"),
    [("voxel", 0.0), ("voxel", np.nan), ("band", -0.1), ("behind_surface", -1.0), ("level_set", np.inf)]
    + [("min_component_area", -1.0), ("block_cells", 0), ("block_cells", np.inf), ("level_set", "x")]
    + [("voxel", value) for value in (-(10**30), 10**400, True, "x", 1j, np.zeros(3))],
)
def test_bad_arguments_are_named(everything, name, value):
    """The message names the argument and its value."""
    with pytest.raises(InputError, match=name):
        extract_mesh(BallRoom(), everything, **{name: value})


def test_depth_must_fit_the_camera():
    """A resized image with the old intrinsics is refused, with the remedy."""
    with pytest.raises(InputError, match="scaled"):
        ObservedView(np.ones((30, 40), np.float32), CAMERA, np.eye(4))
