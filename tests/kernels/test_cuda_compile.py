"""Every Warp module compiles for CUDA, also where there is no GPU and no driver, and what its kernels take is known."""

from __future__ import annotations

import importlib
import itertools
import re
import shutil
import subprocess
from pathlib import Path

import pytest
import warp as wp

import warpslam
from tools.benchmarks.cuda_registers import REGISTER_LIMIT, KernelResources, compiled_cubin, markdown_table, read_cubin
from warpslam.runtime.compilation import decoder_module, find_module, module_names

ARCHITECTURES = (80, 90)
# Bytes that may be spilled, and why they are.
SPILLING = {
    "color_backward": (16, "holds the gradients of two layers for the weights of the embedding"),
    "fine_forward": (52, "on sm_80 alone, where 16 bytes of weights at a time lie beside the values of two levels"),
    "warpslam.decoder_cuda_blocks fine_forward": (228, "the same beside the tables of blocks"),
    "register": (1540, "holds a whole registration between two evaluations of its equations"),
    "register_jointly": (2580, "the same, for four keyframes"),
    "layer_weights": (1200, "of the baseline: sums eight rows of 32 at once"),
}
BUILT = ("warpslam.decoder_cuda", "warpslam.decoder_cuda_blocks", "warpslam.imap_cuda")
"""Warp modules whose kernels a function builds."""


def kernel_modules() -> list[str]:
    """Names of the Warp modules that hold kernels, those that a function builds included."""
    root = Path(warpslam.__file__).parent
    names = []
    for path in sorted(root.rglob("*.py")):
        if re.search(r"^@wp\.kernel", path.read_text(), re.MULTILINE):
            python = importlib.import_module(".".join(("warpslam", *path.relative_to(root).with_suffix("").parts)))
            names += [kernel.module.name for kernel in vars(python).values() if isinstance(kernel, wp.Kernel)]
    return [*dict.fromkeys(names), *BUILT]


def test_every_kernel_module_is_found():
    """The list of modules holds the known ones, so that the test below can't pass by looking at nothing."""
    assert {f"warpslam.{name}" for name in ("rays", "views", "kernels.compositing", "kernels.adam")} <= set(
        kernel_modules()
    )


def test_a_run_compiles_every_module_beforehand():
    """What is loaded when a run starts is all there is, but for the renderer of synthetic rooms and the baseline."""
    others = {"warpslam.kernels.raycast", "warpslam.imap_cuda", "warpslam.kernels.imap_density"}
    for target, layout in itertools.product(("cpu", "cuda"), ("dense", "blocks")):
        expected = {name.replace("decoder_cuda", f"decoder_{target}") for name in kernel_modules()}
        unused = decoder_module(target, "blocks" if layout == "dense" else "dense")
        assert set(module_names(target, [layout])) == expected - others - {unused}


def cases() -> list:
    """Each module on each architecture."""
    return [pytest.param(name, a, id=f"{name}-sm{a}") for name in kernel_modules() for a in ARCHITECTURES]


def resources(name: str, architecture: int) -> dict[str, KernelResources]:
    """Resources of a module's kernels by entry point."""
    if architecture not in wp.get_cuda_supported_archs():
        pytest.skip(f"this build of Warp can't compile for sm_{architecture}")
    return {kernel.name: kernel for kernel in read_cubin(compiled_cubin(name, architecture))}


@pytest.mark.parametrize(("name", "architecture"), cases())
def test_module_compiles(name, architecture):
    """The cubin of a module holds machine code for each of its kernels."""
    found = resources(name, architecture)
    kernels = find_module(name).kernels
    assert kernels
    for kernel in kernels.values():
        entry = found[f"{kernel.get_mangled_name()}_cuda_kernel_forward"]
        assert entry.kernel == kernel.key
        assert 0 < entry.registers <= REGISTER_LIMIT and entry.code > 0


@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_no_kernel_spills_but_the_known_ones(architecture):
    """Registers go to local memory only in kernels that are listed with a reason, and no more than they did."""
    for name in kernel_modules():
        for kernel in resources(name, architecture).values():
            allowed, _ = SPILLING.get(f"{name} {kernel.kernel}") or SPILLING.get(kernel.kernel, (0, ""))
            spilled = kernel.spill_stores + kernel.spill_loads
            assert spilled <= allowed, f"{kernel.kernel} on sm_{architecture} spills {spilled} bytes"


@pytest.fixture(scope="module")
def tight() -> Path:
    """Cubin of a kernel that needs more registers than it may have, and of one that needs few."""
    module = "tests.tight_registers"

    def many(x: wp.array[wp.types.vector(64, float)]):
        a = x[0]
        b = x[1]
        for n in range(100):
            a = wp.cw_mul(a, b) + x[n]
            b = wp.cw_mul(b, a) - x[n]
        x[0] = a + b

    def few(x: wp.array[float]):
        x[0] = 1.0

    wp.get_module(module).options["enable_backward"] = False
    for function in (many, few):
        wp.kernel(function, module=module, name=function.__name__, cuda_max_registers=64)
    (path,) = wp.compile_aot_module(module, arch=[80], use_ptx=False)
    return path


def test_spills_are_seen(tight):
    """A kernel of 128 numbers in 64 registers spills; one that stores a number does not."""
    few, many = read_cubin(tight)
    assert (few.kernel, many.kernel) == ("few", "many")
    assert many.spills and many.frame >= many.spill_stores / 4 and 32 < many.registers <= 64
    assert not few.spills and few.frame == 0 and few.registers < 32


def test_figures_are_those_of_ptxas(tight, tmp_path):
    """Registers, stack and spills agree with what NVIDIA's assembler reports about the same PTX, where it is there."""
    if shutil.which("ptxas") is None:
        pytest.skip("no ptxas on this machine")
    (path,) = wp.compile_aot_module("tests.tight_registers", arch=[80], use_ptx=True)
    # Warp's compiler may be newer than ptxas, whose PTX version it then refuses; it also ends the file with a NUL.
    text = re.sub(r"^\.version [\d.]+", ".version 9.0", path.read_text().replace("\0", ""), flags=re.MULTILINE)
    (tmp_path / "kernels.ptx").write_text(text)
    cubin = tmp_path / "kernels.cubin"
    command = ["ptxas", "-v", "-arch=sm_80", str(tmp_path / "kernels.ptx"), "-o", str(cubin)]
    report = subprocess.run(command, capture_output=True, text=True)
    if report.returncode:
        pytest.skip(f"this ptxas can't read the PTX: {report.stderr.splitlines()[0]}")
    pattern = (
        r"entry function '(\w+)'.*?(\d+) bytes stack frame, (\d+) bytes spill stores, (\d+) bytes spill loads"
        r".*?Used (\d+) registers"
    )
    expected = {name: tuple(map(int, rest)) for name, *rest in re.findall(pattern, report.stderr, re.DOTALL)}
    found = {k.name: (k.frame, k.spill_stores, k.spill_loads, k.registers) for k in read_cubin(cubin)}
    assert found == expected and len(found) == 2


def test_table_and_damaged_files(tight, tmp_path):
    """The tool's table has a row a kernel; what is no cubin is refused by name."""
    table = markdown_table({80: {"warpslam.tight": read_cubin(tight)}})
    assert len(table.splitlines()) == 4 and "| tight | many | sm_80 |" in table
    (tmp_path / "text.cubin").write_text("no cubin")
    with pytest.raises(ValueError, match="text.cubin"):
        read_cubin(tmp_path / "text.cubin")
