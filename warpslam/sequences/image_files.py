"""Reading image files, with errors that name the file."""

from __future__ import annotations

import io
import re
import warnings
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np

from warpslam.camera import MAX_IMAGE_SIZE
from warpslam.errors import DatasetError, MissingDependencyError, brief
from warpslam.reading import ARCHIVE_ERRORS, MEGABYTE, read_bytes
from warpslam.sequences.time_lists import unit_of

FILE_LIMIT = 512 * MEGABYTE
"""Size of an image file, packed or unpacked [bytes]: more is damage, or an attack."""

_MAX_PIXELS = 1 << 26
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
DEPTH_SUFFIXES = (".png", ".tif", ".tiff", ".exr", ".npy", ".npz")
_STRAY_SHARE = 0.25  # of the files: more of another pattern are no strays, the folder is only untidy


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
    there = [file for file in folder.glob(pattern) if not file.name.startswith(".")]
    files = [file for file in there if file.suffix.lower() in suffixes]
    if not files:
        named = (pattern + suffix if pattern.endswith("*") else pattern for suffix in suffixes)
        wanted = " or ".join(dict.fromkeys(named))
        others = sorted({file.suffix.lower() for file in there if file.suffix and file.is_file()})
        if others:
            raise DatasetError(
                f"{folder}: no images ({wanted}), but files of type {', '.join(others)}; convert them to one of these"
            )
        raise DatasetError(f"{folder}: no images ({wanted}); check that the download is complete and unpacked")
    return sorted(files, key=natural_key)


def image_times(files: list[Path]) -> np.ndarray | None:
    """Times [s] that names of files are, float64 (N,), in whatever unit makes them several a second; None where they
    are none.
    """
    try:
        times = np.array([float(file.stem) for file in files])
    except ValueError:
        return None
    if len(times) < 2 or not (np.diff(times) > 0).all():
        return None
    unit = unit_of(times)
    return None if unit.name == "frame numbers" else times * unit.seconds


def without_strays(files: list[Path]) -> tuple[list[Path], list[Path]]:
    """Frames, and files that are none: the few whose names, digits aside, are not like those of nearly all others."""
    patterns = Counter(re.sub(r"\d+", "#", file.stem) for file in files)
    usual, count = patterns.most_common(1)[0]
    if count < 3 or len(files) - count > _STRAY_SHARE * len(files):
        return files, []
    frames = [file for file in files if re.sub(r"\d+", "#", file.stem) == usual]
    return frames, [file for file in files if file not in set(frames)]


CheckSize = Callable[[str | Path, int, int], None]
"""Raises `DatasetError` if an image must not have that width and height; asked before it is decoded."""


def read_rgb(path: Path, check: CheckSize | None = None) -> np.ndarray:
    """Colour image, uint8, shape (H, W, 3), RGB order."""
    import cv2

    # Orientation tags would turn the image against its depth.
    image = _decode(path, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION, check)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def read_grey(path: Path, check: CheckSize | None = None) -> np.ndarray:
    """One-channel image of 8 bits, uint8, shape (H, W), such as a mask."""
    import cv2

    image = _decode(path, cv2.IMREAD_UNCHANGED, check)
    if image.ndim != 2:
        raise DatasetError(f"{path}: has {image.shape[2]} channels, expected one; write it as a grey image")
    return image.astype(np.uint8)


def read_depth(path: Path, check: CheckSize | None = None) -> np.ndarray:
    """Stored depth values, uint16 or float32, shape (H, W): a PNG or TIFF image, EXR (channel Y, Z, R or the only one),
    or an array of NumPy.

    Raises:
        MissingDependencyError: EXR needs the package openexr.
        DatasetError: The file can't be read, or is no depth image.
    """
    import cv2

    suffix = path.suffix.lower()
    if suffix == ".exr":
        return read_exr(path, ("Y", "Z", "R", "V", "D"), check)
    image = _read_array(path) if suffix in (".npy", ".npz") else _decode(path, cv2.IMREAD_UNCHANGED, check)
    if image.ndim == 3 and 1 in (image.shape[0], image.shape[2]):
        image = image.squeeze(0 if image.shape[0] == 1 else 2)
    is_number = image.dtype == np.uint16 or (image.dtype.kind == "f" and image.dtype.itemsize <= 8)
    if suffix in (".npy", ".npz") and image.dtype.kind in "iu":
        image, is_number = image.astype(np.float32), True
    if image.ndim != 2 or not is_number or not image.size:
        channels = 1 if image.ndim == 2 else image.shape[-1] if image.ndim else 0
        raise DatasetError(
            f"{path}: depth image has {channels} channel(s) of {image.dtype}; store depth as a one-channel 16-bit PNG, "
            "or as 32-bit float metres in a TIFF, EXR or NumPy file"
        )
    return image if image.dtype == np.uint16 else image.astype(np.float32)


def _read_array(path: Path) -> np.ndarray:
    """The array of a .npy file, or of a .npz file the one called depth, or its only one."""
    data = _read_bytes(path)
    try:
        _check_unpacked(path, data)
        loaded = np.load(io.BytesIO(data), allow_pickle=False)
        if isinstance(loaded, np.ndarray):
            return loaded
        names = [name for name in loaded.files if "depth" in name.lower()] or loaded.files
        if len(names) != 1:
            raise DatasetError(
                f"{path}: holds {len(names)} arrays ({brief(', '.join(names))}); keep one, or call it depth"
            )
        return loaded[names[0]]
    except ARCHIVE_ERRORS as error:
        raise DatasetError(f"{path}: damaged or not a NumPy file ({brief(error)}); fetch the file again") from error


def _check_unpacked(path: Path, data: bytes) -> None:
    """A few bytes of an archive may unfold into as many as one likes."""
    if zipfile.is_zipfile(io.BytesIO(data)):
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            size = sum(member.file_size for member in archive.infolist())
        if size > FILE_LIMIT:
            raise DatasetError(f"{path}: holds {size / MEGABYTE:.0f} MB, expected at most {FILE_LIMIT // MEGABYTE}")


def read_exr(path: Path, names: tuple[str, ...] = ("Y",), check: CheckSize | None = None) -> np.ndarray:
    """One channel of an OpenEXR image, float32, shape (H, W): the first of ``names`` that it has.

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
    check_image_size(path, width, height, check)
    try:
        channels = OpenEXR.File(str(path), separate_channels=True).channels()
        pixels = {name: item.pixels for name, item in channels.items()}
    except (RuntimeError, ValueError, TypeError, OSError) as error:
        raise DatasetError(f"{path}: damaged EXR image ({brief(error)}); fetch the file again") from error
    for name in names:
        if pixels.get(name) is not None:
            return np.asarray(pixels[name], dtype=np.float32)
    wanted = " or ".join(names)
    raise DatasetError(
        f"{path}: EXR image has no channel {wanted} but {brief(', '.join(sorted(pixels)))}; is it depth?"
    )


def _read_bytes(path: Path) -> bytes:
    try:
        data = read_bytes(path, FILE_LIMIT)
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


def check_image_size(label: str | Path, width: int, height: int, check: CheckSize | None = None) -> None:
    """Raise `DatasetError` if an image is larger than any camera's, or than it may be."""
    if not (0 < width <= MAX_IMAGE_SIZE and 0 < height <= MAX_IMAGE_SIZE and width * height <= _MAX_PIXELS):
        raise DatasetError(f"{label}: image of {width} x {height} pixels; no camera of ours has so many")
    if check is not None:
        check(label, width, height)


def _size_in_header(data: bytes) -> tuple[int, int] | None:
    """Width and height that an image file says it has, without decoding it; None if it is none."""
    from PIL import Image, TiffImagePlugin

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if data.startswith((b"II*\0", b"MM\0*")):  # PIL opens only some kinds of pixels, OpenCV more
                tags = TiffImagePlugin.ImageFileDirectory_v2(data[:8])
                file = io.BytesIO(data)
                file.seek(tags.next)
                tags.load(file)
                return int(tags[TiffImagePlugin.IMAGEWIDTH]), int(tags[TiffImagePlugin.IMAGELENGTH])
            with Image.open(io.BytesIO(data)) as image:
                return image.size
    except Image.DecompressionBombError:
        return MAX_IMAGE_SIZE + 1, MAX_IMAGE_SIZE + 1
    except Exception:  # of the decoders, each has its own
        return None


def decode_image(data: bytes, flags: int, label: str | Path, check: CheckSize | None = None) -> np.ndarray | None:
    """Image in the bytes of a file, decoded by OpenCV once its size is known to be right; None if it is none.

    Raises:
        DatasetError: It is larger than any camera's, or ``check`` raises it.
    """
    import cv2

    size = _size_in_header(data)
    if size is None:
        return None
    check_image_size(label, *size, check)
    try:
        return cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags)
    except (cv2.error, MemoryError):
        return None


def _decode(path: Path, flags: int, check: CheckSize | None) -> np.ndarray:
    data = _read_bytes(path)
    # OpenCV returns many a cut-off or damaged file as an image with a grey, black or wrong rest.
    is_png = data.startswith(_PNG_SIGNATURE)
    is_cut_png = is_png and b"IEND" not in data[-64:]
    is_cut_jpeg = data.startswith(b"\xff\xd8") and b"\xff\xd9" not in data[-1024:]
    is_damaged = is_png and not _has_right_checksums(data)
    image = None
    if not (is_cut_png or is_cut_jpeg or is_damaged):
        image = decode_image(data, flags, path, check)
    if image is None:
        state = "truncated" if is_cut_png or is_cut_jpeg else "damaged or not an"
        raise DatasetError(f"{path}: {state} image ({len(data)} bytes); fetch the file again or remove the frame")
    return image
