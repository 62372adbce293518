"""Every Warp module compiles for CUDA, also where there is no GPU and no driver."""

from __future__ import annotations

import importlib
import os
import re
from pathlib import Path

import pytest
import warp as wp

import warpslam

ARCHITECTURES = (80, 90)
BUILT = {"warpslam.decoder_cuda": "warpslam.kernels.decoder", "warpslam.imap_cuda": "warpslam.kernels.imap"}
"""Warp modules that a function builds, and the Python modules that call it."""


def kernel_modules() -> list[str]:
    """Names of the Warp modules that hold kernels, those that a function builds included."""
    root = Path(warpslam.__file__).parent
    names = [
        ".".join(("warpslam", *path.relative_to(root).with_suffix("").parts))
        for path in sorted(root.rglob("*.py"))
        if re.search(r"^@wp\.kernel", path.read_text(), re.MULTILINE)
    ]
    return [*names, *BUILT]


def ptx_of(name: str, architecture: int, folder: Path) -> str:
    """PTX of a Warp module, from the kernel cache if the same source was compiled before."""
    module = wp.get_module(name)
    cached = Path(wp.config.kernel_cache_dir) / "ptx" / f"{name}_{module.get_module_hash().hex()}.sm{architecture}.ptx"
    if not cached.exists():
        wp.compile_aot_module(name, arch=[architecture], module_dir=folder, use_ptx=True)
        (made,) = folder.glob("*.ptx")
        cached.parent.mkdir(exist_ok=True)
        made.rename(folder / cached.name)
        # The cache may lie on another disk: copy beside it first, so that no one sees half a file.
        partial = cached.with_suffix(f".{os.getpid()}")
        partial.write_bytes((folder / cached.name).read_bytes())
        partial.replace(cached)
    return cached.read_text()


def test_every_kernel_module_is_found():
    """The list of modules holds the known ones, so that the test below can't pass by looking at nothing."""
    assert {f"warpslam.kernels.{stage}" for stage in ("rays", "compositing", "losses", "adam")} <= set(kernel_modules())


def cases() -> list:
    """Each module on each architecture."""
    return [pytest.param(name, a, id=f"{name}-sm{a}") for name in kernel_modules() for a in ARCHITECTURES]


@pytest.mark.parametrize(("name", "architecture"), cases())
def test_module_compiles(name, architecture, tmp_path):
    """The PTX of a module targets the architecture and holds an entry for each of its kernels."""
    if architecture not in wp.get_cuda_supported_archs():
        pytest.skip(f"this build of Warp can't compile for sm_{architecture}")
    importlib.import_module(BUILT.get(name, name))
    kernels = wp.get_module(name).kernels
    assert kernels
    ptx = ptx_of(name, architecture, tmp_path)
    assert f".target sm_{architecture}" in ptx
    entries = set(re.findall(r"\.entry (\w+)", ptx))
    for kernel in kernels.values():
        assert f"{kernel.get_mangled_name()}_cuda_kernel_forward" in entries, kernel.key
