"""A sequence made of a colour and a depth file a frame."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from warpslam.sequences.base import Remark
from warpslam.sequences.calibration import Calibration
from warpslam.sequences.image_files import read_depth, read_grey, read_rgb
from warpslam.sequences.images import ImageSequence
from warpslam.sequences.video import Video


class FileSequence(ImageSequence):
    """RGB-D files on disk.

    Args:
        folder: Folder of the sequence; gives it its name.
        calibration: Camera of the stored images.
        rgb_files: Colour images; or a video, with ``video_frames``.
        depth_files: Depth images, as many.
        poses: As in `ImageSequence`, and so are the others.
        timestamps: Times [s], shape (N,).
        depth_timestamps: Times of the depth images [s], shape (N,).
        remarks: What was noticed in making the list of frames.
        same_view: Colour and depth are known to have the same field of view, whatever their sizes.
        conventions: As in `ImageSequence`.
        confidence_files: Images, as many, that are 0 where depth is no measurement.

        video_frames: Number of each frame in the video, int (N,); 0, 1, 2, ... if None.

    Raises:
        DatasetError: There are no frames, or none of the first can be read and fits the camera.
    """

    def __init__(
        self,
        folder: Path,
        calibration: Calibration,
        rgb_files: Sequence[Path] | Video,
        depth_files: Sequence[Path],
        *,
        poses: np.ndarray | None = None,
        timestamps: np.ndarray | None = None,
        depth_timestamps: np.ndarray | None = None,
        remarks: Sequence[Remark] = (),
        same_view: bool = False,
        conventions: Sequence[str] = (),
        confidence_files: Sequence[Path] | None = None,
        video_frames: np.ndarray | None = None,
    ) -> None:
        self._video = rgb_files if isinstance(rgb_files, Video) else None
        self._rgb_files = [rgb_files.path] * len(depth_files) if isinstance(rgb_files, Video) else list(rgb_files)
        self._video_frames = np.arange(len(depth_files)) if video_frames is None else video_frames
        self._depth_files = list(depth_files)
        self._confidence_files = None if confidence_files is None else list(confidence_files)
        super().__init__(
            typed_name(folder),
            calibration,
            len(self._depth_files),
            poses=poses,
            timestamps=timestamps,
            depth_timestamps=depth_timestamps,
            remarks=remarks,
            same_view=same_view,
            conventions=conventions,
        )

    def files(self, index: int) -> tuple[Path, ...]:
        """The files of a frame."""
        return self._rgb_files[index], self._depth_files[index]

    def labels(self, index: int) -> tuple[str, str]:
        """Paths of the colour and the depth image of a frame."""
        return str(self._rgb_files[index]), str(self._depth_files[index])

    def read_depth_metres(self, path: Path) -> np.ndarray:
        """Stored depth image in metres, float32, shape (H, W), 0 = missing."""
        return self.metres(read_depth(path, self._check_depth_size))

    def _stored_rgb(self, index: int) -> np.ndarray:
        if self._video is not None:
            return self._video[int(self._video_frames[index])]
        return read_rgb(self._rgb_files[index], self._check_color_size)

    def _stored_depth(self, index: int) -> np.ndarray:
        depth = self.read_depth_metres(self._depth_files[index])
        if self._confidence_files is not None:
            confidence = read_grey(self._confidence_files[index])
            if confidence.shape == depth.shape:
                depth = np.where(confidence > 0, depth, np.float32(0))
        return depth


def typed_name(path: Path) -> str:
    """Name of a sequence: that of the folder or file as it was typed, a symbolic link's own and not its target's."""
    path = Path(os.path.abspath(path))
    return path.name if path.is_dir() else path.stem
