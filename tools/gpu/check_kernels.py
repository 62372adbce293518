"""Kernels of the smoke test, in a file of their own since Warp builds a module a Python module."""

# mypy: ignore-errors

import warp as wp

from warpslam.kernels.grid import Vec32


@wp.kernel
def scale(x: wp.array[float], factor: float, y: wp.array[float]):
    tid = wp.tid()
    y[tid] = factor * x[tid]


@wp.kernel(enable_backward=False)
def add_rows(rows: wp.array[Vec32]):
    tid = wp.tid()
    row = Vec32()
    for k in range(32):
        row[k] = 1.0
    wp.atomic_add(rows, tid % 4, row)


@wp.kernel
def total(y: wp.array[float], out: wp.array[float]):
    tid = wp.tid()
    wp.atomic_add(out, 0, y[tid])
