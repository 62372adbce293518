"""What all readers share: a sequence made of a colour and a depth file a frame."""

from __future__ import annotations

import copy
import operator
import re
from collections.abc import Sequence
from functools import cached_property, partial
from pathlib import Path

import numpy as np

from warpslam.camera import SensorTiming
from warpslam.errors import DatasetError
from warpslam.sequences.base import Frame, RgbdSequence
from warpslam.sequences.calibration import Calibration
from warpslam.sequences.image_files import read_depth, read_rgb

FRAME_RATE = 30.0
_FIRST_FRAMES = 10


class FileSequence(RgbdSequence):
    """RGB-D files on disk. Colour (and depth, if it is distorted alike) is undistorted, then both are resized, cropped.

    Args:
        folder: Folder of the sequence; gives it its name.
        calibration: Camera of the stored images.
        rgb_files: Colour images.
        depth_files: Depth images, as many.
        poses: Camera-to-world transforms, OpenCV axes, shape (N, 4, 4), NaN where unknown, or None.
        timestamps: Times [s], shape (N,); index / 30 if None.
        depth_timestamps: Times of the depth images [s], shape (N,), where they have their own.
        color_size_may_differ: Resize colour to the size of the depth image instead of refusing another size.
        remarks: What was left out in making the list of frames, for `warpslam check`.

    Raises:
        DatasetError: If the counts differ, or none of the first frames can be read and fits the camera.
    """

    def __init__(
        self,
        folder: Path,
        calibration: Calibration,
        rgb_files: Sequence[Path],
        depth_files: Sequence[Path],
        *,
        poses: np.ndarray | None = None,
        timestamps: np.ndarray | None = None,
        depth_timestamps: np.ndarray | None = None,
        color_size_may_differ: bool = False,
        remarks: Sequence[str] = (),
    ) -> None:
        if len(rgb_files) != len(depth_files):
            raise DatasetError(
                f"{folder}: {len(rgb_files)} colour images but {len(depth_files)} depth images; "
                "remove those without a partner or complete the download"
            )
        if not rgb_files:
            raise DatasetError(f"{folder}: no frames; check that the download is complete and unpacked")
        if poses is not None and len(poses) != len(rgb_files):
            raise DatasetError(
                f"{folder}: {len(poses)} poses but {len(rgb_files)} frames; "
                "use the pose file that belongs to these images, or remove it to run without ground truth"
            )
        self.name = folder.resolve().name
        self.calibration = calibration
        self.intrinsics, self.timing = calibration.intrinsics, calibration.timing
        self.timestamps = np.arange(len(rgb_files)) / FRAME_RATE if timestamps is None else timestamps
        self.depth_timestamps = depth_timestamps
        self._rgb_files, self._depth_files = list(rgb_files), list(depth_files)
        self._poses = None if poses is None or np.isnan(poses).all() else poses
        self._color_size_may_differ = color_size_may_differ
        self.remarks = tuple(remarks)
        self._check_first_frames()

    def as_published(self) -> FileSequence:
        """The sequence with frames resized and cropped as the paper's code does it, depth left as it is stored."""
        published = copy.copy(self)
        published.calibration = self.calibration.as_published()
        published.intrinsics, published.timing = published.calibration.intrinsics, published.calibration.timing
        return published

    def stored_timing(self, timing: SensorTiming) -> SensorTiming:
        """See `RgbdSequence.stored_timing`: rows that are cut off take their time, too."""
        return self.calibration.timing_as_stored(timing)

    def __len__(self) -> int:
        return len(self._rgb_files)

    def __getitem__(self, index: int) -> Frame:
        index = operator.index(index)
        if not -len(self) <= index < len(self):
            raise IndexError(f"frame {index} of a sequence of {len(self)} frames")
        index %= len(self)
        rgb, depth = self._load(index)
        pose = None
        if self._poses is not None and np.isfinite(self._poses[index]).all():
            pose = self._poses[index].copy()
        depth_time = None if self.depth_timestamps is None else float(self.depth_timestamps[index])
        return Frame(index, float(self.timestamps[index]), rgb, depth, pose, depth_time)

    def ground_truth(self) -> np.ndarray | None:
        """All poses, float64, shape (N, 4, 4), NaN where unknown; None if the sequence has none."""
        return None if self._poses is None else self._poses.copy()

    def files(self, index: int) -> tuple[Path, Path]:
        """Colour and depth file of a frame."""
        return self._rgb_files[index], self._depth_files[index]

    def read_depth_metres(self, path: Path) -> np.ndarray:
        """Stored depth image in metres, float32, shape (H, W), 0 = missing."""
        return read_depth(path, self._check_depth_size).astype(np.float32) / np.float32(self.calibration.depth_scale)

    def _check_first_frames(self) -> None:
        """A camera that does not fit the images is found now rather than after a run has begun; but a single bad frame
        is none the worse for being the first.
        """
        first_error = None
        for index in range(min(len(self), _FIRST_FRAMES)):
            try:
                self._load(index)
                return
            except DatasetError as error:
                first_error = first_error or error
        if first_error is not None:
            raise first_error

    def _load(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        try:
            return self._read(index)
        except OSError as error:
            raise DatasetError(f"{error.filename}: can't be read ({error.strerror or error})") from error
        except MemoryError:
            raise DatasetError(f"frame {index} of {self.name} does not fit into memory; close other programs") from None

    def _read(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        check = None if self._color_size_may_differ else partial(self._check_size, "colour")
        depth = self.read_depth_metres(self._depth_files[index])
        self._check_depth_size(self._depth_files[index], depth.shape[1], depth.shape[0])
        rgb = read_rgb(self._rgb_files[index], check)
        if self._color_size_may_differ and rgb.shape[:2] != depth.shape:
            import cv2

            rgb = cv2.resize(rgb, (depth.shape[1], depth.shape[0]), interpolation=cv2.INTER_LINEAR)
        self._check_size("colour", self._rgb_files[index], rgb.shape[1], rgb.shape[0])
        if self.calibration.distortion:
            import cv2

            rgb = cv2.remap(rgb, *self._undistortion, interpolation=cv2.INTER_LINEAR)
            if self.calibration.depth_distorted:
                depth = cv2.remap(depth, *self._undistortion, interpolation=cv2.INTER_NEAREST)
        if self.calibration.resize is not None:
            rgb, depth = _resize(rgb, depth, *self.calibration.resize)
        border = self.calibration.crop
        if border:
            rgb, depth = (np.ascontiguousarray(image[border:-border, border:-border]) for image in (rgb, depth))
        return rgb, depth

    @cached_property
    def _undistortion(self) -> tuple[np.ndarray, np.ndarray]:
        import cv2

        camera = self.calibration.stored
        coefficients = np.array(self.calibration.distortion)
        size = (camera.width, camera.height)
        return cv2.initUndistortRectifyMap(camera.matrix, coefficients, None, camera.matrix, size, cv2.CV_32FC1)

    def _check_depth_size(self, path: Path, width: int, height: int) -> None:
        self._check_size("depth", path, width, height)

    def _check_size(self, kind: str, path: Path, width: int, height: int) -> None:
        camera = self.calibration.stored
        if (width, height) != (camera.width, camera.height):
            raise DatasetError(
                f"{path}: {kind} image is {width} x {height} pixels but width x height of the camera "
                f"({self.calibration.source}) is {camera.width} x {camera.height}; give the camera of these images in "
                "camera.yaml or as the camera argument"
            )


def check_partners(rgb_files: Sequence[Path], depth_files: Sequence[Path]) -> None:
    """Raise `DatasetError` if colour and depth files, sorted, do not carry the same frame numbers."""
    for rgb_file, depth_file in zip(rgb_files, depth_files, strict=False):
        if frame_number(rgb_file) != frame_number(depth_file):
            raise DatasetError(
                f"{rgb_file} has no depth image of the same number (next is {depth_file.name}); "
                "remove it or complete the download"
            )


def frame_number(path: Path) -> int | None:
    """First whole number in the file name, None if there is none."""
    match = re.search(r"\d+", path.name)
    return int(match.group()) if match else None


def _resize(rgb: np.ndarray, depth: np.ndarray, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    import cv2

    # Pixel u goes to u * width / W, as `Intrinsics.scaled` has it (cv2.resize would shift by a part of a pixel). Depth
    # takes the nearest pixel: a mean over an edge would lie in the air.
    sx, sy = width / rgb.shape[1], height / rgb.shape[0]
    matrix = np.array([[sx, 0.0, 0.0], [0.0, sy, 0.0]])
    rgb = cv2.warpAffine(rgb, matrix, (width, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    columns = np.minimum(np.rint(np.arange(width) / sx).astype(int), depth.shape[1] - 1)
    rows = np.minimum(np.rint(np.arange(height) / sy).astype(int), depth.shape[0] - 1)
    return rgb, depth[np.ix_(rows, columns)]
