"""Hostile numbers and hostile bytes."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np

NUMBERS = (
    0.0, -0.0, 1.0, -1.0, 0.5, 1e-45, -1e-38, 1e-7, 1e7, 2147483520.0, 2147483648.0, -2147483904.0, 1e10, -1e10, 1e18,
    1e19, -1e19, 1e30, -1e30, 1e38, -1e38, 3.4028235e38, np.inf, -np.inf, np.nan,
)  # fmt: skip
"""What float32 can be, at the edges of int32 and of float32, and what is no number."""
DOUBLES = (*NUMBERS, 1e39, 1e300, -1e300, 1.7976931348623157e308, 5e-324)
OBJECTS: tuple[Any, ...] = (
    None, True, "x", "", b"x", [], {}, (), object(), 1j, 10**400, -(10**30), 1.5, np.array([]), np.array("x"),
    np.zeros(3), np.zeros((2, 3, 4)), np.array([[1j]]), np.array(["a", "b"]), np.zeros((0, 3)), [[1, 2], [3]],
    lambda: None, ..., slice(1, 2), range(3),
)  # fmt: skip


def numbers(rng: np.random.Generator, shape: tuple[int, ...], share: float = 0.3) -> np.ndarray:
    """float64 numbers, a share of them hostile, the others of any size."""
    usual = rng.normal(size=shape) * 10.0 ** rng.uniform(-6, 9, size=shape)
    with np.errstate(over="ignore"):
        return np.where(rng.random(shape) < share, rng.choice(NUMBERS, size=shape), usual)


def mutated_bytes(data: bytes, rng: np.random.Generator) -> bytes:
    """Flipped bits, a cut, a hole, a repeated or a foreign part."""
    changed = bytearray(data)
    for _ in range(int(rng.integers(1, 4))):
        at = int(rng.integers(0, max(len(changed), 1)))
        size = int(rng.integers(1, 200))
        kind = rng.integers(0, 6)
        if kind == 0 and changed:
            changed[at] ^= 1 << int(rng.integers(0, 8))
        elif kind == 1:
            del changed[at:]
        elif kind == 2:
            changed[at : at + size] = bytes(len(changed[at : at + size]))
        elif kind == 3:
            changed[at:at] = changed[at : at + size]
        elif kind == 4:
            changed[at : at + size] = rng.bytes(size)
        else:
            del changed[at : at + size]
    return bytes(changed)


def mutated_json(value: Any, rng: np.random.Generator) -> Any:
    """The same tree with one to three nodes replaced by something that does not belong there."""
    value = json.loads(json.dumps(value))
    for _ in range(int(rng.integers(1, 4))):
        places = list(_places(value))
        if not places:
            return value
        owner, key = places[rng.integers(0, len(places))]
        kind = rng.integers(0, 3)
        if kind == 0:
            del owner[key]
        else:
            owner[key] = _hostile_node(owner[key], rng)
    return value


def _places(value: Any) -> Any:
    if isinstance(value, dict | list):
        for key in list(value) if isinstance(value, dict) else range(len(value)):
            yield value, key
            yield from _places(value[key])


def _hostile_node(old: Any, rng: np.random.Generator) -> Any:
    nodes = [
        None, True, False, "", "x" * 300, "\x1b[31m\n", "../../etc/passwd", [], {}, [[]], -1, 0, 1, 2**31, 2**63,
        10**40, -(10**40), 1.5, 1e308, -1e308, float("nan"), float("inf"), "NaN", {"a": {"b": []}}, [1, "a"], "cuda",
    ]  # fmt: skip
    if isinstance(old, int | float) and not isinstance(old, bool) and rng.random() < 0.5:
        with np.errstate(over="ignore"):
            return float(old) * float(rng.choice([-1.0, 0.0, 1e3, 1e9, 1e-9, 0.5]))
    return nodes[rng.integers(0, len(nodes))]


def mutated_array(array: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """An array with hostile values, or of another shape or type."""
    kind = rng.integers(0, 7)
    array = array.copy()
    if kind == 0:
        return array[: len(array) // 2] if array.ndim else array[None]
    if kind == 1:
        return np.zeros((0, *array.shape[1:]), array.dtype) if array.ndim else array
    if kind == 2:
        return array.astype(rng.choice([np.float32, np.int32, np.uint8, np.int64, np.float64]))
    if kind == 3:
        return array.reshape(-1)
    flat = array.reshape(-1)
    if not flat.size:
        return array
    where = rng.random(flat.size) < rng.choice([1.0, 0.1, 0.0])
    where[rng.integers(0, flat.size)] = True
    if array.dtype.kind == "f":
        with np.errstate(over="ignore", invalid="ignore"):
            flat[where] = rng.choice(DOUBLES, size=int(where.sum())).astype(array.dtype)
            if kind == 4:  # finite, but absurd
                flat[where] = rng.choice([0.0, -1.0, 1e30, -1e30, 1e300, 3.0], size=int(where.sum()))
    else:
        flat[where] = np.frombuffer(rng.bytes(8 * int(where.sum())), np.int64).astype(array.dtype)
    return array


def float_bits(value: float) -> bytes:
    """Of a float32."""
    return struct.pack("<f", value)
