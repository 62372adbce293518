"""What a map takes, and how much of the world that covers."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warpslam.camera import pose_from_vector
from warpslam.frustum import select_in_frustum
from warpslam.keyframes import SEEN_STRIDE

if TYPE_CHECKING:
    from warpslam.slam import Slam

VIEW_COUNT = 200


def free_gigabytes(device: wp.Device) -> float | None:
    """Memory of a device, or of the machine for the CPU, that is not in use [GB]; None where that can't be told."""
    if device.is_cuda:
        return device.free_memory / 1e9
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        return next(int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")) * 1024 / 1e9
    except (OSError, StopIteration, IndexError, ValueError):  # not Linux
        return None


def memory_report(slam: Slam) -> dict[str, float | None]:
    """Bytes of the state that makes the map, and per cubic metre that was observed.

    grid_bytes: Features of the four grids. keyframe_bytes: Compact images. seen_bytes: What mapped frames saw, for the
    mesh. image_slot_bytes: Images on the device, which come and go. observed_m3: Space in front of measured surfaces.
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


def observed_volume(slam: Slam) -> float:
    """Space that mapped frames (at most 200 of them) looked through, counted in cells of the middle grid [m^3]."""
    if slam.scene.is_empty or not slam._seen:
        return 0.0
    grid, camera = slam.scene.grids["middle"], slam.intrinsics.strided(SEEN_STRIDE)
    seen = np.zeros(grid.row_count, bool)
    for n in np.unique(np.linspace(0, len(slam._seen) - 1, VIEW_COUNT).round().astype(int)):
        view = slam._seen[n]
        depth = wp.array(view.depth(), dtype=float, device=slam.device)
        T_world_camera = pose_from_vector(slam._vectors[view.index])
        seen |= select_in_frustum(grid.lattice, grid.shape, camera, T_world_camera, depth, 0.0)
    return float(seen.sum()) * grid.spacing**3
