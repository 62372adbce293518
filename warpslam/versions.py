"""Versions of what a run depends on."""

from __future__ import annotations

import platform
from importlib.metadata import PackageNotFoundError, version

PACKAGES = ("warp-lang", "torch", "numpy", "trimesh", "opencv-python-headless", "open3d")


def package_versions() -> dict[str, str | None]:
    """Version of warpslam, of Python and of each package in `PACKAGES`; None where one is not installed."""
    from warpslam import __version__

    versions: dict[str, str | None] = {"warpslam": __version__, "python": platform.python_version()}
    for package in PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            versions[package] = None
    return versions
