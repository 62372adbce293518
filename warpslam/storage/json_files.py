"""JSON files, written whole or not at all."""

from __future__ import annotations

import dataclasses
import json
import math
from functools import cache
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import Field, TypeAdapter, ValidationError

from warpslam.errors import DatasetError, brief
from warpslam.reading import MEGABYTE, read_text
from warpslam.storage.atomic import replacing

T = TypeVar("T")

Index = Annotated[int, Field(ge=0, le=1 << 53)]
"""A number of a frame, or of frames."""
Finite = Annotated[float, Field(allow_inf_nan=False)]
Number = Finite | None
"""As `to_json` writes a float: null stands for NaN and infinity."""
Seconds = Annotated[float, Field(ge=0.0, le=1e12)]
"""A duration [s]."""

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


def read_as(path: Path, kind: type[T]) -> T:
    """Read a JSON object, each of its values checked: see `checked`.

    Raises:
        DatasetError: The file can't be read, or a field is not of its kind.
    """
    value = read_json(path)
    try:
        return checked(kind, value)
    except ValueError as error:
        raise DatasetError(f"{path}: {error}; run again to write it anew") from None


def checked(kind: type[T], value: Any) -> T:
    """What a model of pydantic, or a data class, makes of plain values of a stranger's.

    Raises:
        ValueError: One is missing, unknown to the data class, or not of its kind; names the field.
    """
    if dataclasses.is_dataclass(kind) and isinstance(value, dict):
        for name in value.keys() - {field.name for field in dataclasses.fields(kind)}:
            raise ValueError(f"{brief(name)}: unknown field")
    known: Any = kind  # (a type that mypy can't tell to be hashable)
    try:
        return _adapter(known).validate_python(value)
    except ValidationError as error:
        fault = error.errors(include_url=False)[0]
        name = ".".join(map(str, fault["loc"])) or "all of it"
        raise ValueError(f"{brief(name)}: {fault['msg']} (got {brief(repr(fault['input']))})") from None


@cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    return TypeAdapter(kind)


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
