"""The process and the machine it runs on: memory, and versions of the packages."""

from __future__ import annotations

import runpy
import sys
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import psutil

from warpslam.errors import ConfigError, MapSizeError

if TYPE_CHECKING:
    import warp as wp

_TOO_SMALL_TO_ASK = 1 << 26
PACKAGES = ("warp-lang", "torch", "numpy", "scipy", "trimesh", "opencv-python-headless", "open3d")


def package_versions() -> dict[str, str | None]:
    """Version of each package in `PACKAGES`; None where one is not installed."""
    versions: dict[str, str | None] = {}
    for package in PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            versions[package] = None
    return versions


@dataclass(frozen=True)
class TorchBuild:
    """Which of PyTorch's builds is installed."""

    target: str
    """What it computes on: "CPU only", "CUDA 12.8", "ROCm 6.4"."""
    bytes: int
    """Of its folder; those of CUDA keep gigabytes more in packages of their own."""


def torch_build() -> TorchBuild | None:
    """The build of PyTorch, told without loading it, which takes seconds; None where there is none."""
    spec = find_spec("torch")
    if spec is None or spec.origin is None:
        return None
    folder = Path(spec.origin).parent
    try:
        facts = runpy.run_path(str(folder / "version.py"))
    except OSError:
        return None
    names = (("CUDA", facts.get("cuda")), ("ROCm", facts.get("hip")), ("XPU", facts.get("xpu")))
    target = next((f"{name} {number}" for name, number in names if number), "CPU only")
    return TorchBuild(target, sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()))


def resident_bytes() -> int:
    """Memory that this process holds."""
    return int(psutil.Process().memory_info().rss)


def named_device(name: str | None) -> wp.Device:
    """The Warp device of a name; its preferred one for None.

    Raises:
        ConfigError: There is none of that name.
    """
    import warp as wp

    from warpslam.runtime.quiet import start_warp

    start_warp()
    known = [str(device) for device in wp.get_devices()]
    try:
        return wp.get_device(name)
    except (RuntimeError, ValueError, TypeError, AttributeError) as error:
        raise ConfigError(f"device {name!r} is not there; this machine has {', '.join(known)}") from error


def free_gigabytes(device: wp.Device) -> float:
    """Memory of a device, or of the machine for the CPU, that is not in use [GB]."""
    return (device.free_memory if device.is_cuda else psutil.virtual_memory().available) / 1e9


def check_memory(device: wp.Device, size: float, what: str) -> None:
    """Whether a device has room for something, asked before it is allocated.

    Args:
        device: Where it will be.
        size: What it takes [bytes].
        what: Its name and what makes it smaller, for the message.

    Raises:
        MapSizeError: It has not.
    """
    if size < _TOO_SMALL_TO_ASK:
        return
    free = free_gigabytes(device)
    if free is not None and size / 1e9 > free:
        raise MapSizeError(f"{what}: {size / 1e9:.1f} GB are needed, and {device} has {free:.1f} GB free")


def peak_memory_mib() -> float:
    """The most memory that this process has held [MiB]."""
    # psutil knows the peak on Windows only, which is where the standard library does not.
    if sys.platform == "win32":
        return float(psutil.Process().memory_info().peak_wset) / 2**20
    import resource

    unit = 2**20 if sys.platform == "darwin" else 2**10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit
