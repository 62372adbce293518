"""Reading image files, with errors that name the file."""

from __future__ import annotations

import io
import re
import warnings
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

from warpslam.camera import MAX_IMAGE_SIZE
from warpslam.errors import DatasetError, MissingDependencyError, brief
from warpslam.reading import MEGABYTE, read_bytes

_FILE_LIMIT = 512 * MEGABYTE
_MAX_PIXELS = 1 << 26
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")


def natural_key(path: Path) -> list[tuple[int, str]]:
    """Sort key that orders names as people do: frame2 before frame10."""
    parts = re.split(r"(\d+)", path.name)
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]


def list_images(folder: Path, pattern: str = "*", suffixes: tuple[str, ...] = IMAGE_SUFFIXES) -> list[Path]:
    """Images of ``folder`` in natural order.

    Raises:
        DatasetError: If the folder is missing or holds no such image.
    """
    if not folder.is_dir():
        raise DatasetError(f"{folder}: no such folder; the sequence is incomplete or of another format")
    # Files that start with a dot are thumbnails and resource forks, not frames.
    files = [file for file in folder.glob(pattern) if file.suffix.lower() in suffixes and not file.name.startswith(".")]
    if not files:
        wanted = " or ".join(pattern + suffix if pattern.endswith("*") else pattern for suffix in suffixes)
        raise DatasetError(f"{folder}: no images ({wanted}); check that the download is complete and unpacked")
    return sorted(files, key=natural_key)


CheckSize = Callable[[Path, int, int], None]
"""Raises `DatasetError` if an image must not have that width and height; asked before it is decoded."""


def read_rgb(path: Path, check: CheckSize | None = None) -> np.ndarray:
    """Colour image, uint8, shape (H, W, 3), RGB order."""
    import cv2

    # Orientation tags would turn the image against its depth.
    image = _decode(path, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION, check)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def read_depth(path: Path, check: CheckSize | None = None) -> np.ndarray:
    """Stored depth values, uint16, shape (H, W)."""
    import cv2

    image = _decode(path, cv2.IMREAD_UNCHANGED, check)
    if image.ndim != 2 or image.dtype != np.uint16:
        channels = 1 if image.ndim == 2 else image.shape[2]
        raise DatasetError(
            f"{path}: depth image has {channels} channel(s) of {image.dtype}; store depth as a one-channel 16-bit PNG"
        )
    return image


def read_exr(path: Path, channel: str = "Y", check: CheckSize | None = None) -> np.ndarray:
    """One channel of an OpenEXR image, float32, shape (H, W).

    Raises:
        MissingDependencyError: If the package openexr is not installed.
        DatasetError: If the file can't be read or lacks the channel.
    """
    # The wheels of OpenCV are no longer built with OpenEXR.
    try:
        import OpenEXR  # type: ignore[import-not-found, unused-ignore]
    except ImportError as error:
        raise MissingDependencyError(
            f"{path}: reading EXR images needs the package openexr; type: pip install openexr"
        ) from error
    _read_bytes(path)
    try:
        low, high = OpenEXR.File(str(path), header_only=True).header()["dataWindow"]
        width, height = (int(last) - int(first) + 1 for first, last in zip(low, high, strict=True))
    except (RuntimeError, ValueError, TypeError, KeyError, OSError) as error:
        raise DatasetError(f"{path}: damaged EXR image ({brief(error)}); fetch the file again") from error
    _check_size(path, width, height, check)
    try:
        channels = OpenEXR.File(str(path), separate_channels=True).channels()
        pixels = {name: item.pixels for name, item in channels.items()}
    except (RuntimeError, ValueError, TypeError, OSError) as error:
        raise DatasetError(f"{path}: damaged EXR image ({brief(error)}); fetch the file again") from error
    if channel not in pixels or pixels[channel] is None:
        raise DatasetError(f"{path}: EXR image has no channel {channel} but {', '.join(sorted(pixels))}; is it depth?")
    return np.asarray(pixels[channel], dtype=np.float32)


def _read_bytes(path: Path) -> bytes:
    try:
        data = read_bytes(path, _FILE_LIMIT)
    except OSError as error:
        raise DatasetError(f"{path}: can't be read ({error.strerror}); check that the sequence is complete") from error
    if not data:
        raise DatasetError(f"{path}: empty file; fetch it again or remove the frame")
    return data


def _has_right_checksums(data: bytes) -> bool:
    """Whether every chunk of a PNG file has the checksum that stands behind it, up to the last one."""
    at = len(_PNG_SIGNATURE)
    while at + 12 <= len(data):
        end = at + 8 + int.from_bytes(data[at : at + 4], "big")
        if end + 4 > len(data) or zlib.crc32(data[at + 4 : end]) != int.from_bytes(data[end : end + 4], "big"):
            return False
        if data[at + 4 : at + 8] == b"IEND":
            return True
        at = end + 4
    return False


def _check_size(path: Path, width: int, height: int, check: CheckSize | None) -> None:
    if not (0 < width <= MAX_IMAGE_SIZE and 0 < height <= MAX_IMAGE_SIZE and width * height <= _MAX_PIXELS):
        raise DatasetError(f"{path}: image of {width} x {height} pixels; no camera of ours has so many")
    if check is not None:
        check(path, width, height)


def _size_in_header(data: bytes) -> tuple[int, int] | None:
    """Width and height that an image file says it has, without decoding it; None if it is none."""
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(io.BytesIO(data)) as image:
                return image.size
    except Image.DecompressionBombError:
        return MAX_IMAGE_SIZE + 1, MAX_IMAGE_SIZE + 1
    except Exception:  # of the decoders, each has its own
        return None


def _decode(path: Path, flags: int, check: CheckSize | None) -> np.ndarray:
    import cv2

    data = _read_bytes(path)
    # OpenCV returns many a cut-off or damaged file as an image with a grey, black or wrong rest.
    is_png = data.startswith(_PNG_SIGNATURE)
    is_cut_png = is_png and b"IEND" not in data[-64:]
    is_cut_jpeg = data.startswith(b"\xff\xd8") and b"\xff\xd9" not in data[-1024:]
    is_damaged = is_png and not _has_right_checksums(data)
    image = None
    size = None if is_cut_png or is_cut_jpeg or is_damaged else _size_in_header(data)
    if size is not None:
        _check_size(path, *size, check)
        try:
            image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags)
        except (cv2.error, MemoryError):
            image = None
    if image is None:
        state = "truncated" if is_cut_png or is_cut_jpeg else "damaged or not an"
        raise DatasetError(f"{path}: {state} image ({len(data)} bytes); fetch the file again or remove the frame")
    return image
