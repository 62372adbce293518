"""Warp's kernel cache: where it is, and what is said when it can't be written."""

from __future__ import annotations

import logging
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from warpslam.errors import ConfigError

_MODULE_BYTES = 32_000_000
log = logging.getLogger(__name__)


@contextmanager
def kernel_cache_errors() -> Iterator[None]:
    """Turn what goes wrong with Warp's kernel cache into `ConfigError`; other errors pass."""
    try:
        yield
    except Exception as error:
        reason = _cache_fault(error)
        if reason is None:
            raise
        raise ConfigError(
            f"kernel cache {kernel_cache()} can't be written ({reason}), and it does not hold all kernels yet; "
            "set WARP_CACHE_PATH to a folder that can be written to"
        ) from error


def check_room() -> None:
    """Whether a module that is about to be compiled fits into the cache: on a full disk the compiler ends the process.

    Raises:
        ConfigError: It does not.
    """
    folder = kernel_cache()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        free = shutil.disk_usage(folder).free
    except OSError:
        return  # said by what needs it
    if free < _MODULE_BYTES:
        raise ConfigError(
            f"kernel cache {folder} has {free / 1e6:.1f} MB left, and a module of kernels takes up to "
            f"{_MODULE_BYTES / 1e6:.0f} MB: free some space, or set WARP_CACHE_PATH to a folder that has it"
        )


def kernel_cache() -> Path:
    """Where Warp keeps compiled kernels, known or, before Warp is initialised, as far as the environment tells."""
    import warp as wp

    return Path(wp.config.kernel_cache_dir or os.environ.get("WARP_CACHE_PATH") or "~/.cache/warp").expanduser()


def _cache_fault(error: Exception) -> str | None:
    """Why the cache can't be written, if that is what ``error`` is about."""
    folder = kernel_cache()
    if isinstance(error, OSError):
        named = error.filename is None or str(error.filename).startswith(str(folder))
        return (error.strerror or str(error)) if named else None
    # The compiler itself writes files too, and only says that it failed.
    probe = folder / f"warpslam_{os.getpid()}.probe"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe.write_bytes(bytes(1 << 20))
    except OSError as fault:
        return fault.strerror or str(fault)
    finally:
        try:
            probe.unlink(missing_ok=True)
        except OSError as fault:
            log.debug("%s: %s", probe, fault)
    return None
