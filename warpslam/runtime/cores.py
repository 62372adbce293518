"""CPU cores of this process, and into how many slices they cut a launch."""

from __future__ import annotations

import os
from functools import lru_cache
from typing import TYPE_CHECKING

import psutil

from warpslam.errors import ConfigError

if TYPE_CHECKING:
    import warp as wp

MAX_SLICES = 8


def slice_count(device: wp.Device) -> int:
    """Slices of a launch over rays, which is also the number of gradient buffers: the CPU's cores (at most 8), 1 on
    CUDA.
    """
    if device.is_cuda:
        return 1
    return max(1, min(_core_count(), MAX_SLICES))


def process_cores() -> list[int]:
    """Numbers of the cores that this process may use, ascending."""
    process = psutil.Process()
    # (macOS pins nothing.)
    return sorted(process.cpu_affinity()) if hasattr(process, "cpu_affinity") else list(range(psutil.cpu_count() or 1))


@lru_cache(maxsize=1)
def _core_count() -> int:
    """Cores that this process may use; fewer where several share a machine and WARPSLAM_THREADS says so."""
    cores = len(process_cores())
    text = os.environ.get("WARPSLAM_THREADS", "")
    if not text:
        return cores
    if not text.isdecimal() or int(text) < 1:
        raise ConfigError(f"environment variable WARPSLAM_THREADS = {text!r} must be a whole number from 1 on")
    return min(cores, int(text))
