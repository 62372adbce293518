"""``warpslam warmup``."""

from __future__ import annotations

import argparse
import re
import time
from typing import Any

import warp as wp

from warpslam.cli.common import add_command, quiet_warp
from warpslam.pipeline.setup import check_device
from warpslam.runtime.compilation import ModuleProgress, compile_for_architecture, compile_kernels
from warpslam.synthetic import RenderedSequence

_EXPLANATION = """
For cpu, cuda or cuda:N the kernels are compiled and loaded here, exactly as the first run would do it; runs on this
machine then start at once.

For an architecture such as sm_80 neither a GPU nor a driver is needed. PTX and cubin go into Warp's kernel cache, which
is where a run on such a GPU looks first. That helps where the run sees the same cache (WARP_CACHE_PATH, in an image or
on a shared disk), with the same versions of warpslam and Warp and all GPUs of the machine of that architecture;
otherwise the run compiles again, correctly, only later. The driver still turns PTX into machine code at the first
load, and nothing is executed here, so this proves that the kernels compile, not that they run.
"""


def add(commands: Any) -> None:
    """Add the command."""
    warmup = add_command(commands, "warmup", _warmup, "compile all kernels ahead of the first run")
    warmup.formatter_class = argparse.RawDescriptionHelpFormatter
    warmup.epilog = f"{_EXPLANATION.strip()}\n\n{warmup.epilog}"
    warmup.add_argument("--device", help="cpu, cuda, cuda:1, or an architecture: sm_80, ... (default: a GPU, or cpu)")


def _warmup(options: argparse.Namespace) -> int:
    quiet_warp()
    start = time.perf_counter()
    extra = RenderedSequence.warp_modules
    architecture = re.fullmatch(r"sm_?(\d+)", options.device or "")
    if architecture:
        modules = compile_for_architecture(int(architecture[1]), _print, extra)
    else:
        check_device(options.device)
        modules = compile_kernels(wp.get_device(options.device), _print, extra)
    compiled = sum(module.compiled for module in modules)
    print(f"{compiled} of {len(modules)} modules compiled in {time.perf_counter() - start:.1f} s")
    print(f"kernel cache {wp.config.kernel_cache_dir}")
    return 0


def _print(module: ModuleProgress) -> None:
    if module.seconds is not None:
        what = "compiled" if module.compiled else "cached"
        print(f"{module.done:2}/{module.total}  {module.name:32} {what:8} {module.seconds:7.2f} s", flush=True)
