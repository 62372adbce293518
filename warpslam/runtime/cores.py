"""Into how many slices a launch is cut, and how many CPU cores of this process run them."""

from __future__ import annotations

import os
from functools import lru_cache
from typing import TYPE_CHECKING

import psutil

from warpslam.errors import ConfigError

if TYPE_CHECKING:
    import warp as wp

MAX_SLICES = 8
DEFAULT_SLICES = 2


def slice_count(device: wp.Device) -> int:
    """Slices of a launch over rays, which is also the number of gradient buffers: 1 on CUDA.

    On the CPU it says in which order sums are formed, and so decides the last bits of every result. It must not depend
    on the machine, or on how many of its cores are to be had: it is `DEFAULT_SLICES` unless WARPSLAM_SLICES says
    otherwise.
    """
    return 1 if device.is_cuda else _cpu_slices()


def thread_count() -> int:
    """Threads that run the slices of a launch: the CPU's cores, or as few as WARPSLAM_THREADS says. Changes no bit."""
    return max(1, _core_count())


@lru_cache(maxsize=1)
def _cpu_slices() -> int:
    count = _number("WARPSLAM_SLICES", DEFAULT_SLICES)
    if count > MAX_SLICES:
        raise ConfigError(f"environment variable WARPSLAM_SLICES = {count} must be at most {MAX_SLICES}")
    return count


def process_cores() -> list[int]:
    """Numbers of the cores that this process may use, ascending."""
    process = psutil.Process()
    # (macOS pins nothing.)
    return sorted(process.cpu_affinity()) if hasattr(process, "cpu_affinity") else list(range(psutil.cpu_count() or 1))


@lru_cache(maxsize=1)
def _core_count() -> int:
    """Cores that this process may use; fewer where several share a machine and WARPSLAM_THREADS says so."""
    cores = len(process_cores())
    return min(cores, _number("WARPSLAM_THREADS", cores))


def _number(variable: str, default: int) -> int:
    text = os.environ.get(variable, "")
    if not text:
        return default
    if not text.isdecimal() or int(text) < 1:
        raise ConfigError(f"environment variable {variable} = {text!r} must be a whole number from 1 on")
    return int(text)
