"""Disks that are full and folders that can't be written to: what is said, and what goes on in spite of them."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from warpslam.errors import printable

log = logging.getLogger(__name__)


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


class OneRecord(logging.Formatter):
    """Control characters are escaped, and lines after the first are set in: no name of a file can forge a record."""

    def format(self, record: logging.LogRecord) -> str:
        """As `logging` has it."""
        return printable(super().format(record)).replace("\n", "\n    ")


@contextmanager
def log_file(path: Path, *, append: bool = False) -> Iterator[None]:
    """Send everything that warpslam logs, from INFO up, to a file as well."""
    logger = logging.getLogger("warpslam")
    handler = LogFile(path, logger, append=append)
    handler.setFormatter(OneRecord("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    level = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.setLevel(level)
        logger.removeHandler(handler)
        handler.close()
