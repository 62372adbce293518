"""Seen, forecast and unseen: what the coarse level adds, and what it must leave alone."""

from __future__ import annotations

import numpy as np
import pytest

from tests.meshing.ball_room import OFFSET, RADIUS, ROOM, BallRoom, view
from warpslam.meshing import extract_mesh
from warpslam.meshing.cleaning import Hull
from warpslam.meshing.views import REACH_MARGIN, Evidence

CYAN = [0, 255, 255, 255]


class Leveled(BallRoom):
    """The coarse level knows the room without the ball, its walls 2 cm too far out, which the bias of 0.2 makes up."""

    def query_occupancy(self, points, level="fine"):
        if level == "fine":
            return super().query_occupancy(points, level)
        p = np.asarray(points, dtype=np.float64) - OFFSET
        return (-10.0 * (ROOM - np.abs(p)).min(axis=1) - 0.2).astype(np.float32)


def single_view():
    """One camera that looks along x past the ball."""
    return view((-1.0, 0.0, 0.0), (1.0, 0.0, 0.0))


@pytest.fixture(scope="module")
def both(device):
    """The mesh of one view without and with the forecast."""
    return tuple(extract_mesh(Leveled(), [single_view()], forecast=f, voxel=0.04, device=device) for f in (False, True))


def test_forecast_only_adds(both):
    """The seen faces come first and are the same, with the same colours; the added vertices are cyan."""
    seen, mesh = both
    count = mesh.metadata["forecast_faces"]
    assert seen.metadata["forecast_faces"] == 0 and count > 500
    assert len(mesh.faces) == len(seen.faces) + count
    assert np.array_equal(mesh.vertices[mesh.faces[:-count]], seen.vertices[seen.faces])
    colors = mesh.visual.vertex_colors
    assert np.array_equal(colors[mesh.faces[:-count]], seen.visual.vertex_colors[seen.faces])
    only = np.setdiff1d(np.arange(len(colors)), mesh.faces[:-count])
    assert len(only) > 250 and (colors[only] == CYAN).all()
    assert not (seen.visual.vertex_colors == CYAN).all(axis=1).any()


def test_forecast_is_the_biased_coarse_surface(both):
    """Walls that the view did not show are where coarse logit + 0.2 crosses 0; the ball's unseen back is left out."""
    _, mesh = both
    extra = np.unique(mesh.faces[-mesh.metadata["forecast_faces"] :])
    p = mesh.vertices[extra] - OFFSET
    p = p[(mesh.visual.vertex_colors[extra] == CYAN).all(axis=1)]
    on_wall = np.abs(ROOM - np.abs(p)).min(axis=1) < 0.005
    far_from_ball = np.linalg.norm(p, axis=1) > RADIUS + 0.15
    assert far_from_ball.sum() > 200 and on_wall[far_from_ball].mean() > 0.97


def test_forecast_stays_in_reach_and_in_the_hull(both):
    """Nothing is forecast beside the enlarged image, deeper than the view, or outside the hull of what was seen."""
    seen, mesh = both
    faces = mesh.faces[-mesh.metadata["forecast_faces"] :]
    p = mesh.vertices[np.unique(faces)]
    single = single_view()
    q = (p - single.T_world_camera[:3, 3]) @ single.T_world_camera[:3, :3]
    # A cell's corners are all in reach, so a vertex within it is.
    assert (q[:, 2] > 0).all() and q[:, 2].max() <= single.depth.max() + 1e-6
    assert (np.abs(q[:, 0]) <= (1.0 + REACH_MARGIN) * q[:, 2] + 1e-6).all()
    assert (np.abs(q[:, 1]) <= (0.75 + REACH_MARGIN) * q[:, 2] + 1e-6).all()
    hull = Hull(np.concatenate([single.points(), single.T_world_camera[None, :3, 3]]), 1.02)
    assert hull.contains(mesh.vertices)[faces].any(axis=1).all()


def test_no_second_wall_behind_a_seen_one(device):
    """A fine level that is free again 5 cm inside the walls, beside a coarse level that is solid there."""

    class Hollow(Leveled):
        def query_occupancy(self, points, level="fine"):
            d = self.distance(points)
            fine = np.where(d < -0.025, 10 * (d + 0.05), -10 * d).astype(np.float32)
            return fine if level == "fine" else super().query_occupancy(points, level)

    mesh = extract_mesh(Hollow(), [single_view()], forecast=True, voxel=0.04, device=device)
    extra = mesh.vertices[mesh.faces[-mesh.metadata["forecast_faces"] :]].mean(axis=1)
    inside = Hollow().distance(extra) < -0.04
    behind_far_wall = extra[:, 0] - OFFSET[0] > ROOM[0] + 0.04
    assert not (inside & behind_far_wall).any()


def test_forecast_does_not_depend_on_the_blocks(both, device):
    """The same mesh, bit for bit, from blocks of 11 cells."""
    _, mesh = both
    other = extract_mesh(Leveled(), [single_view()], forecast=True, voxel=0.04, block_cells=11, device=device)
    assert np.array_equal(mesh.vertices, other.vertices) and np.array_equal(mesh.faces, other.faces)
    assert np.array_equal(mesh.visual.vertex_colors, other.visual.vertex_colors)


def test_reach_is_the_enlarged_frustum(device):
    """Points inside and outside each side of the enlarged image, behind the camera, and beyond the largest depth."""
    single = single_view()
    evidence = Evidence([single], 0.1, 0.15, device)
    T, depth = single.T_world_camera, single.depth.max()
    x, y = 1.0 + REACH_MARGIN, 0.75 + REACH_MARGIN
    local = np.array(
        [[x - 0.1, 0, 1], [x + 0.1, 0, 1], [0.1 - x, 0, 1], [-x - 0.1, 0, 1], [0, y - 0.1, 1], [0, y + 0.1, 1]]
        + [[0, 0, -0.1], [0, 0, depth - 0.01], [0, 0, depth + 0.01]]
    )
    points = local @ T[:3, :3].T + T[:3, 3]
    found = []
    for point in points:
        start = np.rint(point / 1e-3).astype(np.int64)
        found.append(bool(evidence.reached(start, (1, 1, 1), np.zeros(1, np.int32), 1e-3)[0, 0, 0]))
    assert found == [True, False, True, False, True, False, False, True, False]


def test_hull_is_scaled_about_its_centre():
    """A box from 0 to 2 at scale 1.1 reaches from -0.1 to 2.1; the box test never leaves out what holds a point."""
    corners = np.array([[x, y, z] for x in (0.0, 2.0) for y in (0.0, 2.0) for z in (0.0, 2.0)])
    hull = Hull(np.concatenate([corners, [[1.0, 1.0, 1.0]]]), 1.1)
    points = np.array([[-0.09, 1, 1], [-0.11, 1, 1], [2.09, 2.09, 2.09], [2.11, 1, 1], [1, 1, 1]])
    np.testing.assert_array_equal(hull.contains(points), [True, False, True, False, True])
    assert hull.misses_box(np.array([2.2, 0, 0]), np.array([3.0, 1, 1]))
    assert not hull.misses_box(np.array([2.05, 0, 0]), np.array([3.0, 1, 1]))
