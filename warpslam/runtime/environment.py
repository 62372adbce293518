"""The process and the machine it runs on: memory, and versions of the packages."""

from __future__ import annotations

import os
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import warp as wp

PACKAGES = ("warp-lang", "torch", "numpy", "trimesh", "opencv-python-headless", "open3d")


def package_versions() -> dict[str, str | None]:
    """Version of each package in `PACKAGES`; None where one is not installed."""
    versions: dict[str, str | None] = {}
    for package in PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            versions[package] = None
    return versions


def resident_bytes() -> int:
    """Memory that this process holds; where the system does not tell, the most it has held."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        import resource

        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    return pages * os.sysconf("SC_PAGE_SIZE")


def free_gigabytes(device: wp.Device) -> float | None:
    """Memory of a device, or of the machine for the CPU, that is not in use [GB]; None where that can't be told."""
    if device.is_cuda:
        return device.free_memory / 1e9
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        return next(int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")) * 1024 / 1e9
    except (OSError, StopIteration, IndexError, ValueError):  # not Linux
        return None


def peak_memory_mib() -> float | None:
    """The most memory that this process has held [MiB]; None where that can't be told."""
    try:
        import resource
    except ImportError:  # not on Windows
        return None
    unit = 2**20 if sys.platform == "darwin" else 2**10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit
