"""Text files of words and numbers, a record a line. Every error names the file and the line."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from warpslam.errors import DatasetError, brief
from warpslam.reading import read_text


def read_lines(path: Path) -> list[tuple[int, list[str]]]:
    """Line number (from 1) and words of every line that is neither empty nor a '#' comment; commas part words too.

    Raises:
        DatasetError: The file can't be read as text.
    """
    try:
        text = read_text(path, encoding="utf-8-sig")
    except OSError as error:
        raise DatasetError(
            f"{path}: can't be read as text ({error.strerror or error}); fetch the file again"
        ) from error
    lines = ((number, line.replace(",", " ").split()) for number, line in enumerate(text.splitlines(), start=1))
    return [(number, words) for number, words in lines if words and not words[0].startswith("#")]


def read_numbers(path: Path, count: int, meaning: str) -> list[tuple[int, np.ndarray]]:
    """Lines of exactly ``count`` numbers each (infinities allowed), and a comment behind them if there is one.

    Returns:
        Line number and float64 array, shape (count,).

    Raises:
        DatasetError: The file can't be read as text, or a line holds something else.
    """
    return [(number, parse_numbers(path, number, words, count, meaning)) for number, words in read_lines(path)]


def parse_numbers(path: Path, number: int, words: list[str], count: int, meaning: str) -> np.ndarray:
    """The ``count`` numbers of one line, float64.

    Raises:
        DatasetError: The line holds something else.
    """
    comment = next((n for n, word in enumerate(words) if word.startswith("#")), len(words))
    words = words[:comment]
    if len(words) != count:
        raise DatasetError(f"{path}:{number}: {len(words)} numbers, expected {count} ({meaning}); correct the line")
    try:
        return np.array([float(word) for word in words])
    except ValueError as error:
        raise DatasetError(f"{path}:{number}: {brief(error)} (expected {meaning}); correct the line") from error
