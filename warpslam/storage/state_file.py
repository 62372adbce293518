"""Files of named arrays and one JSON header, written atomically and checked at load. Reading one can't run code.

They are safetensors files, which other tools read. All metadata are JSON text under one key, because with several keys
the package safetensors writes other bytes each time: the format's name and version, the header, and the SHA-256 of the
file with zeros in the place of the digest. No array is used before the digest agrees.
"""

from __future__ import annotations

import hashlib
import json
import math
import struct
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from warpslam.errors import CheckpointError, ConfigError, brief
from warpslam.poses import are_rigid
from warpslam.reading import check_name, check_regular
from warpslam.storage.atomic import replacing
from warpslam.storage.json_files import checked

T = TypeVar("T")

_METADATA = "__metadata__"
_KEY = "warpslam"
_NO_DIGEST = "0" * 64
_CHUNK = 1 << 20
_LEAST_SHARE = 1e-14  # of the largest variance: an eigenvalue below it is none
_LARGEST_VARIANCE = 1e15  # beside which what is added to it is lost


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
    metadata = {"format": form.name, "version": form.version, "sha256": _NO_DIGEST, "header": header}
    native = {name: _native(array) for name, array in arrays.items()}
    try:
        check_name(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path, durable=True) as partial:
            partial.touch()
            mode = partial.stat().st_mode
            save_file(native, partial, {_KEY: json.dumps(metadata)})
            # safetensors leaves a file that none but its owner can read.
            partial.chmod(mode)
            digest, place = _digest(partial, _NO_DIGEST)
            with open(partial, "r+b") as file:
                file.seek(place)
                file.write(digest.encode())
            return partial.stat().st_size
    except (OSError, SafetensorError) as error:
        needed = sum(array.nbytes for array in native.values()) / 1e6
        reason = getattr(error, "strerror", None) or error
        raise CheckpointError(f"{path}: can't be written ({reason}); {needed:.1f} MB are needed there") from error


def read_state(path: Path, form: StateFormat) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Header and arrays of a file that `write_state` wrote.

    Raises:
        CheckpointError: The file is missing, truncated, altered, of another kind, or of another version.
    """
    try:
        check_regular(path)
        with open(path, "rb") as opened:
            if opened.read(2) == b"PK":
                raise CheckpointError(
                    f"{path}: an .npz file of an early warpslam; this version can't read it: run again"
                )
        with safe_open(path, framework="numpy") as file:
            metadata = _metadata(path, file.metadata())
            if _digest(path, metadata["sha256"])[0] != metadata["sha256"]:
                raise CheckpointError(
                    f"{path}: field sha256 does not agree with the content, which is truncated or altered: "
                    "use another copy"
                )
            _check_kind(path, metadata, form)
            return metadata["header"], {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except FileNotFoundError:
        raise CheckpointError(f"{path}: no such file") from None
    except OSError as error:
        raise CheckpointError(f"{path}: can't be read ({error.strerror or error})") from error
    except MemoryError:
        raise CheckpointError(f"{path}: does not fit into memory; close other programs") from None
    except (SafetensorError, TypeError, ValueError, OverflowError, AttributeError) as error:
        where = _damaged_entry(path)
        what = f"field {where} is damaged" if where else "no state file of warpslam, or its table is damaged"
        raise CheckpointError(f"{path}: {what}, truncated or altered ({error}): use another copy") from None


def _native(array: np.ndarray) -> np.ndarray:
    # (ascontiguousarray alone would make a number an array of one.)
    array = np.asarray(array)
    return np.ascontiguousarray(array, array.dtype.newbyteorder("=")).reshape(array.shape)


def _digest(path: Path, digest: str) -> tuple[str, int]:
    """SHA-256 of a file with zeros in the place of the text ``digest``, and where in the file that stands."""
    with open(path, "rb") as file:
        (size,) = struct.unpack("<Q", file.read(8))
        table = file.read(size)
        place = table.find(digest.encode())
        actual = hashlib.sha256(struct.pack("<Q", size) + table.replace(digest.encode(), _NO_DIGEST.encode(), 1))
        while chunk := file.read(_CHUNK):
            actual.update(chunk)
    return actual.hexdigest(), 8 + place


def _metadata(path: Path, found: dict[str, str] | None) -> dict[str, Any]:
    """What stands under our key, each part of its type."""
    try:
        metadata = json.loads((found or {})[_KEY])
        if not isinstance(metadata["header"], dict):
            raise CheckpointError(f"{path}: field header is damaged (expected an object): use another copy")
        texts = metadata["format"], metadata["sha256"]
        if not all(isinstance(text, str) for text in texts) or len(metadata["sha256"]) != len(_NO_DIGEST):
            raise TypeError("expected text")
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise CheckpointError(
            f"{path}: no state file of warpslam, or its metadata are damaged ({type(error).__name__}): use another copy"
        ) from None
    return metadata


def _check_kind(path: Path, metadata: dict[str, Any], form: StateFormat) -> None:
    if metadata["format"] != form.name:
        raise CheckpointError(
            f"{path}: field format is {metadata['format']!r}, expected {form.name!r}: name {form.origin}"
        )
    version = metadata.get("version")
    if version != form.version:
        newer = isinstance(version, int) and version > form.version
        remedy = "update warpslam" if newer else "load it with the warpslam that wrote it, or run again"
        raise CheckpointError(f"{path}: field version is {version}, this warpslam reads {form.version}: {remedy}")


def _damaged_entry(path: Path) -> str:
    """The first array of a damaged file that can't be as the table has it; safetensors does not always name it."""
    try:
        with open(path, "rb") as file:
            (size,) = struct.unpack("<Q", file.read(8))
            table = json.loads(file.read(min(size, path.stat().st_size)))
        rest = path.stat().st_size - 8 - size
        for name, entry in table.items():
            if name != _METADATA and not _is_possible(entry, rest):
                return str(name)
    except (OSError, struct.error, ValueError, TypeError, AttributeError, RecursionError):
        pass
    return ""


def _is_possible(entry: Any, size: int) -> bool:
    try:
        bits = int("".join(filter(str.isdigit, entry["dtype"])))
        shape, (first, end) = entry["shape"], entry["data_offsets"]
        whole = all(type(number) is int and number >= 0 for number in (*shape, first, end))
        return whole and first <= end <= size and math.prod(shape) * bits == 8 * (end - first)
    except (KeyError, TypeError, ValueError):
        return False


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

    def poses(self, name: str, count: int | None) -> np.ndarray:
        """Rigid transforms of a camera, float64 (``count``, 4, 4), none too far from the origin."""
        poses = self.array(name, np.float64, (count, 4, 4))
        if not are_rigid(poses):
            raise self.damaged(name, "they are no rigid transforms of a camera, or too far from the origin")
        return poses

    def parsed(self, name: str, parse: Callable[[dict[str, Any]], T]) -> T:
        """What ``parse`` makes of a mapping."""
        try:
            return parse(self.mapping(name))
        except (TypeError, ConfigError) as error:
            raise self.damaged(name, error) from None

    def checked(self, name: str, kind: type[T]) -> T:
        """A mapping as a model or data class, each value of its kind."""
        try:
            return checked(kind, self.mapping(name))
        except ValueError as error:
            raise self.damaged(name, error) from None

    def names(self, name: str, known: Collection[str]) -> list[str]:
        """Some of the names that are known, each once."""
        value = self.header.get(name)
        if not isinstance(value, list) or any(one not in known for one in value) or len(set(value)) < len(value):
            raise self.damaged(name, f"{brief(repr(value))} are not some of {', '.join(sorted(known))}")
        return value

    def covariances(self, name: str, count: int) -> np.ndarray:
        """Of poses, float64 (``count``, 6, 6), symmetric and invertible; rounding may have made one indefinite."""
        found = self.array(name, np.float64, (count, 6, 6))
        size = np.abs(found).max(axis=(1, 2), initial=0.0)[:, None]
        is_symmetric = (np.abs(found - found.swapaxes(1, 2)).max(axis=2, initial=0.0) <= 1e-6 * size).all()
        if size.max(initial=0.0) > _LARGEST_VARIANCE or not is_symmetric:
            raise self.damaged(name, "they are no covariances, or too large")
        if (np.abs(np.linalg.eigvalsh(found)) <= _LEAST_SHARE * size).any():
            raise self.damaged(name, "they are no covariances: one can't be inverted")
        return found

    def mapping(self, name: str) -> dict[str, Any]:
        """Names and values."""
        value = self.header.get(name)
        if not isinstance(value, dict):
            raise self.damaged(name, f"expected a mapping, found {type(value).__name__}")
        return value

    def integer(self, name: str) -> int:
        """A whole number from 0 on."""
        value = self.header.get(name)
        if type(value) is not int or not 0 <= value < 1 << 63:
            raise self.damaged(name, f"expected a whole number, found {brief(repr(value))}")
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
