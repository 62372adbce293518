"""A reader for a format of one's own. The package that brings it names it in its pyproject.toml, and from then on
`warpslam run kitchen.rgbd.npz` reads it:

    [project.entry-points."warpslam.sequences"]
    npz = "my_package.my_module:NpzSequence"
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from warpslam.camera import Intrinsics
from warpslam.errors import DatasetError
from warpslam.sequences.base import Frame, RgbdSequence


class NpzSequence(RgbdSequence):
    """A file with arrays ``rgb`` (N, H, W, 3) uint8, ``depth`` (N, H, W) [m] and ``camera`` (fx, fy, cx, cy)."""

    def __init__(self, path: Path, camera: str | None = None) -> None:
        arrays = np.load(path)
        if missing := {"rgb", "depth", "camera"} - set(arrays.files):
            raise DatasetError(f"{path}: lacks the arrays {', '.join(sorted(missing))}; write them with numpy.savez")
        self.name = path.name.split(".")[0]
        self._rgb, self._depth = arrays["rgb"], arrays["depth"].astype(np.float32)
        fx, fy, cx, cy = map(float, arrays["camera"])
        self.intrinsics = Intrinsics(fx, fy, cx, cy, self._depth.shape[2], self._depth.shape[1])

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Whether a file or folder is of this format."""
        return path.name.endswith(".rgbd.npz")

    def __len__(self) -> int:
        return len(self._depth)

    def __getitem__(self, index: int) -> Frame:
        return Frame(index, index / 30, self._rgb[index], self._depth[index])


if __name__ == "__main__":
    print(f"{len(NpzSequence(Path(sys.argv[1])))} frames")
