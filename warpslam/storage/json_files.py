"""JSON files, written whole or not at all."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from warpslam.errors import DatasetError, brief
from warpslam.reading import MEGABYTE, read_text
from warpslam.storage.atomic import replacing

_LIMIT = 1024 * MEGABYTE  # that of a run of a million frames


def write_json(path: Path, value: Any) -> None:
    """Write `to_json` of a value; the file is replaced only once all is written."""
    with replacing(path) as partial:
        partial.write_text(to_json(value) + "\n", encoding="utf-8")


def to_json(value: Any) -> str:
    """JSON text that every parser reads: NaN and infinity become null, arrays become lists."""
    return json.dumps(_plain(value), indent=2, allow_nan=False)


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object.

    Raises:
        DatasetError: The file can't be read or holds something else.
    """
    try:
        value = json.loads(read_text(path, _LIMIT))
    except (OSError, ValueError, RecursionError) as error:
        raise DatasetError(f"{path}: can't be read as JSON ({brief(error)}); run again to write it anew") from error
    if not isinstance(value, dict):
        raise DatasetError(f"{path}: expected a JSON object, found {type(value).__name__}")
    return value


def _plain(value: Any) -> Any:
    """``value`` with NumPy numbers and arrays, paths and non-finite floats replaced by what JSON knows."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return str(value) if isinstance(value, Path) else value
