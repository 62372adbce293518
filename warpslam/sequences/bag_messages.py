"""Messages of ROS: images raw and compressed, cameras, stamps and transforms, as arrays."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np

from warpslam.camera import Intrinsics
from warpslam.errors import DatasetError
from warpslam.poses import pose_from_vector
from warpslam.sequences.image_files import CheckSize, decode_image

_INVERSE_HEADER = 12  # bytes before the image of a compressedDepth message
_BAYER = {"rggb": "BAYER_BG2RGB", "bggr": "BAYER_RG2RGB", "gbrg": "BAYER_GR2RGB", "grbg": "BAYER_GB2RGB"}


def stamp_of(data: bytes, is_ros2: bool) -> float:
    """Time [s] in the header that a message (serialised) starts with."""
    offset = 4  # ROS 1: the sequence number; ROS 2: how the message is encoded
    little = not is_ros2 or data[1] & 1
    seconds, nanoseconds = struct.unpack_from("<II" if little else ">II", data, offset)
    return float(seconds) + 1e-9 * nanoseconds


def color_image(message: Any, where: str, check: CheckSize | None = None) -> np.ndarray:
    """Colour of an Image or CompressedImage, uint8 (H, W, 3), RGB order.

    Raises:
        DatasetError: The encoding is another one, or the image is damaged.
    """
    import cv2

    if not hasattr(message, "encoding"):
        flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
        image = decode_image(bytes(message.data), flags, where, check)
        if image is None:
            raise DatasetError(f"{where}: damaged image ({message.format})")
        return np.ascontiguousarray(image[..., ::-1])
    encoding = message.encoding.lower()
    channels = {"rgb8": 3, "bgr8": 3, "8uc3": 3, "rgba8": 4, "bgra8": 4, "mono8": 1, "8uc1": 1}.get(encoding)
    if channels is not None:
        image = _pixels(message, np.dtype(np.uint8), channels, where)
        image = np.repeat(image, 3, axis=2) if channels == 1 else image[..., :3]
        return np.ascontiguousarray(image[..., ::-1] if encoding.startswith(("bgr", "8uc3")) else image)
    if encoding.startswith("bayer_") and encoding.endswith("8") and encoding[6:10] in _BAYER:
        image = _pixels(message, np.dtype(np.uint8), 1, where)[..., 0]
        return cv2.cvtColor(np.ascontiguousarray(image), getattr(cv2, f"COLOR_{_BAYER[encoding[6:10]]}"))
    if encoding in ("yuv422", "uyvy", "yuv422_yuy2", "yuyv"):
        code = cv2.COLOR_YUV2RGB_UYVY if encoding in ("yuv422", "uyvy") else cv2.COLOR_YUV2RGB_YUY2
        return cv2.cvtColor(np.ascontiguousarray(_pixels(message, np.dtype(np.uint8), 2, where)), code)
    raise DatasetError(f"{where}: encoding {message.encoding} is no colour that is read; record rgb8 or JPEG")


def depth_image(message: Any, where: str, check: CheckSize | None = None) -> np.ndarray:
    """Depth as stored, uint16 or float32 (H, W); float depth is in metres.

    Raises:
        DatasetError: The encoding is another one, or the image is damaged.
    """
    if not hasattr(message, "encoding"):
        return _compressed_depth(message, where, check)
    encoding = message.encoding.lower()
    if encoding in ("16uc1", "mono16", "z16"):
        return _pixels(message, np.dtype(np.uint16), 1, where)[..., 0]
    if encoding == "32fc1":
        return _pixels(message, np.dtype(np.float32), 1, where)[..., 0]
    raise DatasetError(f"{where}: encoding {message.encoding} is no depth; record 16UC1 or 32FC1")


def camera_of(message: Any, is_rectified: bool) -> tuple[Intrinsics, tuple[float, ...]]:
    """Intrinsics and distortion (empty = none) of a CameraInfo; those after rectification for rectified images."""
    distortion = tuple(float(value) for value in getattr(message, "d", getattr(message, "D", ())))
    k = np.asarray(getattr(message, "k", getattr(message, "K", None)), dtype=np.float64).reshape(3, 3)
    p = np.asarray(getattr(message, "p", getattr(message, "P", np.zeros(12))), dtype=np.float64).reshape(3, 4)
    if is_rectified and p[0, 0] > 0:
        k, distortion = p[:, :3], ()
    camera = Intrinsics(k[0, 0], k[1, 1], k[0, 2], k[1, 2], int(message.width), int(message.height))
    is_pinhole = str(message.distortion_model).lower() in ("plumb_bob", "rational_polynomial", "brown-conrady", "")
    return camera, distortion if any(distortion) and is_pinhole else ()


def transform_of(message: Any) -> np.ndarray:
    """Matrix (4, 4) of a Transform, or of a Pose."""
    t = getattr(message, "translation", None)
    t, q = (message.position, message.orientation) if t is None else (t, message.rotation)
    return pose_from_vector(np.array([q.w, q.x, q.y, q.z, t.x, t.y, t.z]))


def _pixels(message: Any, dtype: np.dtype, channels: int, where: str) -> np.ndarray:
    """Pixels (H, W, channels) of an Image whose rows may be longer than they need be."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    row = width * channels * dtype.itemsize
    data = np.frombuffer(bytes(message.data), np.uint8)
    step = step or row
    if step < row or len(data) < step * height or not height * width:
        raise DatasetError(f"{where}: image of {width} x {height} has {len(data)} bytes, too few; it is cut off")
    rows = np.ascontiguousarray(data[: step * height].reshape(height, step)[:, :row])
    image = rows.view(dtype.newbyteorder(">" if message.is_bigendian else "<")).astype(dtype)
    return image.reshape(height, width, channels)


def _compressed_depth(message: Any, where: str, check: CheckSize | None) -> np.ndarray:
    """Depth of image_transport's compressedDepth: a PNG of millimetres, or of inverse metres with two parameters."""
    import cv2

    data = bytes(message.data)
    image = decode_image(data[_INVERSE_HEADER:], cv2.IMREAD_UNCHANGED, where, check)
    image = decode_image(data, cv2.IMREAD_UNCHANGED, where, check) if image is None else image
    if image is None or image.ndim != 2 or image.dtype != np.uint16:
        raise DatasetError(
            f"{where}: no depth image of 16 bits ({message.format}); record the raw depth or compressedDepth"
        )
    if "32fc1" not in message.format.lower():
        return image
    a, b = struct.unpack_from("<ff", data, 4)
    depth = np.zeros(image.shape, np.float32)
    measured = image > 0
    depth[measured] = a / (image[measured].astype(np.float32) - b)
    return depth
