"""What a map holds, for the figures of a run: memory by level, the volume it has observed, keyframes and overlaps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from warpslam.camera import Intrinsics
from warpslam.scene.image_pool import ImagePool
from warpslam.scene.keyframes import Keyframe, overlap_fractions
from warpslam.scene.mapped_views import SEEN_STRIDE, ObservedView, SeenDepth
from warpslam.scene.scene_map import SceneMap
from warpslam.spread import spread

OBSERVED_CELL = 0.16  # [m]
OBSERVED_RAYS = 1000  # a frame, about; at 3 m they lie closer than a cell
MIN_OVERLAP = 0.05
MAX_KEYFRAMES = 150  # pairs grow with the square; beyond, an even choice of them is compared


def take_inventory(
    scene: SceneMap,
    images: ImagePool,
    keyframes: Sequence[Keyframe],
    seen: Sequence[SeenDepth],
    views: Sequence[ObservedView],
) -> dict[str, Any]:
    """Figures of a map under the names of metrics.json.

    Args:
        scene: The map.
        images: Images of the keyframes.
        keyframes: All of them.
        seen: What the mapped frames saw.
        views: The same, with the poses that the frames have by now.

    Returns:
        levels: Of each grid the spacing [m], vertices per axis of its box, and bytes of its features.
        bounds_m: Lower and upper corner of the map.
        observed_volume_m3: See `observed_volume`.
        keyframes: ``frames`` (numbers as `Slam.step` counts) and ``overlaps``, see `keyframe_overlaps`.
        memory: See `memory_report`.
    """
    observed = observed_volume(views)
    return {
        "levels": {
            level: {"spacing_m": grid.spacing, "shape": list(grid.shape), "bytes": grid.bytes}
            for level, grid in scene.grids.items()
        },
        "bounds_m": np.stack(scene.bounds),
        "observed_volume_m3": observed,
        "keyframes": {
            "frames": [keyframe.index for keyframe in keyframes],
            "overlaps": keyframe_overlaps(keyframes, seen, views, images.camera),
        },
        "memory": memory_report(scene, images, seen, observed),
    }


def observed_volume(views: Sequence[ObservedView]) -> float:
    """Volume [m^3] of the 0.16 m cells that the depth rays of mapped frames crossed on their way to a surface."""
    cells: set[int] = set()
    for view in views:
        camera, T = view.intrinsics, view.T_world_camera
        stride = max(1, round(np.sqrt(camera.width * camera.height / OBSERVED_RAYS)))
        depth = view.depth[::stride, ::stride]
        v, u = np.nonzero(depth)
        if not len(v):
            continue
        rays = camera.backproject(u * stride, v * stride, 1.0).T
        steps = np.arange(0.0, depth.max(), OBSERVED_CELL / 2)
        z = steps[:, None] * np.ones(len(u))
        local = (rays[:, None] * z)[:, z <= depth[v, u]]
        index = np.floor((local.T @ T[:3, :3].T + T[:3, 3]) / OBSERVED_CELL).astype(np.int64) + (1 << 20)
        cells.update(np.unique((index[:, 0] << 42) | (index[:, 1] << 21) | index[:, 2]).tolist())
    return len(cells) * OBSERVED_CELL**3


def keyframe_overlaps(
    keyframes: Sequence[Keyframe], seen: Sequence[SeenDepth], views: Sequence[ObservedView], camera: Intrinsics
) -> list[tuple[int, int, float]]:
    """(a, b, share) of the pairs of keyframes that see the same part of the scene.

    a and b are positions in the list of keyframes, a < b. The share is that of Sec. 3.4, by which the mapper chooses
    its window, averaged over both directions; pairs below 0.05 are left out.
    """
    if not seen or not keyframes:
        return []
    chosen = spread(len(keyframes), MAX_KEYFRAMES)
    poses = [keyframes[n].pose for n in chosen]
    mapped = np.array([one.index for one in seen])
    rng = np.random.default_rng(0)
    shares = np.zeros((len(chosen), len(chosen)))
    for row, n in enumerate(chosen):
        # Not every keyframe was mapped; the mapped frame nearest in time stands for what it saw.
        view = views[int(np.argmin(np.abs(mapped - keyframes[n].index)))]
        depth = view.depth.repeat(SEEN_STRIDE, axis=0).repeat(SEEN_STRIDE, axis=1)[: camera.height, : camera.width]
        shares[row] = overlap_fractions(depth, view.T_world_camera, poses, camera, rng)
    mean = (shares + shares.T) / 2
    pairs = np.argwhere(np.triu(mean >= MIN_OVERLAP, k=1))
    return [(int(chosen[a]), int(chosen[b]), round(float(mean[a, b]), 3)) for a, b in pairs]


def memory_report(
    scene: SceneMap, images: ImagePool, seen: Sequence[SeenDepth], observed: float
) -> dict[str, float | None]:
    """Bytes of the state that makes the map, and per cubic metre that was observed.

    Args:
        scene: The map.
        images: Images of the keyframes.
        seen: What the mapped frames saw.
        observed: Volume [m^3], see `observed_volume`.

    Returns:
        grid_bytes: Features of the four grids.
        keyframe_bytes: Compact images.
        seen_bytes: What mapped frames saw, for the mesh.
        state_bytes: The three together.
        image_slot_bytes: Images on the device, which come and go.
        state_bytes_per_observed_m3: None where nothing was observed.
    """
    grids = sum(grid.bytes for grid in scene.grids.values())
    keyframes = images.compact_bytes
    views = sum(one.millimetres.nbytes for one in seen)
    total = grids + keyframes + views
    return {
        "grid_bytes": grids,
        "keyframe_bytes": keyframes,
        "seen_bytes": views,
        "state_bytes": total,
        "image_slot_bytes": images.device_bytes,
        "state_bytes_per_observed_m3": total / observed if observed else None,
    }
