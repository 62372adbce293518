"""Launching Warp kernels: all CPU cores for the point kernels, and when kernels are compiled.

Warp runs a CPU kernel on the calling thread and releases the GIL meanwhile. Point kernels therefore run in equal
slices, one a
thread; those that add up gradients get a buffer (``slot``) for each slice, since atomics are not atomic on the CPU.
The number of
slices is fixed, so that sums are formed in the same order in every run.
"""

from __future__ import annotations

import os
import time
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

import warp as wp

from warpslam.kernels import adam, compositing, decoder, frustum, grid, losses, rays

MAX_SLICES = 8


def slice_count(device: wp.Device) -> int:
    """Slices of a point kernel, which is also the number of gradient buffers: the CPU's cores (at most 8), 1 on CUDA.
    """
    if device.is_cuda:
        return 1
    return max(
        1, min(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1, MAX_SLICES)
    )


@lru_cache(maxsize=1)
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max_workers=MAX_SLICES - 1, thread_name_prefix="warpslam")


def launch_points(kernel: wp.Kernel, count: int, inputs: list, device: wp.Device, *, with_slot: bool = False) -> None:
    """Launch ``kernel(start, [slot,] *inputs)`` over ``count`` points, cut in slices on the CPU."""
    slices = slice_count(device)
    bounds = [count * n // slices for n in range(slices + 1)]

    def run(n: int) -> None:
        start, stop = bounds[n], bounds[n + 1]
        if stop > start:
            head = [start, n] if with_slot else [start]
            wp.launch(kernel, dim=stop - start, inputs=head + inputs, device=device, record_tape=False)

    if slices == 1:
        run(0)
        return
    others = [_pool().submit(run, n) for n in range(1, slices)]
    run(0)
    for other in others:
        other.result()


def decoders_for(device: wp.Device):
    """The decoder kernels built for this kind of device."""
    return decoder.CUDA if device.is_cuda else decoder.CPU


def compile_kernels(device: wp.Device) -> float:
    """Load every kernel module for ``device``, compiling what the kernel cache does not hold; returns the seconds it
    took.
    """
    start = time.perf_counter()
    names = [module.__name__ for module in (adam, compositing, frustum, grid, losses, rays)]
    for name in [*names, f"warpslam.decoder_{'cuda' if device.is_cuda else 'cpu'}"]:
        wp.get_module(name).load(device)
    return time.perf_counter() - start


def synchronize(device: wp.Device) -> None:
    """Wait for the device, so that wall-clock times mean something (nothing to do on the CPU)."""
    if device.is_cuda:
        wp.synchronize_device(device)
