"""Registers, local memory and spills of every CUDA kernel, read from the machine code; needs no GPU and no ptxas.

    python -m tools.benchmarks.cuda_registers --arch 80 90

Warp's own compiler (NVRTC) makes the cubin that a GPU would run. A cubin is an ELF file: `.nv.info` holds the number of
registers and the size of the stack frame of each kernel, and `.nv.info.<kernel>` the offset of every instruction that
spills or refills a register. The sum of what these move is what ``ptxas -v`` prints, but for kernels that call
subroutines (division, say), where registers saved around a call count here and not there.
"""

from __future__ import annotations

import argparse
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import warp as wp

from warpslam.cli.common import quiet_warp
from warpslam.runtime.compilation import find_module, module_names

_SECTION = struct.Struct("<IIQQQQIIQQ")
_SYMBOL = struct.Struct("<IBBHQQ")
_INSTRUCTION_BYTES = 16
_STORE_LOCAL, _LOAD_LOCAL = 0x387, 0x983
_FRAME_SIZE, _REGISTER_COUNT, _ANNOTATIONS = 0x11, 0x2F, 0x55
_SPILL = 1
_SIZED_VALUE = 4
_ENTRY_SUFFIX = "_cuda_kernel_forward"
REGISTER_LIMIT = 255


@dataclass(frozen=True)
class KernelResources:
    """What a thread of a kernel takes."""

    name: str
    """Entry point in the cubin."""
    registers: int
    """32-bit registers, at most 255."""
    frame: int
    """Local memory [bytes]: arrays that are indexed at run time, and spilled registers."""
    spill_stores: int
    """Bytes of the instructions that spill registers, each counted once."""
    spill_loads: int
    """Bytes of those that refill them."""
    code: int
    """Size of the machine code [bytes]."""

    @property
    def spills(self) -> bool:
        """Whether any register is spilled."""
        return self.spill_stores + self.spill_loads > 0

    @property
    def kernel(self) -> str:
        """Name of the kernel in the source; " (adjoint)" for a generated one."""
        adjoint = self.name.endswith("_cuda_kernel_backward")
        mangled = self.name.removesuffix("_cuda_kernel_backward").removesuffix(_ENTRY_SUFFIX)
        return mangled.rpartition("_")[0] + (" (adjoint)" if adjoint else "")


@dataclass(frozen=True)
class _Section:
    name: str
    data: bytes


def read_cubin(path: Path) -> list[KernelResources]:
    """Resources of every kernel in a cubin, by name.

    Raises:
        ValueError: The file is no 64-bit cubin.
    """
    sections = _sections(path)
    by_name = {section.name: section for section in sections}
    symbols = _symbol_names(by_name)
    # Value of an attribute by its number and the name of the kernel.
    values: dict[tuple[int, str], int] = {}
    for attribute, data in _attributes(by_name[".nv.info"].data):
        if attribute in (_FRAME_SIZE, _REGISTER_COUNT):
            symbol, value = struct.unpack("<II", data)
            values[attribute, symbols[symbol]] = value
    kernels = []
    for section in sections:
        if section.name.startswith(".text."):
            name = section.name.removeprefix(".text.")
            stores, loads = _spills(section.data, by_name[f".nv.info.{name}"].data)
            registers, frame = values[_REGISTER_COUNT, name], values.get((_FRAME_SIZE, name), 0)
            kernels.append(KernelResources(name, registers, frame, stores, loads, len(section.data)))
    return sorted(kernels, key=lambda kernel: kernel.name)


def _sections(path: Path) -> list[_Section]:
    data = path.read_bytes()
    if data[:5] != b"\x7fELF\x02":
        raise ValueError(f"{path}: no 64-bit ELF file")
    (table,) = struct.unpack_from("<Q", data, 0x28)
    entry_size, count, names = struct.unpack_from("<HHH", data, 0x3A)
    headers = [_SECTION.unpack_from(data, table + n * entry_size) for n in range(count)]
    start = headers[names][4]
    return [_Section(_text(data, start + h[0]), data[h[4] : h[4] + h[5]]) for h in headers]


def _text(data: bytes, start: int) -> str:
    return data[start : data.index(b"\0", start)].decode()


def _symbol_names(sections: dict[str, _Section]) -> list[str]:
    text = sections[".strtab"].data
    return [_text(text, symbol[0]) for symbol in _SYMBOL.iter_unpack(sections[".symtab"].data)]


def _attributes(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Number and value of each attribute; those without a value of their own size are passed over."""
    position = 0
    while position < len(data):
        form, attribute, size = struct.unpack_from("<BBH", data, position)
        position += 4
        if form == _SIZED_VALUE:
            yield attribute, data[position : position + size]
            position += size


def _spills(code: bytes, info: bytes) -> tuple[int, int]:
    """Bytes stored and loaded by the instructions that are marked as spills."""
    moved = {_STORE_LOCAL: 0, _LOAD_LOCAL: 0}
    for attribute, data in _attributes(info):
        if attribute != _ANNOTATIONS:
            continue
        for kind, offset in struct.iter_unpack("<II", data):
            low, high = struct.unpack_from("<QQ", code, offset)
            if kind == _SPILL and low & 0xFFF in moved:
                # Bits 73 to 75 of a memory instruction: 4 is 32 bits, 5 is 64, 6 is 128.
                moved[low & 0xFFF] += 1 << ((high >> 9 & 7) - 2)
    return moved[_STORE_LOCAL], moved[_LOAD_LOCAL]


def compiled_cubin(name: str, architecture: int) -> Path:
    """Cubin of a Warp module, from the kernel cache if the same source was compiled before."""
    (path,) = wp.compile_aot_module(find_module(name), arch=[architecture], use_ptx=False)
    return path


def markdown_table(kernels: dict[int, dict[str, list[KernelResources]]]) -> str:
    """A row a kernel, from resources by architecture and module."""
    lines = [
        "| module | kernel | arch | registers | local memory (B) | spill stores / loads (B) | code (KiB) |",
        "|---|---|---:|---:|---:|---:|---:|",
    ]
    for architecture, modules in kernels.items():
        for module, rows in modules.items():
            lines += [
                f"| {module.removeprefix('warpslam.')} | {row.kernel} | sm_{architecture} | {row.registers} "
                f"| {row.frame} | {row.spill_stores} / {row.spill_loads} | {row.code / 1024:.1f} |"
                for row in rows
            ]
    return "\n".join(lines)


def main() -> None:
    quiet_warp()
    parser = argparse.ArgumentParser(description="Registers and spills of every CUDA kernel, as a Markdown table.")
    parser.add_argument("--arch", type=int, nargs="+", default=[80, 90], help="compute capabilities (80 90)")
    parser.add_argument("--module", action="append", help="only this Warp module; may be repeated")
    options = parser.parse_args()
    names = options.module or module_names("cuda")
    print(markdown_table({a: {name: read_cubin(compiled_cubin(name, a)) for name in names} for a in options.arch}))


if __name__ == "__main__":
    main()
