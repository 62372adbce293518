"""ScanNet's .sens: colour, depth, cameras and poses in one file."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from warpslam.errors import DatasetError, InputError, brief
from warpslam.poses import check_transform
from warpslam.reading import check_regular
from warpslam.sequences.calibration import Calibration, find_calibration
from warpslam.sequences.files import typed_name
from warpslam.sequences.image_files import decode_image
from warpslam.sequences.images import ImageSequence
from warpslam.sequences.recorder_files import from_matrix
from warpslam.sequences.registration import ColorCamera

_VERSION = 4
_DEPTH_KINDS = {0: "raw", 1: "zlib", 2: "occipital"}
_COLOR_KINDS = {0: "raw", 1: "png", 2: "jpeg"}
_FRAME = struct.Struct("<16f4Q")
_MICROSECONDS = 1e-6
_LARGEST_IMAGE = 1 << 28  # [bytes]: more is damage


@dataclass(frozen=True)
class _Stored:
    """Where the images of a frame lie in the file."""

    pose: np.ndarray
    color_time: int
    depth_time: int
    at: int
    color_bytes: int
    depth_bytes: int


class SensSequence(ImageSequence):
    """A .sens file of ScanNet or BundleFusion; poses of -inf are unknown."""

    preset = "scannet"

    def __init__(self, path: Path, camera: str | None = None) -> None:
        self.path = path
        try:
            check_regular(path)
            with path.open("rb") as file:
                calibration = self._read_header(file)
                self._frames = self._read_frames(file)
        except OSError as error:
            raise DatasetError(f"{path}: can't be read ({error.strerror}); fetch the file again") from error
        except (struct.error, UnicodeDecodeError, ValueError) as error:
            raise DatasetError(
                f"{path}: can't be read as .sens of version {_VERSION} ({error}); fetch it again"
            ) from error
        color, depth = (
            np.array([getattr(f, name) for f in self._frames], float) for name in ("color_time", "depth_time")
        )
        has_times = len(color) > 1 and bool((np.diff(color) > 0).all())
        super().__init__(
            typed_name(path),
            find_calibration(path, camera, None) if camera else calibration,
            len(self._frames),
            poses=np.array([self._pose(i) for i in range(len(self._frames))]).reshape(-1, 4, 4),
            timestamps=color * _MICROSECONDS if has_times else None,
            depth_timestamps=depth * _MICROSECONDS if has_times and depth.any() else None,
            same_view=True,
        )

    def labels(self, index: int) -> tuple[str, str]:
        """File and frame number."""
        return f"{self.path}: colour of frame {index}", f"{self.path}: depth of frame {index}"

    def _stored_rgb(self, index: int) -> np.ndarray:
        import cv2

        frame = self._frames[index]
        data = self._bytes(frame.at, frame.color_bytes)
        width, height = self._color_size
        if self._color_kind == "raw":
            if len(data) != width * height * 3:
                raise DatasetError(f"{self.labels(index)[0]} has {len(data)} bytes, expected {width * height * 3}")
            return np.frombuffer(data, np.uint8).reshape(height, width, 3).copy()
        image = decode_image(data, cv2.IMREAD_COLOR, self.labels(index)[0], self._check_color_size)
        if image is None:
            raise DatasetError(f"{self.labels(index)[0]} is damaged; fetch the file again")
        return np.ascontiguousarray(image[..., ::-1])

    def _stored_depth(self, index: int) -> np.ndarray:
        frame = self._frames[index]
        data = self._bytes(frame.at + frame.color_bytes, frame.depth_bytes)
        width, height = self._depth_size
        try:
            if self._depth_kind == "zlib":  # no more than it should be: a few bytes may unfold into gigabytes
                data = zlib.decompressobj().decompress(data, 2 * width * height + 1)
            return self.metres(np.frombuffer(data, "<u2").reshape(height, width))
        except (zlib.error, ValueError) as error:
            raise DatasetError(f"{self.labels(index)[1]} is damaged ({brief(error)}); fetch the file again") from error

    def _bytes(self, at: int, count: int) -> bytes:
        with self.path.open("rb") as file:
            file.seek(at)
            data = file.read(count)
        if len(data) != count:
            raise DatasetError(f"{self.path}: ends before its frames do; fetch the file again")
        return data

    def _read_header(self, file: BinaryIO) -> Calibration:
        (version, length) = _read(file, "<IQ")
        if version != _VERSION or length > 1 << 16:
            raise ValueError(f"version {version}")
        _exactly(file, length)  # name of the sensor
        color_K, _, depth_K, _ = (np.array(_read(file, "<16f"), float).reshape(4, 4) for _ in range(4))
        color_kind, depth_kind, *sizes = _read(file, "<ii4I")
        shift, self._count = _read(file, "<fQ")
        if color_kind not in _COLOR_KINDS or depth_kind not in _DEPTH_KINDS or depth_kind == 2:
            raise DatasetError(
                f"{self.path}: compression {color_kind}, {depth_kind} is not read; export it with SensReader"
            )
        self._color_kind, self._depth_kind = _COLOR_KINDS[color_kind], _DEPTH_KINDS[depth_kind]
        self._color_size, self._depth_size = (sizes[0], sizes[1]), (sizes[2], sizes[3])
        # As with the exported files: registration leaves a border without colour or depth.
        crop = Calibration.of_dataset("scannet").crop * sizes[2] // 640
        calibration = from_matrix(depth_K[:3, :3], self._depth_size, f"header of {self.path}", shift, crop=crop)
        if self._color_size == self._depth_size:
            return calibration
        color = from_matrix(color_K[:3, :3], self._color_size, f"header of {self.path}")
        return replace(calibration, color=ColorCamera(color.stored))

    def _read_frames(self, file: BinaryIO) -> list[_Stored]:
        frames: list[_Stored] = []
        for _ in range(self._count):
            head = file.read(_FRAME.size)
            if len(head) < _FRAME.size:  # a download that stopped: the frames that are there can be used
                break
            *pose, color_time, depth_time, color_bytes, depth_bytes = _FRAME.unpack(head)
            if max(color_bytes, depth_bytes) > _LARGEST_IMAGE:
                raise ValueError(f"frame {len(frames)} of {color_bytes + depth_bytes} bytes")
            T = np.array(pose, dtype=np.float64).reshape(4, 4)
            frames.append(_Stored(T, color_time, depth_time, file.tell(), color_bytes, depth_bytes))
            file.seek(color_bytes + depth_bytes, 1)
        return frames

    def _pose(self, index: int) -> np.ndarray:
        pose = self._frames[index].pose
        try:
            return check_transform(pose, "camera_to_world") if np.isfinite(pose).all() else np.full((4, 4), np.nan)
        except InputError as error:
            raise DatasetError(f"{self.path}: frame {index}: {error}; fetch the file again") from error


def _exactly(file: BinaryIO, count: int) -> bytes:
    data = file.read(count)
    if len(data) != count:
        raise ValueError("it is cut off")
    return data


def _read(file: BinaryIO, layout: str) -> tuple[Any, ...]:
    return struct.unpack(layout, _exactly(file, struct.calcsize(layout)))
