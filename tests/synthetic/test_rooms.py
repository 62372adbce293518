"""Rooms: exact occupancy, surface samples, colours and determinism."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from warpslam.errors import InputError
from warpslam.synthetic import make_room
from warpslam.synthetic.rooms import Room
from warpslam.synthetic.solids import Solid, yaw_rotation
from warpslam.synthetic.textures import PATTERNS, random_material


def solid(kind: str, half, *, center=(0.0, 0.0, 0.0), yaw: float = 0.0, tilt: float = 0.0, taper: float = 1.0) -> Solid:
    return Solid(kind, np.array(center, float), yaw_rotation(yaw, tilt), np.array(half, float), 0, taper)


def room_of(*solids: Solid, reach: float = 5.0) -> Room:
    materials = [random_material(np.random.default_rng(0))]
    return Room(list(solids), materials, np.array([[-reach] * 3, [reach] * 3]), np.zeros(3), 0.2)


@pytest.mark.parametrize(
    ("kind", "options", "inside", "outside"),
    [
        ("box", {"yaw": np.pi / 4}, [1.40, 0, 0], [1.0, 0.99, 0]),
        ("frustum", {}, [0.70, 0.70, 2.99], [0.72, 0.72, 0]),
        ("frustum", {"taper": 0.5}, [0.74, 0, 0], [0.76, 0, 0]),
        ("frustum", {"tilt": np.pi / 2}, [0, -2.99, 0], [0, 0, 1.01]),
        ("ellipsoid", {}, [0, 0, 2.99], [0.6, 0, 2.5]),
    ],
)
def test_solid_contains(kind, options, inside, outside):
    """Points worked out by hand lie on the right side of each solid's surface."""
    half = (1.0, 1.0, 3.0)
    result = solid(kind, half, **options).contains(np.array([inside, outside], float))
    assert result.tolist() == [True, False]


@pytest.mark.parametrize("kind", ["box", "frustum", "ellipsoid"])
def test_solid_mesh_agrees_with_occupancy(kind):
    """A solid's triangles are closed, face outwards and hold the points that `contains` holds."""
    part = solid(kind, (0.3, 0.2, 0.4), center=(0.1, 0.2, 0.3), yaw=0.7, tilt=0.4, taper=0.6)
    surface = part.surface(0.05)
    mesh = trimesh.Trimesh(surface.vertices, surface.faces)
    mesh.merge_vertices(digits_vertex=7)
    mesh.update_faces(mesh.nondegenerate_faces())
    assert mesh.is_watertight
    exact = {"box": 8.0, "frustum": 2 * np.pi * (1 + 0.6 + 0.36) / 3, "ellipsoid": 4 / 3 * np.pi}[kind] * 0.024
    assert mesh.volume == pytest.approx(exact, rel=0.02)
    points = np.random.default_rng(0).uniform(-0.6, 0.9, size=(4000, 3))
    assert part.contains(points).mean() == pytest.approx(exact / 1.5**3, rel=0.2)
    # Winding number instead of a ray library: the solid angle of a closed mesh is 4 pi inside and 0 outside.
    a, b, c = (mesh.triangles[:, k][None] - points[:300, None] for k in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=-1) for v in (a, b, c))
    det = (a * np.cross(b, c)).sum(-1)
    div = la * lb * lc + (a * b).sum(-1) * lc + (b * c).sum(-1) * la + (c * a).sum(-1) * lb
    wound = np.arctan2(det, div).sum(axis=1) / (2 * np.pi)
    disagree = (wound > 0.5) != part.contains(points[:300])
    assert disagree.mean() < 0.01


def test_occupancy_is_the_union_of_the_solids():
    """The culled, sorted lookup gives what testing every solid on every point gives."""
    room = make_room(5)
    points = np.random.default_rng(1).uniform(*room.bounds, size=(20000, 3))
    brute = np.any([s.contains(points) for s in room.solids], axis=0)
    np.testing.assert_array_equal(room.occupancy(points), brute)
    assert 0.2 < brute.mean() < 0.8


def test_room_is_closed():
    """Every wall, the floor and the ceiling are solid for 0.2 m behind the interior, in all directions."""
    for seed in range(5):
        room = make_room(seed)
        low, high = room.interior_bounds
        points = np.random.default_rng(seed).uniform(low, high, size=(3000, 3))
        for axis in range(3):
            for bound, sign in ((low, -1), (high, 1)):
                shell = points.copy()
                shell[:, axis] = bound[axis] + sign * 0.19
                assert room.occupancy(shell).all()


@pytest.mark.parametrize("seed", range(4))
def test_surface_samples(seed):
    """Samples separate free from occupied space at 1 mm along their unit normal; colours are in [0, 1]."""
    room = make_room(seed)
    points, normals, colors = room.sample_surface(5000, np.random.default_rng(0))
    assert points.shape == normals.shape == colors.shape == (5000, 3)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
    crossed = room.occupancy(points - 1e-3 * normals) & ~room.occupancy(points + 1e-3 * normals)
    assert crossed.mean() > 0.995
    assert colors.min() >= 0 and colors.max() <= 1 and colors.std() > 0.05


def test_surface_samples_are_uniform_by_area():
    """The share of a small cube's samples is its share of the area; the hidden face gets none."""
    big = solid("box", (1.0, 1.0, 0.5))
    small = solid("box", (0.5, 0.5, 0.5), center=(0, 0, 1.0))
    points, normals, _ = room_of(big, small).sample_surface(40000, np.random.default_rng(0))
    visible_big, visible_small = 8 + 8 - 1, 5
    share = (points[:, 2] > 0.5 + 1e-6).mean()
    assert share == pytest.approx(visible_small / (visible_big + visible_small), abs=0.01)
    covered = (np.abs(points[:, :2]) < 0.49).all(axis=1) & (np.abs(points[:, 2] - 0.5) < 1e-3)
    assert not covered.any()
    assert (normals[points[:, 2] > 1.5 - 1e-6] == [0, 0, 1]).all(axis=1).mean() > 0.95


def test_curved_samples_lie_on_the_exact_surface():
    """Samples of an ellipsoid satisfy its equation and their normals are its gradient."""
    half = np.array([0.5, 0.3, 0.2])
    points, normals, _ = room_of(solid("ellipsoid", half)).sample_surface(1000, np.random.default_rng(0))
    np.testing.assert_allclose(((points / half) ** 2).sum(axis=1), 1, atol=1e-5)
    gradient = points / half**2
    np.testing.assert_allclose(normals, gradient / np.linalg.norm(gradient, axis=1, keepdims=True), atol=1e-4)


def test_cone_normals_lean_towards_the_narrow_end():
    """A 45 degree cone's side has normals (cos a, sin a, 1) / sqrt(2), and its points keep radius + height constant."""
    cone = solid("frustum", (1.0, 1.0, 0.25), taper=0.5)
    points, normals, _ = room_of(cone).sample_surface(1000, np.random.default_rng(0))
    side = np.abs(points[:, 2]) < 0.2499
    np.testing.assert_allclose(normals[side, 2], np.sqrt(0.5), atol=1e-5)
    radius = np.linalg.norm(points[side, :2], axis=1)
    np.testing.assert_allclose(radius + points[side, 2], 0.75, atol=1e-5)
    np.testing.assert_allclose(normals[side, :2], points[side, :2] / radius[:, None] * np.sqrt(0.5), atol=1e-5)


def test_mesh_vertices_lie_on_the_surface():
    """No vertex floats: solids are within 1.5 mm of it, free space too unless its triangle is partly covered."""
    room = make_room(3)
    mesh = room.mesh(0.05)
    rng = np.random.default_rng(0)
    vertices = mesh.vertices[rng.choice(len(mesh.vertices), 2000)]
    shifts = 0.0015 * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    near = np.array([room.occupancy(vertices + shift) for shift in shifts])
    assert near.any(axis=0).mean() > 0.999
    assert near.all(axis=0).mean() < 0.15
    assert np.percentile(mesh.edges_unique_length, 99) < 0.075
    assert mesh.visual.kind == "vertex"


def test_vertex_colors_match_sample_colors():
    """The mesh carries the colour function that `sample_surface` evaluates."""
    room = make_room(7)
    points, _, colors = room.sample_surface(500, np.random.default_rng(0))
    mesh = room.mesh(0.04)
    distance, nearest = cKDTree(mesh.vertices).query(points)
    difference = np.abs(mesh.visual.vertex_colors[nearest][:, :3] / 255 - colors).max(axis=1)
    assert distance.max() < 0.05
    assert np.median(difference) < 0.05


def test_same_seed_same_room():
    """A seed fixes the room, its mesh and its samples; another seed gives another room."""
    first, second, other = make_room(11), make_room(11), make_room(12)
    np.testing.assert_array_equal(first.mesh(0.1).vertices, second.mesh(0.1).vertices)
    np.testing.assert_array_equal(first.mesh(0.1).visual.vertex_colors, second.mesh(0.1).visual.vertex_colors)
    samples = [room.sample_surface(50, np.random.default_rng(3))[0] for room in (first, second, other)]
    np.testing.assert_array_equal(samples[0], samples[1])
    assert not np.allclose(samples[0], samples[2])


def test_offset_moves_everything():
    """An offset shifts bounds, occupancy and samples, and leaves colours as they are."""
    offset = np.array([10.0, -4.0, 1.5])
    room, moved = make_room(2), make_room(2, offset=tuple(offset))
    np.testing.assert_allclose(moved.bounds, room.bounds + offset)
    points = np.random.default_rng(0).uniform(*room.bounds, size=(2000, 3))
    assert (room.occupancy(points) == moved.occupancy(points + offset)).mean() > 0.999
    a, b = (r.sample_surface(200, np.random.default_rng(0)) for r in (room, moved))
    np.testing.assert_allclose(a[0] + offset, b[0], atol=1e-5)
    np.testing.assert_allclose(a[2], b[2], atol=1e-4)


def test_unfurnished_room_is_emptier():
    """Without furniture there are only walls, floor, ceiling and what is set into them."""
    full, empty = make_room(4), make_room(4, furniture=False)
    assert len(empty.solids) < 0.5 * len(full.solids)
    points = np.random.default_rng(0).uniform(*full.bounds, size=(5000, 3))
    assert (full.occupancy(points) >= empty.occupancy(points)).all()


def test_free_space_keeps_its_margin():
    """A ball of the margin around a free point meets no solid; points in solids and outside are not free."""
    room = make_room(6)
    rng = np.random.default_rng(0)
    points = rng.uniform(room.bounds[0] - 1, room.bounds[1] + 1, size=(4000, 3))
    free = points[room.free_space(points, 0.25)]
    assert len(free) > 100
    for _ in range(20):
        direction = rng.normal(size=free.shape)
        direction *= 0.249 / np.linalg.norm(direction, axis=1, keepdims=True)
        assert not room.occupancy(free + direction).any()
    assert not (room.free_space(points, 0.0) & room.occupancy(points)).any()


@pytest.mark.parametrize("pattern", PATTERNS)
def test_patterns_vary_smoothly(pattern):
    """Every pattern stays in [0, 1] and varies over a wall."""
    material = random_material(np.random.default_rng(1), (pattern,))
    wall = np.stack(np.meshgrid(np.arange(0, 3, 0.05), [1.234], np.arange(0, 2, 0.05)), axis=-1).reshape(-1, 3)
    colors = material.color_at(wall)
    assert colors.dtype == np.float32 and colors.min() >= 0 and colors.max() <= 1
    assert colors.mean(axis=1).std() > 0.02


def test_wrong_shapes_are_refused():
    """Points and offsets of a wrong shape are named in the error."""
    room = make_room(0, furniture=False)
    with pytest.raises(InputError, match="expected \\(N, 3\\)"):
        room.occupancy(np.zeros((4, 2)))
    with pytest.raises(InputError, match="offset"):
        make_room(0, offset=(1.0, 2.0))
