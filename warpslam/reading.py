"""Files of strangers, read so that none hangs the program or fills its memory: regular ones, of a bounded size."""

from __future__ import annotations

import errno
import os
import stat
import struct
import zipfile
import zlib
from functools import cache
from pathlib import Path
from typing import Any

MEGABYTE = 1 << 20
TEXT_LIMIT = 64 * MEGABYTE
YAML_LIMIT = MEGABYTE // 2
ARCHIVE_ERRORS: tuple[type[Exception], ...] = (
    ValueError, OSError, EOFError, KeyError, TypeError, AttributeError, SyntaxError, RuntimeError, OverflowError,
    MemoryError, zipfile.BadZipFile, zlib.error, struct.error,
)  # fmt: skip
"""What `numpy.load` and `zipfile` raise for archives that are damaged, or no archives."""
_KINDS = {
    stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket", stat.S_IFCHR: "a device", stat.S_IFBLK: "a device",
    stat.S_IFDIR: "a folder",
}  # fmt: skip


def check_name(path: Path) -> None:
    """Refuse what can't be the path of a file, which the system's functions tell by a `ValueError`.

    Raises:
        OSError: It is empty, ends in no name, holds a zero, or can't be written in the system's letters.
    """
    try:
        if path.name and b"\0" not in os.fsencode(path):
            return
    except UnicodeEncodeError:
        pass
    raise OSError(errno.EINVAL, "is no name of a file", str(path))


def check_regular(path: str | Path, limit: float = float("inf"), *, may_be_empty: bool = False) -> int:
    """Size of a file [bytes], which is a regular one: others may never end, or never begin.

    So do some that Linux shows as regular, in /proc; these are empty.

    Raises:
        OSError: There is none, it is something else, larger than ``limit``, or empty and must not be.
    """
    try:
        found = os.stat(path)
    except ValueError as error:  # a zero in its name
        raise OSError(errno.EINVAL, str(error), str(path)) from None
    if not stat.S_ISREG(found.st_mode):
        kind = _KINDS.get(stat.S_IFMT(found.st_mode), "no file")
        raise OSError(errno.EINVAL, f"is {kind}, expected a regular file", str(path))
    if found.st_size > limit:
        text = f"has {found.st_size / MEGABYTE:.1f} MB, expected at most {limit / MEGABYTE:g}"
        raise OSError(errno.EFBIG, text, str(path))
    if found.st_size == 0 and not may_be_empty:
        raise OSError(errno.EINVAL, "is empty", str(path))
    return found.st_size


def read_bytes(path: str | Path, limit: float) -> bytes:
    """Content of a regular file.

    Raises:
        OSError: As `check_regular`, or it can't be read.
    """
    check_regular(path, limit, may_be_empty=True)
    # Something else may have come into its place; opened so, a pipe does not wait for its other end.
    descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    with os.fdopen(descriptor, "rb") as file:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise OSError(errno.EINVAL, "is no regular file", str(path))
        try:
            data = file.read(int(min(limit, 1 << 62)) + 1)
        except MemoryError:
            raise OSError(errno.ENOMEM, "does not fit into memory", str(path)) from None
    if data is None:  # a file of the system's that waits for what is to come
        raise OSError(errno.EAGAIN, "has nothing to be read", str(path))
    if len(data) > limit:
        raise OSError(errno.EFBIG, f"has more than {limit / MEGABYTE:g} MB", str(path))
    return data


def read_text(path: str | Path, limit: float = TEXT_LIMIT, encoding: str = "utf-8") -> str:
    """Content of a regular file of text, with line feeds.

    Raises:
        OSError: As `read_bytes`, or it is no text.
    """
    try:
        text = read_bytes(path, limit).decode(encoding)
    except UnicodeDecodeError as error:
        where = f"byte {error.object[error.start]:#04x} at {error.start}"
        raise OSError(errno.EILSEQ, f"is no text in {error.encoding.upper()} ({where})", str(path)) from None
    return text.replace("\r\n", "\n").replace("\r", "\n")


@cache
def _plain_loader() -> Any:
    """Without aliases, by which a kilobyte unfolds into gigabytes."""
    import yaml  # who only lists readers need not wait for it

    class PlainLoader(yaml.SafeLoader):
        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.check_event(yaml.AliasEvent):
                event = self.peek_event()
                raise yaml.YAMLError(f"an alias (*{event.anchor[:50]}), which is not supported: write the value out")
            return super().compose_node(parent, index)

    return PlainLoader


def load_yaml(text: str | bytes) -> Any:
    """What yaml holds, in plain Python values.

    Raises:
        ValueError: It is no yaml, too long, or has aliases or values that can't be.
    """
    import yaml

    if len(text) > YAML_LIMIT:
        raise ValueError(f"{len(text) / MEGABYTE:.1f} MB are no settings, expected at most {YAML_LIMIT / MEGABYTE:g}")
    try:
        return yaml.load(text, _plain_loader())  # noqa: S506 (a SafeLoader)
    except ValueError:
        raise
    except RecursionError:
        raise ValueError("nested too deeply") from None
    # Its constructors of dates, numbers and booleans let all kinds of errors through.
    except (yaml.YAMLError, AttributeError, KeyError, TypeError, OverflowError, IndexError) as error:
        raise ValueError(" ".join(str(error).split()) or type(error).__name__) from error
