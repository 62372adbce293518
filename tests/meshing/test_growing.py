"""A mesh that is made anew block by block: the same surface as at once, and only where something was seen."""

from __future__ import annotations

import numpy as np

from tests.meshing.ball_room import BallRoom, view
from warpslam.meshing import extract_mesh
from warpslam.meshing.growing import GrowingMesh

VOXEL = 0.04


def centres(vertices: np.ndarray, faces: np.ndarray) -> set[tuple[float, ...]]:
    return {tuple(centre) for centre in np.round(vertices[faces].mean(axis=1), 6).tolist()}


def test_blocks_together_are_the_mesh(everything, device):
    """What all blocks hold is what extraction at once gives, but for what it drops by the whole."""
    growing = GrowingMesh(VOXEL, block_cells=10, device=device)
    blocks = dict(growing.update(BallRoom(), everything, np.inf))
    assert growing.due_count == 0 and len(blocks) > 20
    whole = extract_mesh(
        BallRoom(), everything, voxel=VOXEL, behind_surface=0, band=2 * VOXEL, min_component_area=0, device=device
    )
    found = set().union(*(centres(block.vertices, block.faces) for block in blocks.values()))
    expected = centres(whole.vertices, whole.faces)
    assert len(found & expected) >= 0.99 * len(expected) and len(found) <= 1.01 * len(expected)
    colors = np.concatenate([block.colors for block in blocks.values()])
    vertices = np.concatenate([block.vertices for block in blocks.values()])
    assert np.abs(colors[:, :3] - 255 * (0.5 + 0.25 * vertices)).max() < 2


def test_only_what_a_new_view_sees_is_made_anew(everything, device):
    """A view of one corner asks for the blocks there, and the field is asked nowhere else."""
    growing, scene = GrowingMesh(VOXEL, block_cells=10, device=device), BallRoom()
    first = dict(growing.update(scene, everything, np.inf))
    assert list(growing.update(scene, everything, np.inf)) == []
    corner = view((0.9, 0.6, 0.4), (1.2, 1.0, 0.8))
    again = dict(growing.update(scene, [*everything, corner], np.inf))
    assert 0 < len(again) < len(first) / 3
    size = 10 * VOXEL
    assert all(((np.array(key) + 1) * size > 0).all() for key in again)


def test_a_little_at_a_time(everything, device):
    """Without time one block is made, what was seen last first; what is left comes with the next calls."""
    growing = GrowingMesh(VOXEL, block_cells=10, device=device)
    growing.note(everything[:1])
    early = growing.due_count
    growing.note(everything[:2])
    total = growing.due_count
    assert total > early
    steps = 0
    while growing.due_count:
        steps += 1
        assert len(list(growing.update(BallRoom(), everything[:2], 0.0))) <= 1
    assert steps == total


def test_a_surface_that_goes_is_taken_away(everything, device):
    """Where the map has become free, a block that was shown says that it has nothing any more."""
    growing = GrowingMesh(VOXEL, block_cells=10, device=device)
    shown = dict(growing.update(BallRoom(), everything, np.inf))
    gone = BallRoom(poison=-100.0)  # free wherever x > 0
    again = dict(growing.update(gone, [*everything, *everything], np.inf))
    removed = [key for key, block in again.items() if block is None]
    assert removed and all(shown[key] is not None for key in removed)
