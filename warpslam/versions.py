"""Versions of what a run depends on."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version

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
