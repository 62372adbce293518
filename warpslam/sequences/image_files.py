"""Reading image files, with errors that name the file."""

from __future__ import annotations

import re
import zipfile
import zlib
from collections import Counter
from pathlib import Path

import numpy as np

from warpslam.errors import DatasetError, MissingDependencyError
from warpslam.sequences.time_lists import unit_of

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


def read_rgb(path: Path) -> np.ndarray:
    """Colour image, uint8, shape (H, W, 3), RGB order."""
    import cv2

    # Orientation tags would turn the image against its depth.
    image = _decode(path, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def read_grey(path: Path) -> np.ndarray:
    """One-channel image of 8 bits, uint8, shape (H, W), such as a mask."""
    import cv2

    image = _decode(path, cv2.IMREAD_UNCHANGED)
    if image.ndim != 2:
        raise DatasetError(f"{path}: has {image.shape[2]} channels, expected one; write it as a grey image")
    return image.astype(np.uint8)


def read_depth(path: Path) -> np.ndarray:
    """Stored depth values, uint16 or float32, shape (H, W): a PNG or TIFF image, EXR (channel Y, Z, R or the only one),
    or an array of NumPy.

    Raises:
        MissingDependencyError: EXR needs the package openexr.
        DatasetError: The file can't be read, or is no depth image.
    """
    import cv2

    suffix = path.suffix.lower()
    if suffix == ".exr":
        return read_exr(path, ("Y", "Z", "R", "V", "D"))
    image = _read_array(path) if suffix in (".npy", ".npz") else _decode(path, cv2.IMREAD_UNCHANGED)
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
    import io

    data = _read_bytes(path)
    try:
        loaded = np.load(io.BytesIO(data), allow_pickle=False)
        if isinstance(loaded, np.ndarray):
            return loaded
        names = [name for name in loaded.files if "depth" in name.lower()] or loaded.files
        if len(names) != 1:
            raise DatasetError(f"{path}: holds {len(names)} arrays ({', '.join(names)}); keep one, or call it depth")
        return loaded[names[0]]
    except (ValueError, OSError, EOFError, KeyError, zipfile.BadZipFile, zlib.error, SyntaxError, MemoryError) as error:
        raise DatasetError(f"{path}: damaged or not a NumPy file ({error}); fetch the file again") from error


def read_exr(path: Path, names: tuple[str, ...] = ("Y",)) -> np.ndarray:
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
        channels = OpenEXR.File(str(path), separate_channels=True).channels()
        pixels = {name: item.pixels for name, item in channels.items()}
    except (RuntimeError, ValueError, TypeError, OSError) as error:
        raise DatasetError(f"{path}: damaged EXR image ({error}); fetch the file again") from error
    for name in names:
        if pixels.get(name) is not None:
            return np.asarray(pixels[name], dtype=np.float32)
    wanted = " or ".join(names)
    raise DatasetError(f"{path}: EXR image has no channel {wanted} but {', '.join(sorted(pixels))}; is it depth?")


def _read_bytes(path: Path) -> bytes:
    try:
        data = path.read_bytes()
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


def _decode(path: Path, flags: int) -> np.ndarray:
    import cv2

    data = _read_bytes(path)
    # OpenCV returns many a cut-off or damaged file as an image with a grey, black or wrong rest.
    is_png = data.startswith(_PNG_SIGNATURE)
    is_cut_png = is_png and b"IEND" not in data[-64:]
    is_cut_jpeg = data.startswith(b"\xff\xd8") and b"\xff\xd9" not in data[-1024:]
    is_damaged = is_png and not _has_right_checksums(data)
    image = None
    if not (is_cut_png or is_cut_jpeg or is_damaged):
        try:
            image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags)
        except cv2.error:
            image = None
    if image is None:
        state = "truncated" if is_cut_png or is_cut_jpeg else "damaged or not an"
        raise DatasetError(f"{path}: {state} image ({len(data)} bytes); fetch the file again or remove the frame")
    return image
