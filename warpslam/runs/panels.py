"""Frames beside what the map renders from their poses, kept in the run folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warpslam.errors import DatasetError, brief
from warpslam.reading import ARCHIVE_ERRORS, MEGABYTE, check_regular
from warpslam.storage.atomic import replacing

PANEL_COUNT = 4
"""Frames of a run that are shown beside what its map renders."""
_COLUMNS = ("index", "rgb", "depth", "rendered_rgb", "rendered_depth")
_UNPACKED = 256 * MEGABYTE
_WIDTH = 240  # [px], at most: small images tell as much in the figure, and rendering is slow without a GPU


def panel_stride(width: int) -> int:
    """Every so many pixels of images that are ``width`` wide are rendered for a panel."""
    return -(-width // _WIDTH)


@dataclass(frozen=True)
class Panel:
    """One frame as it came in and as the map renders it."""

    index: int
    """Number in the sequence."""

    rgb: np.ndarray
    """Input colour, uint8, (H, W, 3)."""

    depth: np.ndarray
    """Input depth [m], (H, W), 0 = missing."""

    rendered_rgb: np.ndarray
    """Float, (H, W, 3), 0..1."""

    rendered_depth: np.ndarray
    """Depth [m], (H, W)."""


def save_panels(path: Path, panels: list[Panel]) -> None:
    """Write the images of panels as arrays, colour to 1/255 and depth to 1 mm; `load_panels` reads them."""

    def millimetres(depth: np.ndarray) -> np.ndarray:
        return np.rint(np.clip(np.nan_to_num(depth) * 1000, 0, 65535)).astype(np.uint16)

    images: dict[str, Any] = {
        "index": np.array([panel.index for panel in panels]),
        "rgb": np.stack([panel.rgb for panel in panels]),
        "depth": np.stack([millimetres(panel.depth) for panel in panels]),
        "rendered_rgb": np.stack(
            [np.rint(np.clip(panel.rendered_rgb, 0, 1) * 255).astype(np.uint8) for panel in panels]
        ),
        "rendered_depth": np.stack([millimetres(panel.rendered_depth) for panel in panels]),
    }
    # (NumPy appends .npz to a name.)
    with replacing(path) as partial, open(partial, "wb") as file:
        np.savez_compressed(file, **images)


def load_panels(path: Path) -> list[Panel]:
    """Read what `save_panels` wrote.

    Raises:
        DatasetError: The file can't be read or holds something else.
    """
    try:
        check_regular(path)
        with np.load(path, allow_pickle=False) as file:
            size = sum(member.file_size for member in file.zip.infolist())  # it unpacks no more, whatever is in it
            if size > _UNPACKED:
                raise ValueError(f"{size / MEGABYTE:.0f} MB, expected at most {_UNPACKED // MEGABYTE}")
            index, rgb, depth, rendered_rgb, rendered_depth = (file[name] for name in _COLUMNS)
        _check_columns(index, rgb, depth, rendered_rgb, rendered_depth)
    except ARCHIVE_ERRORS as error:
        raise DatasetError(f"{path}: can't be read as images of panels ({brief(error)}); run again") from error
    return [
        Panel(int(index), rgb, depth / np.float32(1000), rendered_rgb / np.float32(255), far / np.float32(1000))
        for index, rgb, depth, rendered_rgb, far in zip(index, rgb, depth, rendered_rgb, rendered_depth, strict=True)
    ]


def _check_columns(
    index: np.ndarray, rgb: np.ndarray, depth: np.ndarray, rendered_rgb: np.ndarray, rendered_depth: np.ndarray
) -> None:
    size = depth.shape
    if index.dtype.kind not in "iu" or index.shape != size[:1] or len(size) != 3 or 0 in size[1:]:
        raise ValueError(f"index is {index.dtype} {index.shape}, depth {size}")
    for name, array, dtype, shape in (
        ("rgb", rgb, np.uint8, (*size, 3)),
        ("depth", depth, np.uint16, size),
        ("rendered_rgb", rendered_rgb, np.uint8, (*size, 3)),
        ("rendered_depth", rendered_depth, np.uint16, size),
    ):
        if array.dtype != dtype or array.shape != shape:
            raise ValueError(f"{name} is {array.dtype} {array.shape}, expected {np.dtype(dtype)} {shape}")
