"""Warp without its lines about devices and modules, nor about a CUDA driver on a machine that has none."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from functools import cache

import warp as wp


@cache
def start_warp() -> None:
    """Start Warp, once a process, with warnings alone; another `warp.config.log_level` than Warp's own stays."""
    if wp.config.log_level == wp.LOG_INFO:
        wp.config.log_level = wp.LOG_WARNING
    with nullcontext() if _has_driver() else _without_standard_error():
        wp.init()


def _has_driver() -> bool:
    try:
        ctypes.CDLL("libcuda.so.1")
    except OSError:
        return False
    return True


@contextmanager
def _without_standard_error() -> Iterator[None]:
    """That there is no driver is said by the library itself, past Python's `sys.stderr`."""
    sys.stderr.flush()
    kept = os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)
