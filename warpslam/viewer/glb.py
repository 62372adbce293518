"""A coloured mesh as binary glTF, drawn in its own colours without light: they were measured under the room's."""

from __future__ import annotations

import json
import struct

import numpy as np

_MAGIC, _VERSION = 0x46546C67, 2
_JSON, _BINARY = 0x4E4F534A, 0x004E4942
_FLOAT, _UNSIGNED_SHORT, _UNSIGNED_INT = 5126, 5123, 5125
_VERTICES, _INDICES = 34962, 34963  # targets of buffer views


def glb(vertices: np.ndarray, faces: np.ndarray, colors: np.ndarray, *, both_sides: bool = False) -> bytes:
    """The file's content.

    Args:
        vertices: Shape (V, 3) [m].
        faces: Indices of vertices, shape (F, 3).
        colors: Of the vertices, uint8 (V, 3) or (V, 4), sRGB.
        both_sides: Faces are drawn from behind as well.
    """
    positions = np.ascontiguousarray(vertices, "<f4")
    indices = np.ascontiguousarray(faces, "<u4").reshape(-1)
    linear = np.full((len(positions), 4), 65535, "<u2")
    linear[:, :3] = _LINEAR[np.asarray(colors)[:, :3]]
    parts = [(positions, _VERTICES), (linear, _VERTICES), (indices, _INDICES)]
    views, offset = [], 0
    for array, target in parts:
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": array.nbytes, "target": target})
        offset += array.nbytes
    low, high = (positions.min(axis=0), positions.max(axis=0)) if len(positions) else (np.zeros(3), np.zeros(3))
    content = {
        "asset": {"version": "2.0"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "material": 0}]}],
        "materials": [{"doubleSided": both_sides, "extensions": {"KHR_materials_unlit": {}}}],
        "accessors": [
            {"bufferView": 0, "componentType": _FLOAT, "count": len(positions), "type": "VEC3",
             "min": low.tolist(), "max": high.tolist()},
            {"bufferView": 1, "componentType": _UNSIGNED_SHORT, "normalized": True, "count": len(positions),
             "type": "VEC4"},
            {"bufferView": 2, "componentType": _UNSIGNED_INT, "count": len(indices), "type": "SCALAR"},
        ],
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }  # fmt: skip
    text = json.dumps(content, separators=(",", ":")).encode("ascii")
    text += b" " * (-len(text) % 4)
    binary = b"".join(array.tobytes() for array, _ in parts)  # each is a multiple of four bytes long
    chunks = struct.pack("<II", len(text), _JSON) + text + struct.pack("<II", len(binary), _BINARY) + binary
    return struct.pack("<III", _MAGIC, _VERSION, 12 + len(chunks)) + chunks


def _to_linear() -> np.ndarray:
    srgb = np.arange(256) / 255.0
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    return np.rint(65535 * linear).astype("<u2")


_LINEAR = _to_linear()
"""glTF's colours of vertices are linear."""
