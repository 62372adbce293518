"""Lists of images by time, as TUM has them, and the clock that wrote them."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from warpslam.errors import DatasetError
from warpslam.reading import TEXT_LIMIT, read_bytes
from warpslam.sequences.base import Remark
from warpslam.storage.tum import nearest

_NAMED = 3
_FRAME_RATE = 30.0
_DECIMAL_COMMA = re.compile(r"(\d+),(\d+)\s")


@dataclass(frozen=True)
class ImageList:
    """Images by time."""

    path: Path
    """The file that lists them."""
    times: np.ndarray
    """In the units of the file, float64 (N,), ascending."""
    files: list[Path]
    """As many."""

    def present(self, remarks: list[Remark]) -> ImageList:
        """Without the images that are not there, which are added to the remarks.

        Raises:
            DatasetError: None is there.
        """
        missing = [file for file in self.files if not file.is_file()]
        if not missing:
            return self
        if len(missing) == len(self.files):
            raise DatasetError(f"{missing[0]}: listed in {self.path.name} but missing; complete the download")
        named = ", ".join(str(file) for file in missing[:_NAMED]) + (", ..." if len(missing) > _NAMED else "")
        text = f"{len(missing)} of {len(self.files)} images listed in {self.path.name} are missing: {named}"
        remarks.append(Remark("files", text, "complete the download; their frames are left out"))
        there = [i for i, file in enumerate(self.files) if file not in set(missing)]
        return ImageList(self.path, self.times[there], [self.files[i] for i in there])


@dataclass(frozen=True)
class Unit:
    """What the numbers of a clock stand for."""

    name: str
    seconds: float

    def remarks(self, path: Path, times: np.ndarray) -> Iterator[Remark]:
        """What is to be said of it."""
        if self.name == "frame numbers":
            text = f"{path.name} counts frames: they are taken to be {_FRAME_RATE:g} a second"
            yield Remark("clock", text, is_fine=True)
        elif self.name != "seconds":
            text = f"times of {path.name} are {self.name} (the first is {times[0]:.0f}), read as such"
            yield Remark("clock", text, is_fine=True)


SECONDS = Unit("seconds", 1.0)
# By the median step from image to image, the lowest that such a clock can have.
_UNITS = ((1e6, Unit("nanoseconds", 1e-9)), (1e3, Unit("microseconds", 1e-6)), (5.0, Unit("milliseconds", 1e-3)))


def unit_of(times: np.ndarray) -> Unit:
    """The unit of the times of images: SLAM needs several a second, which only one unit makes of the steps."""
    step = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    if len(times) > 2 and step == 1.0 and (times == np.floor(times)).all():
        return Unit("frame numbers", 1 / _FRAME_RATE)
    return next((unit for lowest, unit in _UNITS if step >= lowest), SECONDS)


def unit_that_fits(times: np.ndarray, to: np.ndarray, likely: Unit) -> float:
    """Seconds a unit of ``times`` with which most of them meet the times ``to`` [s]; the likely one in doubt."""
    candidates = dict.fromkeys((likely.seconds, 1.0, 1e-3, 1e-6, 1e-9))
    met = {unit: int(np.count_nonzero(nearest(to, times * unit)[1] < 0.08)) for unit in candidates}
    return max(candidates, key=lambda unit: met[unit])


def read_image_list(path: Path) -> ImageList:
    """Lines "time file", in order of time. File names may hold blanks, and a time a decimal comma.

    Raises:
        DatasetError: The file can't be read, or a line is something else.
    """
    return _listed(path, [(_time(path, n, line, words[0]), words[1]) for n, line, words in _lines(path, 1)])


def read_association(path: Path) -> tuple[ImageList, ImageList]:
    """Colour and depth images of lines "time file time file", told apart by the names of their folders.

    Raises:
        DatasetError: The file can't be read, or a line is something else.
    """
    rows = []
    for number, line, words in _lines(path, 3):
        stamps = [_time(path, number, line, word) for word in words[0::2]]
        rows.append((stamps, words[1::2]))
    swapped = bool(rows) and "depth" in rows[0][1][0].lower() and "depth" not in rows[0][1][1].lower()
    order = (1, 0) if swapped else (0, 1)
    rgb, depth = (_listed(path, [(stamps[k], names[k]) for stamps, names in rows]) for k in order)
    return rgb, depth


def _lines(path: Path, splits: int) -> Iterator[tuple[int, str, list[str]]]:
    """Number, text and words of each line that holds something; the last word is all that is left of it."""
    try:
        data = read_bytes(path, TEXT_LIMIT)
    except OSError as error:
        raise DatasetError(f"{path}: can't be read ({error.strerror}); fetch the file again") from error
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        # A comment in another encoding is no reason to refuse a list; control characters are.
        text = data.decode("latin-1")
        if re.search(r"[\x00-\x08\x0e-\x1f]", text):
            raise DatasetError(f"{path}: can't be read as text ({error}); fetch the file again") from error
    for number, line in enumerate(text.splitlines(), start=1):
        line = line.strip()
        if not line or line.startswith("#"):
            continue
        found = _DECIMAL_COMMA.match(line)
        plain = f"{found[1]}.{found[2]} {line[found.end() :]}" if found else line
        words = plain.split(None, splits) if splits > 1 or " " in plain or "\t" in plain else plain.split(",", splits)
        words = [word.strip(" ,") for word in words]
        if splits == 1 and len(words) == 2:
            four = words[1].split()
            if len(four) == 3 and _is_number(four[1]):  # a line of associations
                words[1] = four[0]
        if len(words) != splits + 1:
            meaning = "time file" if splits == 1 else "time file time file"
            raise DatasetError(f"{path}:{number}: {line!r} is not '{meaning}'; correct the line")
        yield number, line, words


def _is_number(word: str) -> bool:
    try:
        return math.isfinite(float(word))
    except ValueError:
        return False


def _time(path: Path, number: int, line: str, word: str) -> float:
    if not _is_number(word):
        raise DatasetError(f"{path}:{number}: {line!r} is not 'time file'; correct the line")
    return float(word)


def _listed(path: Path, rows: list[tuple[float, str]]) -> ImageList:
    if not rows:
        raise DatasetError(f"{path}: lists no images; fetch the file again")
    rows = sorted(rows)
    if any("\0" in name for _, name in rows):
        raise DatasetError(f"{path}: a file name holds a zero byte; fetch the file again")
    return ImageList(path, np.array([time for time, _ in rows]), [path.parent / name for _, name in rows])
