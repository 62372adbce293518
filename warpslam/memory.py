"""What a map takes, and how much of the world that covers."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import warp as wp

from warpslam.inventory import observed_volume

if TYPE_CHECKING:
    from warpslam.slam import Slam


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
