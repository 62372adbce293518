"""Typed errors. Every message names the file or field at fault and says what to do.

What a message quotes may come from a stranger: it is told with control characters escaped, in 200 characters at most.
"""

from __future__ import annotations

import re
from typing import Any

QUOTED = 200
"""Characters of a value that a message quotes, at most."""
_LONGEST = 2000
_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069\ud800-\udfff]")
_WORD = re.compile(rf"[^\s/]{{{QUOTED + 1},}}")


def brief(value: Any, limit: int = QUOTED) -> str:
    """A value as a message quotes it: in one line, its middle left out where it is long."""
    text = printable(" ".join(str(value).split()))
    return text if len(text) <= limit else f"{text[: limit // 2]} ... {text[-limit // 4 :]} ({len(text)} characters)"


def printable(text: str) -> str:
    """Text whose control characters, and what is no character, are escaped; line feeds and tabs stay."""
    return _CONTROL.sub(lambda found: found[0].encode("unicode_escape").decode("ascii"), text)


class WarpSlamError(Exception):
    """Base of every error that warpslam raises on purpose."""

    def __str__(self) -> str:
        text = printable(_WORD.sub(lambda found: brief(found[0]), super().__str__()))
        return text if len(text) <= _LONGEST else f"{text[: _LONGEST // 2]} ... {text[-_LONGEST // 4 :]}"


class ConfigError(WarpSlamError, ValueError):
    """A setting that can't work: names the field, the value and the accepted range."""


class DatasetError(WarpSlamError):
    """A sequence folder or one of its files can't be used."""


class CheckpointError(WarpSlamError):
    """A decoder or map file is missing, damaged, or does not fit."""


class MapSizeError(WarpSlamError):
    """The map or its keyframes need more memory than the settings or the machine have."""


class InputError(WarpSlamError, ValueError):
    """An argument of the Python API has the wrong shape, type or range."""


class FrameError(InputError):
    """One frame can't be used; a run leaves it out and goes on."""


class OutputError(WarpSlamError):
    """A result can't be written: the disk is full, or the folder can't be written to."""


class MemoryBudgetError(WarpSlamError):
    """A run takes more memory than it was allowed to."""


class MeshError(WarpSlamError):
    """There is no surface to extract, or a mesh file can't be used."""


class MissingDependencyError(WarpSlamError, ImportError):
    """An optional package or a system library it needs can't be loaded."""
