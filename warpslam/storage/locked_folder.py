"""One writer a folder: a lock that ends with its process, and says who has it."""

from __future__ import annotations

import contextlib
import json
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path

from filelock import FileLock, Timeout

from warpslam.errors import ConfigError, OutputError

LOCK_FILE = ".lock"
OWNER_FILE = ".lock.json"


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Nobody else writes into a folder during the block.

    The system gives the lock back when its process ends, however that ends, so none is ever stale; who has it stands in
    a file beside it. Where a file system knows no such locks, `filelock` falls back to a file with host and process,
    which it takes over when that process is gone.

    Raises:
        ConfigError: Somebody else does.
        OutputError: The folder can't be written to.
    """
    lock = FileLock(folder / LOCK_FILE, timeout=0)
    try:
        lock.acquire()
    except Timeout:
        raise ConfigError(
            f"{folder}: another run is writing into it ({_owner(folder)}); wait for its end or choose another folder"
        ) from None
    except (OSError, NotImplementedError) as error:
        raise OutputError(f"{folder}: can't be locked ({error}); choose another folder") from error
    owner = folder / OWNER_FILE
    try:
        with contextlib.suppress(OSError):
            started = datetime.now().astimezone().isoformat(timespec="seconds")
            owner.write_text(json.dumps({"pid": os.getpid(), "host": socket.gethostname(), "since": started}))
        yield
    finally:
        with contextlib.suppress(OSError):
            owner.unlink(missing_ok=True)
            (folder / LOCK_FILE).unlink(missing_ok=True)  # who opened it meanwhile sees that it has no name any more
        lock.release()


def _owner(folder: Path) -> str:
    try:
        fields = json.loads((folder / OWNER_FILE).read_text())
        return f"process {int(fields['pid'])} on {str(fields['host'])[:100]!r} since {str(fields['since'])[:40]!r}"
    except (OSError, ValueError, KeyError, TypeError):
        return "it does not say which"
