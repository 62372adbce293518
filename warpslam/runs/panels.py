"""Frames beside what the map renders from their poses, kept in the run folder."""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warpslam.errors import DatasetError
from warpslam.storage.atomic import replacing

PANEL_COUNT = 4
"""Frames of a run that are shown beside what its map renders."""
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
        with np.load(path, allow_pickle=False) as file:
            columns = [file[name] for name in ("index", "rgb", "depth", "rendered_rgb", "rendered_depth")]
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise DatasetError(f"{path}: can't be read as images of panels ({error}); run again") from error
    return [
        Panel(int(index), rgb, depth / np.float32(1000), rendered_rgb / np.float32(255), far / np.float32(1000))
        for index, rgb, depth, rendered_rgb, far in zip(*columns, strict=True)
    ]
