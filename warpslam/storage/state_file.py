"""Files of named arrays and one JSON header, written atomically and checked at load. Reading one can't run code.

The layout is that of safetensors, which other tools read:

    8 bytes   length n of the table, unsigned little-endian
    n bytes   the table, JSON: {name: {"dtype", "shape", "data_offsets"}, ..., "__metadata__": {text: text}}
    the rest  the arrays, little-endian and C-ordered, one behind the other

The metadata hold the format's name and version, the header, and the SHA-256 of the table (with zeros in the place of
the digest) and of all that follows. Nothing is decoded before the digest agrees, and no array is made that the file
has no bytes for.

The package safetensors reads these files, and the tests check that it does. It does not write or read them here: with
several keys of metadata its files differ from one save to the next (14 of 20 did, with 0.8.0), it copies all arrays of
a file that was read for its digest, and of most damaged tables it does not say which array is at fault.
"""

from __future__ import annotations

import hashlib
import json
import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from warpslam.errors import CheckpointError, ConfigError
from warpslam.storage.atomic import replacing

T = TypeVar("T")

_DTYPES = {"U8": "<u1", "I8": "<i1", "U16": "<u2", "I32": "<i4", "I64": "<i8", "F32": "<f4", "F64": "<f8"}
_NAMES = {np.dtype(code): name for name, code in _DTYPES.items()}
_METADATA = "__metadata__"
_NO_DIGEST = "0" * 64
_MAX_TABLE_BYTES = 1 << 30


@dataclass(frozen=True)
class StateFormat:
    """A kind of state file."""

    name: str
    """What the file calls itself."""
    version: int
    """A whole number that grows."""
    origin: str = "what belongs here"
    """Where such files come from, for who names one of another kind."""


def write_state(path: Path, form: StateFormat, header: dict[str, Any], arrays: dict[str, np.ndarray]) -> int:
    """Write header and arrays; returns the size of the file [bytes].

    A file of that name is replaced in one step, when all of the new one is on the disk: whatever stops the program,
    ``path`` holds the old or the new content. The same content gives the same bytes.

    Raises:
        CheckpointError: The file can't be written, for example because the disk is full.
    """
    arrays = {name: _little_endian(array) for name, array in arrays.items()}
    table: dict[str, Any] = {}
    offset = 0
    for name, array in arrays.items():
        end = offset + array.nbytes
        table[name] = {"dtype": _NAMES[array.dtype], "shape": list(array.shape), "data_offsets": [offset, end]}
        offset = end
    table[_METADATA] = {
        "format": form.name,
        "version": str(form.version),
        "header": json.dumps(header),
        "sha256": _NO_DIGEST,
    }
    blank = json.dumps(table).encode()
    # Arrays begin at a multiple of 8 bytes, so that they can be used where they lie.
    blank += b" " * (-len(blank) % 8)
    digest = hashlib.sha256(blank)
    for array in arrays.values():
        digest.update(_bytes(array))
    table[_METADATA]["sha256"] = digest.hexdigest()
    text = json.dumps(table).encode().ljust(len(blank))

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path, durable=True) as partial, open(partial, "wb") as file:
            file.write(struct.pack("<Q", len(text)) + text)
            for array in arrays.values():
                file.write(_bytes(array))
    except OSError as error:
        needed = (8 + len(text) + offset) / 1e6
        raise CheckpointError(
            f"{path}: can't be written ({error.strerror or error}); {needed:.1f} MB are needed there"
        ) from error
    return 8 + len(text) + offset


def read_state(path: Path, form: StateFormat) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Header and arrays (read-only) of a file that `write_state` wrote.

    Raises:
        CheckpointError: The file is missing, truncated, altered, of another kind, or of another version.
    """
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise CheckpointError(f"{path}: no such file") from None
    except OSError as error:
        raise CheckpointError(f"{path}: can't be read ({error.strerror})") from error
    table, data = _open(path, content)
    metadata = table.pop(_METADATA)
    if metadata["format"] != form.name:
        raise CheckpointError(
            f"{path}: field format is {metadata['format']!r}, expected {form.name!r}: name {form.origin}"
        )
    _check_version(path, metadata["version"], form)
    try:
        header = json.loads(metadata["header"])
        if not isinstance(header, dict):
            raise TypeError(f"expected an object, found {type(header).__name__}")
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise CheckpointError(f"{path}: field header is damaged ({error!r}): use another copy") from None
    return header, {name: _array(path, name, entry, data) for name, entry in table.items()}


def _open(path: Path, content: bytes) -> tuple[dict[str, Any], memoryview]:
    """Table and data of a file whose digest agrees."""
    if content[:2] == b"PK":
        raise CheckpointError(f"{path}: an .npz file of an early warpslam; this version can't read it: run again")
    (size,) = struct.unpack("<Q", content[:8]) if len(content) >= 8 else (0,)
    if not 0 < size <= min(len(content) - 8, _MAX_TABLE_BYTES):
        raise CheckpointError(f"{path}: no state file of warpslam, or truncated: use another copy")
    text = content[8 : 8 + size]
    try:
        table = json.loads(text)
        metadata = table[_METADATA]
        digest = metadata["sha256"]
        if not all(isinstance(metadata[name], str) for name in ("format", "version", "sha256")) or len(digest) != 64:
            raise TypeError("expected text")
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise CheckpointError(
            f"{path}: no state file of warpslam, or its table is damaged ({type(error).__name__}): use another copy"
        ) from None
    data = memoryview(content)[8 + size :]
    actual = hashlib.sha256(text.replace(digest.encode(), _NO_DIGEST.encode(), 1))
    actual.update(data)
    if actual.hexdigest() != digest:
        raise CheckpointError(f"{path}: field sha256 does not agree with the content, which is truncated or altered: "
                              "use another copy")  # fmt: skip
    return table, data


def _check_version(path: Path, text: str, form: StateFormat) -> None:
    if text == str(form.version):
        return
    newer = text.isdigit() and int(text[:9]) > form.version
    remedy = "update warpslam" if newer else "load it with the warpslam that wrote it, or run again"
    raise CheckpointError(f"{path}: field version is {text}, this warpslam reads {form.version}: {remedy}")


def _array(path: Path, name: str, entry: Any, data: memoryview) -> np.ndarray:
    try:
        dtype, shape = np.dtype(_DTYPES[entry["dtype"]]), tuple(entry["shape"])
        first, end = entry["data_offsets"]
        if not all(type(number) is int and number >= 0 for number in (*shape, first, end)):
            raise ValueError("sizes must be whole numbers")
        if not (first <= end <= len(data) and math.prod(shape) * dtype.itemsize == end - first):
            raise ValueError(f"shape {shape} needs other bytes than {first} to {end}")
        return np.frombuffer(data[first:end], dtype).reshape(shape)
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(f"{path}: field {name} is damaged ({error}): use another copy") from None


def _little_endian(array: np.ndarray) -> np.ndarray:
    # (ascontiguousarray alone would make a number an array of one.)
    array = np.asarray(array)
    return np.ascontiguousarray(array, array.dtype.newbyteorder("<")).reshape(array.shape)


def _bytes(array: np.ndarray) -> memoryview:
    return array.reshape(-1).data.cast("B") if array.size else memoryview(b"")


class StateFields:
    """Fields of a state, each checked when it is taken: one that does not fit is a `CheckpointError` that names it."""

    def __init__(self, source: str, header: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
        self.source, self.header, self.arrays = source, header, arrays

    def damaged(self, name: str, why: object) -> CheckpointError:
        """The error for a field that does not fit."""
        return CheckpointError(f"{self.source}: field {name} is missing or damaged ({why}): use another copy")

    def array(self, name: str, dtype: type, shape: tuple[int | None, ...]) -> np.ndarray:
        """An array of a dtype and a shape, where None stands for any size."""
        array = self.arrays.get(name)
        if array is None:
            raise self.damaged(name, "it is not there")
        wanted = tuple(n if size is None else size for size, n in zip(shape, array.shape, strict=False))
        if array.dtype != dtype or len(array.shape) != len(shape) or array.shape != wanted:
            expected = f"{np.dtype(dtype)} {tuple('any' if n is None else n for n in shape)}"
            raise self.damaged(name, f"it is {array.dtype} {array.shape}, expected {expected}")
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise self.damaged(name, "it holds NaN or infinity")
        return array

    def parsed(self, name: str, parse: Callable[[dict[str, Any]], T]) -> T:
        """What ``parse`` makes of a mapping."""
        try:
            return parse(self.mapping(name))
        except (TypeError, ConfigError) as error:
            raise self.damaged(name, error) from None

    def mapping(self, name: str) -> dict[str, Any]:
        """Names and values."""
        value = self.header.get(name)
        if not isinstance(value, dict):
            raise self.damaged(name, f"expected a mapping, found {type(value).__name__}")
        return value

    def integer(self, name: str) -> int:
        """A whole number from 0 on."""
        value = self.header.get(name)
        if type(value) is not int or value < 0:
            raise self.damaged(name, f"expected a whole number, found {value!r}")
        return value

    def frame(self, name: str, count: int) -> int | None:
        """The number of one of ``count`` frames, or None."""
        return None if self.header.get(name) is None else self._below(name, self.header[name], count)

    def frames(self, name: str, count: int) -> list[int]:
        """Numbers of some of ``count`` frames."""
        value = self.header.get(name)
        if not isinstance(value, list):
            raise self.damaged(name, f"expected a list, found {type(value).__name__}")
        return [self._below(name, index, count) for index in value]

    def _below(self, name: str, index: Any, count: int) -> int:
        if type(index) is not int or not 0 <= index < count:
            raise self.damaged(name, f"{index!r} is none of the {count} frames")
        return index
