"""Warp's kernel cache: where it is, and what is said when it can't be written."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from warpslam.errors import ConfigError

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
