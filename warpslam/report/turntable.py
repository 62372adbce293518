"""The mesh that can be turned, inside the page: made lighter, packed, and drawn by ``turntable.js`` (WebGL 2)."""

from __future__ import annotations

import base64
import json
import zlib
from typing import TYPE_CHECKING

import numpy as np

from warpslam.report.data import upright_axes
from warpslam.report.page import Html, asset, element, void
from warpslam.report.pictures import mean_backward

if TYPE_CHECKING:
    import trimesh

MAX_FACES = 150_000
"""Of the mesh in the page, so that the file stays below 8 MB; the one beside it has all."""
_SHRINK = 1.15  # by which the cells grow where too many faces are left
_STEPS = 65535  # of a coordinate
_ASIDE = 0.5  # [rad], by which one looks past the cameras at first


def turntable(mesh: trimesh.Trimesh, poses: np.ndarray) -> Html:
    """The mesh and the path of the camera on a canvas that is turned with the pointer, with all that it draws.

    Args:
        mesh: Mesh with vertex colours [m].
        poses: Camera-to-world transforms of the run, shape (N, 4, 4), N >= 1.
    """
    vertices, faces, colors = lightened(
        np.asarray(mesh.vertices), np.asarray(mesh.faces), np.asarray(mesh.visual.vertex_colors)[:, :3], MAX_FACES
    )
    axes = upright_axes(poses)
    path = poses[:, :3, 3]
    # Axes of the page: right, up, towards the viewer.
    turned = np.stack([axes[0], axes[2], -axes[1]])
    vertices, path = vertices @ turned.T, path @ turned.T
    back = turned @ mean_backward(poses, axes)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    scale = float(max((high - low).max(), 1e-6))
    facts = {
        "vertices": len(vertices), "faces": len(faces), "path": len(path), "low": low.tolist(), "scale": scale,
        "high": high.tolist(), "turn": float(np.arctan2(back[0], back[2])) + _ASIDE,
    }  # fmt: skip
    steps = np.rint((vertices - low) / scale * _STEPS).astype("<u2")
    # Differences of neighbours are small numbers, which pack well.
    packed = [
        np.diff(steps, axis=0, prepend=np.zeros((1, 3), "<u2")).T,
        np.diff(faces.astype("<i4").reshape(-1), prepend=0).astype("<i4"),
        ((path - low) / scale).astype("<f4"),
        colors.astype(np.uint8),
    ]
    data = b"".join(np.ascontiguousarray(part).tobytes() for part in (packed[2], packed[1], packed[0], packed[3]))
    text = base64.b64encode(zlib.compress(data, 9)).decode("ascii")
    hint = "Drag turns, two fingers or the wheel zoom, shift and drag moves; a double click starts again."
    controls = element(
        "div",
        element("label", void("input", type="checkbox", id="turntable-shape"), " shape without colours"),
        element("label", void("input", type="checkbox", id="turntable-path", checked="checked"), " path"),
        element("label", "cut at ", void("input", type="range", min=0, max=1000, value=1000, id="turntable-cut")),
        class_="controls",
    )
    canvas = element("canvas", id="turntable", tabindex=0, role="img", aria_label="Mesh that can be turned")
    lighter = "" if len(faces) == len(mesh.faces) else f" Drawn with {len(faces):,} faces.".replace(",", " ")
    return element(
        "figure",
        canvas,
        element("p", "This browser draws no WebGL 2; pictures show the mesh.", id="turntable-none", hidden="hidden"),
        controls,
        element("figcaption", hint + lighter),
        element("script", Html(json.dumps(facts)), type="application/json", id="turntable-facts"),
        element("script", Html(text), type="text/plain", id="turntable-data"),
        element("script", Html(asset("turntable.js"))),
        class_="turntable",
    )


def lightened(
    vertices: np.ndarray, faces: np.ndarray, colors: np.ndarray, limit: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A mesh with at most ``limit`` faces: vertices of one cell of a lattice become their mean.

    Args:
        vertices: Shape (V, 3) [m].
        faces: Shape (F, 3).
        colors: Of the vertices, shape (V, 3).
        limit: Faces.

    Returns:
        The same of the lighter mesh; as it is, where it is light enough.
    """
    if len(faces) <= limit:
        return vertices, faces, colors
    corners = vertices[faces]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    cell = max(float(np.sqrt(2 * area / limit)), 1e-6)  # a cell of a plane holds two faces
    while True:
        light = _clustered(vertices, faces, colors, cell)
        if len(light[1]) <= limit:
            return light
        cell *= _SHRINK


def _clustered(
    vertices: np.ndarray, faces: np.ndarray, colors: np.ndarray, cell: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    keys = np.floor((vertices - vertices.min(axis=0)) / cell).astype(np.int64)
    extent = keys.max(axis=0) + 1
    _, owner = np.unique(keys @ [extent[1] * extent[2], extent[2], 1], return_inverse=True)
    count = np.bincount(owner)
    columns = np.concatenate([vertices, colors], axis=1).T
    means = np.stack([np.bincount(owner, weights=column) / count for column in columns], axis=1)
    kept = owner[faces]
    kept = kept[(kept[:, 0] != kept[:, 1]) & (kept[:, 1] != kept[:, 2]) & (kept[:, 2] != kept[:, 0])]
    # The same triangle from another corner is the same triangle.
    first = kept.argmin(axis=1)
    kept = np.stack([kept[np.arange(len(kept)), (first + n) % 3] for n in range(3)], axis=1)
    kept = np.unique(kept, axis=0)
    used, index = np.unique(kept, return_inverse=True)
    return means[used, :3], index.reshape(-1, 3), np.rint(means[used, 3:])
