"""What nearly all readers share: a colour and a depth image a frame, brought into one camera."""

from __future__ import annotations

import copy
import operator
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Self

import numpy as np

from warpslam.camera import Intrinsics, SensorTiming
from warpslam.errors import DatasetError
from warpslam.sequences.base import Frame, Remark, RgbdSequence
from warpslam.sequences.calibration import Calibration
from warpslam.sequences.placeholders import without_placeholders
from warpslam.sequences.pose_convention import CONVENTIONS, agreement, posed_pairs
from warpslam.sequences.registration import axis_depth, color_at_depth, register_depth

FRAME_RATE = 30.0
_FIRST_FRAMES = 10
_CLEARLY = 0.1  # more of the depth agrees with another convention
_SAME_SHAPE = 0.02  # difference of width over height up to which two images can have the same field of view


class ImageSequence(RgbdSequence):
    """Images of any source. Colour is undistorted, both are brought into one camera, resized and cropped.

    Where colour has another size than depth and its camera is not known, both are taken to have the same field of view.

    Args:
        name: Of the sequence.
        calibration: Camera of the stored images.
        count: Frames.
        poses: Camera-to-world transforms, OpenCV axes, shape (N, 4, 4), NaN where unknown, or None.
        timestamps: Times [s], shape (N,); index / 30 if None.
        depth_timestamps: Times of the depth images [s], shape (N,), where they have their own.
        remarks: What was noticed in making the list of frames.
        same_view: Colour and depth are known to have the same field of view, whatever their sizes.
        conventions: Of `pose_convention.CONVENTIONS`, what poses may be stored as, most likely first; the one that
            depth agrees with is taken. None: they are as said above.

    Raises:
        DatasetError: There are no frames, or none of the first can be read and fits the camera.
    """

    def __init__(
        self,
        name: str,
        calibration: Calibration,
        count: int,
        *,
        poses: np.ndarray | None = None,
        timestamps: np.ndarray | None = None,
        depth_timestamps: np.ndarray | None = None,
        remarks: Sequence[Remark] = (),
        same_view: bool = False,
        conventions: Sequence[str] = (),
    ) -> None:
        if not count:
            raise DatasetError(f"{name}: no frames; check that the download is complete and unpacked")
        if poses is not None and len(poses) != count:
            raise DatasetError(
                f"{name}: {len(poses)} poses but {count} frames; "
                "use the pose file that belongs to these images, or remove it to run without ground truth"
            )
        self.name = name
        self.timestamps = np.arange(count) / FRAME_RATE if timestamps is None else timestamps
        self.depth_timestamps = depth_timestamps
        self._poses = None if poses is None or np.isnan(poses).all() else poses
        self.remarks = tuple(remarks)
        self._set_calibration(calibration)
        self._sizes_are_known = False
        self._fit_calibration(same_view)
        if self._poses is not None:
            self._poses, found = without_placeholders(self._poses, self._stored_rgb)
            self.remarks += found
        if self._poses is not None and conventions:
            self._choose_convention(conventions)

    def _choose_convention(self, conventions: Sequence[str]) -> None:
        """Versions of one program differ in the axes of their poses; depth tells."""
        assert self._poses is not None
        pairs = posed_pairs(self, self._poses)
        scores = [agreement(pairs, self.intrinsics, name) for name in conventions] if pairs else [1.0]
        best = int(np.argmax(scores)) if max(scores) > scores[0] + _CLEARLY else 0
        name = conventions[best]
        known = np.isfinite(self._poses).all(axis=(1, 2))
        self._poses[known] = [CONVENTIONS[name](T) for T in self._poses[known]]
        by = f"as {scores[best]:.0%} of the depth confirms" if pairs else "which is this format's usual way"
        self.remarks += (Remark("poses", f"taken as {name}, {by}", is_fine=True),)

    @abstractmethod
    def _stored_rgb(self, index: int) -> np.ndarray:
        """Colour image as stored, uint8 (H, W, 3), RGB order."""

    @abstractmethod
    def _stored_depth(self, index: int) -> np.ndarray:
        """Depth image as stored, in metres, float32 (H', W'), 0 = missing."""

    @abstractmethod
    def labels(self, index: int) -> tuple[str, str]:
        """What the colour and the depth image of a frame are called in messages."""

    def as_published(self) -> Self:
        """The sequence with frames resized and cropped as the paper's code does it, depth left as it is stored."""
        published = copy.copy(self)
        published._set_calibration(self.calibration.as_published())
        return published

    def stored_timing(self, timing: SensorTiming) -> SensorTiming:
        """See `RgbdSequence.stored_timing`: rows that are cut off take their time, too."""
        return self.calibration.timing_as_stored(timing)

    def __len__(self) -> int:
        return len(self.timestamps)

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

    def metres(self, stored: np.ndarray) -> np.ndarray:
        """Depth in metres, float32, from stored units; 0 for all that is no measurement."""
        depth = stored.astype(np.float32) / np.float32(self.calibration.depth_scale)
        if stored.dtype.kind == "f":
            with np.errstate(invalid="ignore"):
                depth = np.where((depth > 0) & np.isfinite(depth), depth, np.float32(0))
        return depth

    def _set_calibration(self, calibration: Calibration) -> None:
        self.__dict__.pop("_undistortion", None)
        self.calibration = calibration
        self.intrinsics, self.timing = calibration.intrinsics, calibration.timing

    def _fit_calibration(self, same_view: bool) -> None:
        """A camera that does not fit the images is found now rather than after a run has begun; but a single bad frame
        is none the worse for being the first.
        """
        first_error = None
        for index in range(min(len(self), _FIRST_FRAMES)):
            try:
                rgb, depth = self._stored_images(index)
                self._fit_sizes(index, rgb, depth, same_view)
                self._load(index)
                self._sizes_are_known = True
                return
            except DatasetError as error:
                first_error = first_error or error
        if first_error is not None:
            raise first_error

    def _fit_sizes(self, index: int, rgb: np.ndarray, depth: np.ndarray, same_view: bool) -> None:
        """A camera of the colour images is brought to the size of depth; that sizes differ is said."""
        camera, (height, width) = self.calibration.stored, depth.shape
        color_height, color_width = rgb.shape[:2]
        if self.calibration.color is not None or (height, width) == (color_height, color_width):
            return
        sizes = f"colour is {color_width} x {color_height}, depth {width} x {height}"
        alike = abs(color_width / color_height / (width / height) - 1) < _SAME_SHAPE
        remedy = "if they are two cameras, give both: color and T_color_depth in camera.yaml (datasets/README.md)"
        if (camera.width, camera.height) == (color_width, color_height):
            scaled = replace(self.calibration, stored=camera.scaled(width, height))
            self._set_calibration(scaled)
        if alike and same_view:
            return
        text = f"{sizes}: colour is brought to the size of depth, as if both had the same field of view"
        if not alike:
            text += ", which their shapes contradict"
        self.remarks += (Remark("image sizes", text, remedy, is_fine=alike),)

    def _stored_images(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Colour and depth as stored."""
        try:
            return self._stored_rgb(index), self._stored_depth(index)
        except OSError as error:
            raise DatasetError(f"{error.filename or self.name}: can't be read ({error.strerror or error})") from error
        except MemoryError:
            raise DatasetError(f"frame {index} of {self.name} does not fit into memory; close other programs") from None

    def _load(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        rgb, depth = self._stored_images(index)
        calibration = self.calibration
        rgb_label, depth_label = self.labels(index)
        self._check_size(depth_label, "depth", _size(depth), calibration.stored)
        if calibration.along_ray:
            depth = axis_depth(depth, calibration.stored)
        if calibration.color is not None:
            self._check_size(rgb_label, "colour", _size(rgb), calibration.color.intrinsics)
            rgb, depth = self._register(rgb, depth)
        elif rgb.shape[:2] != depth.shape:
            import cv2

            rgb = cv2.resize(rgb, (depth.shape[1], depth.shape[0]), interpolation=cv2.INTER_LINEAR)
        if calibration.distortion:
            import cv2

            rgb = cv2.remap(rgb, *self._undistortion, interpolation=cv2.INTER_LINEAR)
            if calibration.depth_distorted:
                depth = cv2.remap(depth, *self._undistortion, interpolation=cv2.INTER_NEAREST)
        if calibration.resize is not None:
            rgb, depth = _resize(rgb, depth, *calibration.resize)
        border = calibration.crop
        if border:
            rgb, depth = (np.ascontiguousarray(image[border:-border, border:-border]) for image in (rgb, depth))
        return rgb, depth

    def _register(self, rgb: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Colour and depth of two cameras in the one of `Calibration.registered`."""
        import cv2

        color, target = self.calibration.color, self.calibration.registered
        assert color is not None
        if color.distortion:
            rgb = cv2.remap(rgb, *self._undistortion, interpolation=cv2.INTER_LINEAR)
        if color.shares_centre:
            rgb, seen = color_at_depth(rgb, color.intrinsics, target)
            return rgb, np.where(seen, depth, np.float32(0))
        depth = register_depth(depth, self.calibration.stored, target, color.transform)
        if (target.width, target.height) != (rgb.shape[1], rgb.shape[0]):
            sx, sy = target.width / rgb.shape[1], target.height / rgb.shape[0]
            matrix = np.array([[sx, 0.0, 0.0], [0.0, sy, 0.0]])
            size = (target.width, target.height)
            rgb = cv2.warpAffine(rgb, matrix, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return rgb, depth

    @cached_property
    def _undistortion(self) -> tuple[np.ndarray, np.ndarray]:
        import cv2

        color = self.calibration.color
        camera = self.calibration.stored if color is None else color.intrinsics
        coefficients = np.array(self.calibration.distortion if color is None else color.distortion)
        size = (camera.width, camera.height)
        return cv2.initUndistortRectifyMap(camera.matrix, coefficients, None, camera.matrix, size, cv2.CV_32FC1)

    def _check_depth_size(self, label: str | Path, width: int, height: int) -> None:
        """For a reader to ask before it decodes; the first frames tell how large images are."""
        if self._sizes_are_known:
            self._check_size(label, "depth", (width, height), self.calibration.stored)

    def _check_color_size(self, label: str | Path, width: int, height: int) -> None:
        if self._sizes_are_known and self.calibration.color is not None:
            self._check_size(label, "colour", (width, height), self.calibration.color.intrinsics)

    def _check_size(self, label: str | Path, kind: str, size: tuple[int, int], camera: Intrinsics) -> None:
        wanted = (camera.width, camera.height)
        if size != wanted:
            raise DatasetError(
                f"{label}: {kind} image is {size[0]} x {size[1]} pixels but width x height of the camera "
                f"({self.calibration.source}) is {wanted[0]} x {wanted[1]}; give the camera of these images in "
                "camera.yaml or as the camera argument"
            )


def _size(image: np.ndarray) -> tuple[int, int]:
    return image.shape[1], image.shape[0]


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
