"""What a map holds, for the figures of a run: memory by level, the volume it has observed, keyframes and overlaps."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from warpslam.poses import pose_from_vector
from warpslam.scene.keyframes import overlap_fractions
from warpslam.scene.mapped_views import SEEN_STRIDE

if TYPE_CHECKING:
    from warpslam.slam import Slam

OBSERVED_CELL = 0.16  # [m]
OBSERVED_RAYS = 1000  # a frame, about; at 3 m they lie closer than a cell
MIN_OVERLAP = 0.05
MAX_KEYFRAMES = 150  # pairs grow with the square; beyond, an even choice of them is compared


def take_inventory(slam: Slam) -> dict[str, Any]:
    """Figures of a map under the names of metrics.json.

    Returns:
        levels: Of each grid the spacing [m], vertices per axis and bytes of its features.
        bounds_m: Lower and upper corner of the map.
        observed_volume_m3: See `observed_volume`.
        keyframes: ``frames`` (numbers as `Slam.step` counts) and ``overlaps``, see `keyframe_overlaps`.
    """
    frames, overlaps = keyframe_overlaps(slam)
    return {
        "levels": {
            level: {"spacing_m": grid.spacing, "shape": list(grid.shape), "bytes": grid.features.capacity}
            for level, grid in slam.scene.grids.items()
        },
        "bounds_m": np.stack(slam.scene.bounds),
        "observed_volume_m3": observed_volume(slam),
        "keyframes": {"frames": frames, "overlaps": overlaps},
    }


def observed_volume(slam: Slam) -> float:
    """Volume [m^3] of the 0.16 m cells that the depth rays of mapped frames crossed on their way to a surface."""
    camera = slam.intrinsics.strided(SEEN_STRIDE)
    cells: set[int] = set()
    for seen in slam._seen:
        stride = max(1, round(np.sqrt(camera.width * camera.height / OBSERVED_RAYS)))
        depth = seen.depth()[::stride, ::stride]
        v, u = np.nonzero(depth)
        if not len(v):
            continue
        rays = np.stack([(u * stride - camera.cx) / camera.fx, (v * stride - camera.cy) / camera.fy, np.ones(len(u))])
        steps = np.arange(0.0, depth.max(), OBSERVED_CELL / 2)
        z = steps[:, None] * np.ones(len(u))
        local = (rays[:, None] * z)[:, z <= depth[v, u]]
        T = pose_from_vector(slam._vectors[seen.index])
        index = np.floor((local.T @ T[:3, :3].T + T[:3, 3]) / OBSERVED_CELL).astype(np.int64) + (1 << 20)
        cells.update(np.unique((index[:, 0] << 42) | (index[:, 1] << 21) | index[:, 2]).tolist())
    return len(cells) * OBSERVED_CELL**3


def keyframe_overlaps(slam: Slam) -> tuple[list[int], list[tuple[int, int, float]]]:
    """Frame numbers of the keyframes, and (a, b, share) of the pairs of them that see the same part of the scene.

    a and b are positions in the list of keyframes, a < b. The share is that of Sec. 3.4, by which the mapper chooses
    its window, averaged over both directions; pairs below 0.05 are left out.
    """
    keyframes = slam.keyframes
    chosen = np.unique(np.linspace(0, len(keyframes) - 1, min(len(keyframes), MAX_KEYFRAMES)).round().astype(int))
    poses = [pose_from_vector(keyframes[n].pose) for n in chosen]
    if not slam._seen or not keyframes:
        return [keyframe.index for keyframe in keyframes], []
    camera = slam.intrinsics
    rng = np.random.default_rng(0)
    shares = np.zeros((len(chosen), len(chosen)))
    for row, n in enumerate(chosen):
        # Not every keyframe was mapped; the mapped frame nearest in time stands for what it saw.
        seen = min(slam._seen, key=lambda view: abs(view.index - keyframes[n].index))
        depth = seen.depth().repeat(SEEN_STRIDE, axis=0).repeat(SEEN_STRIDE, axis=1)[: camera.height, : camera.width]
        shares[row] = overlap_fractions(depth, pose_from_vector(slam._vectors[seen.index]), poses, camera, rng)
    mean = (shares + shares.T) / 2
    pairs = np.argwhere(np.triu(mean >= MIN_OVERLAP, k=1))
    overlaps = [(int(chosen[a]), int(chosen[b]), round(float(mean[a, b]), 3)) for a, b in pairs]
    return [keyframe.index for keyframe in keyframes], overlaps


def memory_report(slam: Slam) -> dict[str, float | None]:
    """Bytes of the state that makes the map, and per cubic metre that was observed.

    grid_bytes: Features of the four grids. keyframe_bytes: Compact images. seen_bytes: What mapped frames saw, for the
    mesh. image_slot_bytes: Images on the device, which come and go. observed_m3: See `observed_volume`.
    """
    grids = sum(grid.row_count * 32 * 4 for grid in slam.scene.grids.values())
    keyframes = slam._images.compact_bytes
    seen = sum(seen.millimetres.nbytes for seen in slam._seen)
    observed = observed_volume(slam)
    return {
        "grid_bytes": grids,
        "keyframe_bytes": keyframes,
        "seen_bytes": seen,
        "state_bytes": grids + keyframes + seen,
        "image_slot_bytes": slam._images.device_bytes,
        "observed_m3": observed,
        "state_bytes_per_observed_m3": (grids + keyframes + seen) / observed if observed else None,
    }
