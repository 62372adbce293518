"""What a map holds: observed volume, keyframe overlaps, bytes by level."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from warpslam.camera import Intrinsics
from warpslam.scene.inventory import keyframe_overlaps, observed_volume, take_inventory
from warpslam.scene.keyframes import Keyframe
from warpslam.scene.mapped_views import SeenDepth
from warpslam.storage.json_files import to_json

CAMERA = Intrinsics(100.0, 100.0, 79.5, 59.5, 160, 120)


def slam_of(poses: list[np.ndarray], *, mapped: tuple[int, ...] | None = None, depth: float = 2.0) -> SimpleNamespace:
    """Keyframes that look at a wall; ``mapped`` are those that left a depth image."""
    mapped = tuple(range(len(poses))) if mapped is None else mapped
    seen = [SeenDepth.of(n, np.full((120, 160), depth, np.float32)) for n in mapped]
    grid = SimpleNamespace(spacing=0.32, shape=(2, 3, 4), bytes=24 * 128)
    return SimpleNamespace(
        keyframes=[Keyframe(n, n + 1, T) for n, T in enumerate(poses)],
        scene=SimpleNamespace(grids={"middle": grid}, bounds=(np.zeros(3), np.ones(3))),
        images=SimpleNamespace(camera=CAMERA, compact_bytes=1000, device_bytes=2000),
        seen=seen,
        views=[one.view(CAMERA, poses[one.index]) for one in seen],
    )


def overlaps(slam: SimpleNamespace) -> list[tuple[int, int, float]]:
    return keyframe_overlaps(slam.keyframes, slam.seen, slam.views, CAMERA)


def inventory(slam: SimpleNamespace) -> dict[str, Any]:
    return take_inventory(slam.scene, slam.images, slam.keyframes, slam.seen, slam.views)


def turned(degrees: float) -> np.ndarray:
    """A camera at the origin that looks to the side."""
    a = np.radians(degrees)
    T = np.eye(4)
    T[:3, :3] = [[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]]
    return T


def test_observed_volume_is_that_of_the_frustum():
    """One view of a wall 2 m away crosses a pyramid; the same view twice adds nothing, another one does."""
    pyramid = (2.0 * 160 / 100) * (2.0 * 120 / 100) * 2.0 / 3
    once = observed_volume(slam_of([np.eye(4)]).views)
    # Cells at the border count whole.
    assert pyramid < once < 1.6 * pyramid
    assert observed_volume(slam_of([np.eye(4), np.eye(4)]).views) == once
    assert observed_volume(slam_of([np.eye(4), turned(180)]).views) > 1.8 * once
    assert observed_volume(slam_of([np.eye(4)], depth=0.0).views) == 0


def test_overlaps_join_keyframes_that_see_the_same():
    """Neighbours share more than those further apart; back to back share nothing and are left out."""
    slam = slam_of([turned(0), turned(10), turned(40), turned(180)])
    shares = {(a, b): share for a, b, share in overlaps(slam)}
    assert inventory(slam)["keyframes"]["frames"] == [0, 1, 2, 3]
    assert 1 > shares[0, 1] > shares[0, 2] > 0.05 and shares[1, 2] > shares[0, 2]
    assert not any(3 in pair for pair in shares)


def test_a_keyframe_that_was_not_mapped_is_judged_by_its_neighbour():
    """Without depth images of their own, keyframes keep their links, at about the same strength."""
    poses = [turned(0), turned(5), turned(10)]
    both, one = (overlaps(slam_of(poses, mapped=mapped)) for mapped in ((0, 1, 2), (0,)))
    assert [pair[:2] for pair in one] == [pair[:2] for pair in both] == [(0, 1), (0, 2), (1, 2)]
    assert [pair[2] for pair in one] == pytest.approx([pair[2] for pair in both], abs=0.2)
    assert overlaps(slam_of(poses, mapped=())) == []


def test_inventory_is_json(tmp_path):
    """All figures can be written; without keyframes there are none."""
    figures = inventory(slam_of([np.eye(4)]))
    assert figures["levels"]["middle"] == {"spacing_m": 0.32, "shape": [2, 3, 4], "bytes": 3072}
    assert '"observed_volume_m3"' in to_json(figures)
    assert overlaps(slam_of([])) == []
