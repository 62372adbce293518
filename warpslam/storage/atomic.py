"""Files that are there whole or not at all."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from warpslam.reading import check_name

PARTIAL = ".part"
"""Ending of a file that is being written."""


@contextmanager
def replacing(path: Path, *, durable: bool = False) -> Iterator[Path]:
    """A path beside ``path`` to write to; what is written there takes the place of ``path`` when the block ends.

    If the block raises, ``path`` is as it was, and nothing is left beside it.

    Args:
        path: File to write.
        durable: The new content is on the disk before it has its name, so that even a power cut leaves the old file or
            the new one.

    Raises:
        OSError: ``path`` can't be the path of a file.
    """
    check_name(path)
    partial = path.with_name(path.name + PARTIAL)
    try:
        yield partial
        if durable:
            sync_file(partial)
        partial.replace(path)
        if durable:
            sync_folder(path.parent)
    except BaseException:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
        raise


def sync_file(path: Path) -> None:
    """Wait until the content of a file is on the disk."""
    with open(path, "rb+") as file:
        os.fsync(file.fileno())


def sync_folder(folder: Path) -> None:
    """Make renames in a folder survive a power cut, where the system can."""
    if not hasattr(os, "O_DIRECTORY"):  # Windows has no such call, and needs none
        return
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
