"""Co-Fusion's synthetic scenes: colour/Color0001.png and depth_noise/Depth0001.exr (channel Y, metres)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from warpslam.sequences.files import FileSequence
from warpslam.sequences.image_files import list_images, read_exr
from warpslam.sequences.pairing import pair
from warpslam.sequences.recorder_files import find_recorded

# The renderer writes about 1e10 where a ray leaves the scene.
_MAX_DEPTH = 1e3


class CoFusionSequence(FileSequence):
    """A Co-Fusion folder. It has no poses: the published ones can't be aligned with the frames."""

    preset = "cofusion"

    def __init__(self, folder: Path, camera: str | None = None) -> None:
        depth_files = list_images(folder / "depth_noise", suffixes=(".exr",))
        pairs = pair(folder, list_images(folder / "colour"), depth_files)
        super().__init__(
            folder,
            find_recorded(folder, camera, "cofusion", pairs.rgb_files, pairs.depth_files),
            pairs.rgb_files,
            pairs.depth_files,
            remarks=pairs.remarks,
        )

    def read_depth_metres(self, path: Path) -> np.ndarray:
        """Stored depth image in metres, float32, shape (H, W), 0 = missing."""
        depth = read_exr(path, check=self._check_depth_size) / np.float32(self.calibration.depth_scale)
        with np.errstate(invalid="ignore"):
            return np.where((depth > 0) & (depth < _MAX_DEPTH), depth, np.float32(0))
