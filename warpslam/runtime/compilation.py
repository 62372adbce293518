"""Compiling Warp modules before they are needed: into Warp's kernel cache, with a word on each while it happens.

A module is compiled when the cache holds no binary of its source for the device; from then on every run loads it in
milliseconds. Warp releases the GIL while it compiles, so on the CPU two modules compile side by side.
"""

from __future__ import annotations

import importlib
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import warp as wp

from warpslam.errors import ConfigError
from warpslam.runtime.cores import process_cores
from warpslam.runtime.kernel_cache import check_room

_STAGES = (
    "rays",
    "kernels.gauss_newton",
    "kernels.adam",
    "kernels.compositing",
    "kernels.by_sample",
    "kernels.losses",
    "kernels.grid",
    "views",
    "supervision",
    "direct",
    "timing",
    "features",
)
_PYTHON_MODULES = {
    "warpslam.rays": ("pixels", "rays", "rejection", "samples"),
    "warpslam.supervision": ("supervision", "touched_rows"),
    "warpslam.views": ("blocks", "frustum", "images", "rectify", "seen", "visibility"),
    "warpslam.direct": ("direct.images", "direct.points", "direct.registration"),
    "warpslam.timing": ("direct.timing",),
    "warpslam.features": ("features.matching", "features.pose", "features.agreement"),
    **{f"warpslam.decoder_{target}": ("decoder.build",) for target in ("cpu", "cuda")},
    **{f"warpslam.decoder_{target}_blocks": ("decoder.build",) for target in ("cpu", "cuda")},
    **{f"warpslam.imap_{target}": ("imap_network",) for target in ("cpu", "cuda")},
}
"""Warp modules that hold the kernels of other Python modules of `warpslam.kernels` than the one of their name."""

_WORKERS = 2
_BINARIES = {"cpu": (".o",), "cuda": (".ptx", ".cubin")}


@dataclass(frozen=True)
class ModuleProgress:
    """A module that is about to be loaded (``seconds`` None), or has been.

    name: Name of the Warp module.
    done, total: Modules finished, this one included once it is, and all that are asked for.
    compiled: Whether the kernel cache has no binary of it (beforehand), or had none (afterwards).
    seconds: Wall time it took [s].
    """

    name: str
    done: int
    total: int
    compiled: bool
    seconds: float | None = None


LAYOUTS = ("dense", "blocks")
"""How the rows of grids may be laid out, `grid.layout`; each has decoders of its own."""

Report = Callable[[ModuleProgress], None]


def module_names(target: str, layouts: Sequence[str] = LAYOUTS) -> list[str]:
    """Warp modules of runs on ``target`` "cpu" or "cuda" by the layout of their grids, those that take longest to
    compile first.
    """
    return [*(decoder_module(target, layout) for layout in layouts), *(f"warpslam.{stage}" for stage in _STAGES)]


def decoder_module(target: str, layout: str) -> str:
    """Warp module of the decoders for "cpu" or "cuda", and rows "dense" or in "blocks"; a run needs that of its layout
    alone.
    """
    return f"warpslam.decoder_{target}" + ("" if layout == "dense" else f"_{layout}")


def compile_kernels(
    device: wp.Device, report: Report | None = None, extra: Sequence[str] = (), layouts: Sequence[str] = LAYOUTS
) -> list[ModuleProgress]:
    """Load every module of a run for ``device``, compiling those that the kernel cache does not hold.

    Args:
        device: Device of the run.
        report: Called before and after each module; never by two threads at a time.
        extra: Names of more modules to load.
        layouts: Of grids: a run has one.

    Returns:
        One entry a module, as they were finished.
    """
    target = "cuda" if device.is_cuda else "cpu"

    def load(module: wp.Module) -> None:
        # Not Module.load, whose default is the block size of CUDA: a CPU launch would compile everything once more.
        wp.force_load(device, [module], max_workers=0)

    names = [*module_names(target, layouts), *extra]
    return _each(names, target, load, report, 1 if device.is_cuda else min(len(process_cores()), _WORKERS))


def compile_for_architecture(
    architecture: int, report: Report | None = None, extra: Sequence[str] = ()
) -> list[ModuleProgress]:
    """Compile every module of a run for a CUDA architecture into the kernel cache; needs no GPU and no driver.

    A run looks for PTX where the driver is as new as Warp's CUDA toolkit, and for a cubin where it is older: both are
    made.

    Args:
        architecture: Compute capability, such as 80.
        report: Called before and after each module.
        extra: Names of more modules to compile.

    Raises:
        ConfigError: This build of Warp can't compile for the architecture.
    """
    known = wp.get_cuda_supported_archs()
    if architecture not in known:
        names = ", ".join(f"sm_{a}" for a in known) or "no CUDA architecture at all"
        raise ConfigError(f"device sm_{architecture}: this build of Warp compiles for {names}")

    def build(module: wp.Module) -> None:
        for use_ptx in (True, False):
            wp.compile_aot_module(module, arch=[architecture], use_ptx=use_ptx)

    return _each([*module_names("cuda"), *extra], f"sm{architecture}", build, report, 1)


def _each(
    names: Sequence[str], target: str, build: Callable[[wp.Module], None], report: Report | None, workers: int
) -> list[ModuleProgress]:
    """Build the modules on ``workers`` threads; the first error ends it."""
    lock = threading.Lock()
    finished: list[ModuleProgress] = []

    def one(name: str) -> None:
        module = find_module(name)
        before = set(_binaries(module, target))
        with lock:
            if report is not None:
                report(ModuleProgress(name, len(finished), len(names), compiled=not before))
        if not before:
            check_room()
        start = time.perf_counter()
        build(module)
        seconds = time.perf_counter() - start
        with lock:
            new = set(_binaries(module, target)) - before
            finished.append(ModuleProgress(name, len(finished) + 1, len(names), bool(new), seconds))
            if report is not None:
                report(finished[-1])

    if workers == 1:
        for name in names:
            one(name)
    else:
        with ThreadPoolExecutor(workers, thread_name_prefix="warpslam-compile") as pool:
            for _ in pool.map(one, names):
                pass
    return finished


def find_module(name: str) -> wp.Module:
    """A Warp module by name, importing the Python modules that its kernels are in."""
    for part in _PYTHON_MODULES.get(name, ()) or (name,):
        importlib.import_module(f"warpslam.kernels.{part}" if name in _PYTHON_MODULES else part)
    return wp.get_module(name)


def _binaries(module: wp.Module, target: str) -> Iterator[Path]:
    """What the kernel cache holds of a module for "cpu", "cuda" (any architecture) or "sm80"."""
    # The block size is part of a module's identity, and that of a CPU launch is 1.
    folder = Path(wp.config.kernel_cache_dir) / module.get_module_identifier(block_dim=1 if target == "cpu" else None)
    suffixes = _BINARIES.get(target) or tuple(f".{target}{suffix}" for suffix in _BINARIES["cuda"])
    return (path for path in folder.glob("*") if path.name.endswith(suffixes))
