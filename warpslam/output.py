"""Disks that are full and folders that can't be written to: what is said, and what goes on in spite of them."""

from __future__ import annotations

import errno
import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from warpslam.errors import ConfigError, OutputError

log = logging.getLogger(__name__)


def output_error(error: OSError, folder: Path) -> OutputError:
    """What to tell the user about a result that can't be written into the folder of a run."""
    remedy = "free some space" if error.errno in (errno.ENOSPC, errno.EDQUOT) else "check the folder"
    where = error.filename or folder
    return OutputError(f"{where}: can't be written ({error.strerror or error}); {remedy} or choose another one with -o")


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


class LogFile(logging.FileHandler):
    """Log file of a run. When it can't be written any more the run goes on without it, and says so once."""

    def __init__(self, path: Path, logger: logging.Logger, *, append: bool = False) -> None:
        super().__init__(path, mode="a" if append else "w", encoding="utf-8")
        self._logger = logger
        self._is_broken = False

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802 (the name is logging's)
        """Called by `logging` when a line can't be written."""
        if not self._is_broken:
            self._is_broken = True
            self._logger.removeHandler(self)
            log.warning("%s can't be written any more; the run goes on without it", self.baseFilename)

    def close(self) -> None:
        """Close the file; what is still in its buffer may not fit on the disk."""
        try:
            super().close()
        except OSError as error:
            log.warning("%s: the last lines can't be written (%s)", self.baseFilename, error.strerror)


@contextmanager
def log_file(path: Path, *, append: bool = False) -> Iterator[None]:
    """Send everything that warpslam logs, from INFO up, to a file as well."""
    logger = logging.getLogger("warpslam")
    handler = LogFile(path, logger, append=append)
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    level = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.setLevel(level)
        logger.removeHandler(handler)
        handler.close()
