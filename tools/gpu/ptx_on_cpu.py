"""Run the CUDA kernels without a GPU: the PTX that Warp's compiler makes, translated to C, one call a thread.

    python -m tools.gpu.ptx_on_cpu                                          translate every module, say what can't be
    PYTHONPATH=tools/gpu python -m pytest -p ptx_on_cpu tests/test_slam.py  the engine, every launch of ours from PTX
    PTX_ON_CPU=check,count,shuffle                                          what the plugin does besides: see below

PTX is what the driver would assemble for the GPU: after NVRTC's optimiser, with CUDA's launch geometry, thread indices,
shared, local and global addresses, and arguments packed as a launch packs them. So this shows what the CPU backend
can't: errors of code generation and of indexing for CUDA, reads and writes outside the arguments' arrays (`check`),
values that depend on the order of threads (`shuffle`), and how many instructions of each kind a launch executes
(`count`).

Threads of a block run one after the other. Kernels with shuffles or matrix instructions run a warp at a time. Kernels
that exchange values through shared memory and barriers can't be run, and are refused; see `ptx_translator`.

As a pytest plugin, or after `install`, every `wp.launch` and recorded launch of a module of ours goes this way, on
arrays of the CPU device, with the choices that the package makes for CUDA: its decoder kernels, one gradient buffer,
groups of 16 samples. It needs a C compiler (CC, cc or gcc).
"""

from __future__ import annotations

import collections
import ctypes
import hashlib
import math
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from tools.gpu.ptx_translator import Translator, UnsupportedInstruction

CACHE = Path(os.environ.get("PTX_ON_CPU_CACHE", Path(tempfile.gettempdir(), "ptx_on_cpu")))
ARCHITECTURE = int(os.environ.get("PTX_ON_CPU_ARCH", "90"))


def c_compiler() -> str | None:
    """Path of the C compiler, None where there is none."""
    return next(filter(None, map(shutil.which, (os.environ.get("CC", "cc"), "gcc"))), None)


class Range(ctypes.Structure):
    """Addresses that a launch may touch; as `range_t` of the translation."""

    _fields_ = [("low", ctypes.c_uint64), ("high", ctypes.c_uint64)]


class Context(ctypes.Structure):
    """What a thread is called with; as `context_t` of the translation."""

    _fields_ = [
        ("params", ctypes.c_void_p), ("tid", ctypes.c_uint32 * 3), ("ntid", ctypes.c_uint32 * 3),
        ("ctaid", ctypes.c_uint32 * 3), ("nctaid", ctypes.c_uint32 * 3), ("shared", ctypes.c_void_p),
        ("ranges", ctypes.POINTER(Range)), ("range_count", ctypes.c_int), ("last", ctypes.c_int),
        ("bad", ctypes.c_int64), ("bad_address", ctypes.c_uint64), ("counts", ctypes.c_void_p),
    ]  # fmt: skip


_RUNNER = r"""
/* Every thread of every block, the blocks in the order given by a stride, which is prime to their number. */
void run_all_threads(void (*kernel)(context_t*), context_t* c, uint64_t stride, uint32_t step) {
    uint64_t blocks = (uint64_t)c->nctaid[0] * c->nctaid[1] * c->nctaid[2];
    for (uint64_t n = 0; n < blocks; ++n) {
        uint64_t b = (n * stride) % blocks;
        c->ctaid[0] = b % c->nctaid[0]; c->ctaid[1] = b / c->nctaid[0] % c->nctaid[1];
        c->ctaid[2] = b / c->nctaid[0] / c->nctaid[1];
        for (uint32_t m = 0; m < c->ntid[0]; m += step) {
            c->tid[0] = stride == 1 ? m : c->ntid[0] - step - m;
            kernel(c);
        }
    }
}
"""


class Module:
    """A module of PTX, whose kernels are translated and compiled when they are first launched."""

    def __init__(self, ptx: str, *, check: bool, count: bool) -> None:
        self.translator = Translator(ptx)
        self.check, self.count = check, count
        self.functions = {function.name: function for function in self.translator.functions}
        self.counts: dict[str, Any] = {}
        self._libraries: dict[str, ctypes.CDLL] = {}

    def library(self, name: str) -> ctypes.CDLL:
        """The library of a kernel, from the cache if it was built before."""
        if name not in self._libraries:
            source = self.translator.source(name)
            count = "#define COUNT(n) ;c->counts[n]++;" if self.count else "#define COUNT(n) ;"
            source = f"{'#define CHECK 1' if self.check else ''}\n{count}\n{source}\n{_RUNNER}"
            CACHE.mkdir(parents=True, exist_ok=True)
            key = hashlib.sha256(source.encode()).hexdigest()[:16]
            library = CACHE / f"{key}.so"
            if not library.exists():
                (CACHE / f"{key}.c").write_text(source)
                # No contraction: fused operations are those that the PTX names.
                flags = "-fPIC -shared -ffp-contract=off -fno-strict-aliasing -mfma -w".split()
                # A function that loops over lanes in every statement takes minutes to optimise.
                flags.append("-O0" if self.functions[name].by_warp else "-O1")
                temporary = CACHE / f"{key}.{os.getpid()}.so"
                compiler = c_compiler()
                if compiler is None:
                    raise RuntimeError("no C compiler: name one by CC")
                subprocess.run([compiler, *flags, str(CACHE / f"{key}.c"), "-o", str(temporary), "-lm"], check=True)
                temporary.rename(library)
            self._libraries[name] = ctypes.CDLL(str(library))
        return self._libraries[name]

    def launch(
        self,
        name: str,
        params: list,
        dim: int,
        ranges: list[tuple[int, int]] | None,
        *,
        block: int = 256,
        shuffle: bool = False,
    ) -> None:
        """Run a kernel.

        Args:
            name: Entry point.
            params: ctypes objects, the launch bounds first.
            dim: Number of threads that have work.
            ranges: First and last address + 1 of each array, for a module that was built to check.
            block: Threads of a block; what the module was compiled for.
            shuffle: Blocks and threads in another order.

        Raises:
            IndexError: It touched memory outside ``ranges``.
            UnsupportedInstruction: Lanes of a warp that must act together had parted.
        """
        function, library = self.functions[name], self.library(name)
        pointers = (ctypes.c_void_p * len(params))(*(ctypes.addressof(p) for p in params))
        shared = (ctypes.c_uint8 * max(self.translator.shared_bytes, 16))()
        context = Context(params=ctypes.addressof(pointers), shared=ctypes.addressof(shared))
        blocks = max(-(-dim // block), 1)
        context.ntid[:] = [block, 1, 1]
        context.nctaid[:] = [blocks, 1, 1]
        if ranges:
            table = (Range * len(ranges))(*(Range(*r) for r in ranges))
            context.ranges, context.range_count = table, len(ranges)
        if self.count:
            if name not in self.counts:
                self.counts[name] = ((ctypes.c_uint64 * (len(function.blocks) + 1))(), [0, 0])
            context.counts = ctypes.addressof(self.counts[name][0])
            self.counts[name][1][0] += 1
            self.counts[name][1][1] += dim
        stride = 1
        if shuffle:
            stride = next(s for s in (7919, 104729, 13, 1) if math.gcd(s, blocks) == 1)
        entry = ctypes.cast(getattr(library, name), ctypes.c_void_p)
        runner = library.run_all_threads
        runner.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_uint64, ctypes.c_uint32]
        runner(entry, ctypes.addressof(context), stride, 32 if function.by_warp else 1)
        if context.bad_address == 2:
            raise UnsupportedInstruction(f"{name}: a shuffle or matrix instruction without all lanes")
        if context.bad:
            raise IndexError(f"{name}: {context.bad} accesses outside its arrays, the last at {context.bad_address:#x}")

    def executed(self, name: str) -> tuple[collections.Counter, int, int]:
        """Instructions executed by class, launches and threads so far."""
        counts, (launches, threads) = self.counts[name]
        total: collections.Counter = collections.Counter()
        for block, times in zip(self.functions[name].blocks, counts, strict=False):
            for kind, number in block.items():
                total[kind] += number * times
        return total, launches, threads


class Runner:
    """Replaces Warp's launches of our modules."""

    def __init__(self, *, check: bool = False, count: bool = False, shuffle: bool = False) -> None:
        self.check, self.count, self.shuffle = check, count, shuffle
        self.modules: dict[str, Module] = {}
        self.seconds: dict[str, float] = collections.defaultdict(float)

    def module(self, name: str) -> Module:
        """The translation of a Warp module, which is compiled to PTX at the first call."""
        if name not in self.modules:
            import warp as wp

            from warpslam.runtime.compilation import find_module

            module = wp.get_module(name)
            module = module if module.kernels else find_module(name)
            (path,) = wp.compile_aot_module(module, arch=[ARCHITECTURE], use_ptx=True)
            self.modules[name] = Module(Path(path).read_text(), check=self.check, count=self.count)
        return self.modules[name]

    def pack(
        self, kernel: Any, dim: Any, values: list, gradients: list | None
    ) -> tuple[Any, list, list[tuple[int, int]]]:
        """Arguments as a launch on CUDA packs them.

        Returns:
            Launch bounds, ctypes objects of all arguments, and the address ranges of their arrays.
        """
        import warp as wp
        from warp._src import context as wpc

        dim = tuple(dim) if isinstance(dim, tuple | list) else (int(dim),)
        self.module(kernel.module.name)
        bounds = wpc._build_launch_bounds_from_tuple(dim, kernel.adj.kernel_dim)
        device = wp.get_device("cpu")
        params: list = [bounds]
        ranges: list[tuple[int, int]] = []

        for argument, value in zip(kernel.adj.args, values, strict=True):
            params.append(_object(wpc.pack_arg(kernel, argument.type, argument.label, value, device, False)))
            ranges += _ranges(value)
        if gradients is not None:
            for argument, value in zip(kernel.adj.args, gradients, strict=True):
                given = value
                if given is None and not wp.types.is_array(argument.type):
                    given = 0
                params.append(_object(wpc.pack_arg(kernel, argument.type, argument.label, given, device, True)))
                ranges += _ranges(value)
        return bounds, params, ranges

    def launch(self, kernel: Any, bounds: Any, params: list, ranges: list, adjoint: bool) -> None:
        """Run a kernel, or its adjoint, with packed arguments."""
        suffix = "backward" if adjoint else "forward"
        module = self.module(kernel.module.name)
        start = time.perf_counter()
        name = f"{kernel.get_mangled_name()}_cuda_kernel_{suffix}"
        block = kernel.module.options["block_dim"]
        module.launch(name, params, bounds.size, ranges if self.check else None, block=block, shuffle=self.shuffle)
        self.seconds[kernel.key] += time.perf_counter() - start

    def table(self) -> str:
        """Instructions a thread and launch of every kernel."""
        lines = [
            "| kernel | launches | threads | a thread | " + " | ".join(_COLUMNS) + " |",
            "|---|" + "---:|" * (3 + len(_COLUMNS)),
        ]
        for module in self.modules.values():
            for name in module.counts:
                total, launches, threads = module.executed(name)
                short = re.sub(r"_[0-9a-f]{8}_cuda_kernel_forward$", "", name)
                short = short.replace("_cuda_kernel_backward", " (adjoint)")
                a_thread = [sum(total.values()), *(total[kind] for kind in _COLUMNS)]
                figures = [launches, threads // max(launches, 1), *(f"{n / max(threads, 1):.0f}" for n in a_thread)]
                lines.append(f"| {short} | {' | '.join(map(str, figures))} |")
        return "\n".join(lines)


_COLUMNS = (
    "mma", "fma.f32", "add/mul.f32", "f64", "special", "ld.global", "st.global", "atom.global", "ld.local", "st.local",
    "other", "branch",
)  # fmt: skip


def _ranges(value: Any) -> list[tuple[int, int]]:
    """First address and the one behind the last of an array and its gradient, or of all those in a struct."""
    import warp as wp

    if hasattr(value, "_cls"):
        return [found for name in value._cls.vars for found in _ranges(getattr(value, name))]
    if not isinstance(value, wp.array) or not value.ptr:
        return []
    stop = value.ptr + (value.capacity if value.is_contiguous else _extent(value))
    return [(value.ptr, stop), *_ranges(value.grad)]


def _extent(array: Any) -> int:
    """Bytes from the first to behind the last element of a view."""
    import warp as wp

    last = sum((n - 1) * s for n, s in zip(array.shape, array.strides, strict=True))
    return last + wp.types.type_size_in_bytes(array.dtype)


def _object(value: Any) -> Any:
    """Something with an address."""
    if isinstance(value, ctypes._SimpleCData | ctypes.Structure | ctypes.Array):
        return value
    raise TypeError(f"can't pass {value!r}")


class Command:
    """A recorded launch."""

    def __init__(self, runner: Runner, kernel: Any, dim: Any, values: list, gradients: list | None) -> None:
        import warp as wp

        self.runner, self.kernel, self.adjoint = runner, kernel, gradients is not None
        self.device = wp.get_device("cpu")
        self.bounds, self.params, self.ranges = runner.pack(kernel, dim, values, gradients)
        self.kept = values, gradients

    def launch(self, stream: Any = None) -> None:
        """Run it."""
        self.runner.launch(self.kernel, self.bounds, self.params, self.ranges, self.adjoint)


def install(**options: bool) -> Runner:
    """Send every launch of a ``warpslam`` module through PTX, with the package's choices for CUDA.

    Args:
        **options: Of `Runner`.
    """
    import warp as wp

    from warpslam.field import ray_batch
    from warpslam.runtime import cores, program

    runner, original = Runner(**options), wp.launch

    def launch(
        kernel: Any,
        dim: Any,
        inputs: Any = (),
        outputs: Any = (),
        adj_inputs: Any = (),
        adj_outputs: Any = (),
        **rest: Any,
    ) -> Command | None:
        if not kernel.module.name.startswith("warpslam.") or kernel.module.name in _NOT_OURS:
            return original(kernel, dim, inputs, outputs, adj_inputs, adj_outputs, **rest)
        values = [*inputs, *outputs]
        gradients = [*adj_inputs, *adj_outputs] if rest.get("adjoint") else None
        command = Command(runner, kernel, dim, values, gradients)
        if rest.get("record_cmd"):
            return command
        command.launch()
        return None

    def run_all(commands: list[Command]) -> None:
        for command in commands:
            command.launch()

    wp.launch = launch
    _replace(program._run_all, run_all)
    _replace(cores.slice_count, lambda device: 1)
    kernels_of = ray_batch.decoders_for
    _replace(kernels_of, lambda device, layout="dense": kernels_of(SimpleNamespace(is_cuda=True), layout))
    return runner


_NOT_OURS = ("warpslam.kernels.raycast",)
"""The renderer of synthetic rooms makes the input; it goes as ever."""


def _replace(function: Any, other: Any) -> None:
    """Put another function wherever a module of the package has imported this one."""
    places = [
        module
        for name, module in sys.modules.items()
        if name.startswith("warpslam.") and getattr(module, function.__name__, None) is function
    ]
    assert places, f"nothing in the package is called {function.__name__}"
    for module in places:
        setattr(module, function.__name__, other)


def pytest_configure(config: Any) -> None:
    """Install what PTX_ON_CPU names."""
    wanted = set(os.environ.get("PTX_ON_CPU", "check").split(","))
    config.ptx_runner = install(check="check" in wanted, count="count" in wanted, shuffle="shuffle" in wanted)


def pytest_terminal_summary(terminalreporter: Any, config: Any) -> None:
    """Say how much went through PTX."""
    runner = config.ptx_runner
    seconds = sum(runner.seconds.values())
    terminalreporter.write_line(f"kernels from PTX: {seconds:.1f} s in {len(runner.seconds)} kernels")
    if runner.count:
        terminalreporter.write_line(runner.table())


def main() -> int:
    """Translate every kernel of a run on CUDA; 1 if one can't be."""
    from warpslam.runtime.compilation import module_names

    runner, failures = Runner(), 0
    for name in module_names("cuda"):
        module = runner.module(name)
        for function in module.functions.values():
            if function.is_entry:
                try:
                    module.translator.source(function.name)
                except UnsupportedInstruction as error:
                    print(f"{function.name}: {error}")
                    failures += 1
        print(f"{name}: {sum(f.is_entry for f in module.functions.values())} kernels", flush=True)
    return int(failures > 0)


if __name__ == "__main__":
    sys.exit(main())
