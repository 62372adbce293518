"""What is said when a result can't be written."""

from __future__ import annotations

import errno
from pathlib import Path

from warpslam.errors import OutputError


def output_error(error: OSError, folder: Path) -> OutputError:
    """What to tell the user about a result that can't be written into the folder of a run."""
    remedy = "free some space" if error.errno in (errno.ENOSPC, errno.EDQUOT) else "check the folder"
    where = error.filename or folder
    return OutputError(f"{where}: can't be written ({error.strerror or error}); {remedy} or choose another one with -o")
