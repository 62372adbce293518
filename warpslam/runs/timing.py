"""The times of a run: content of timing.json."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import BaseModel, Field

from warpslam.storage.json_files import Index, Seconds, read_as


class PhaseTime(BaseModel):
    """What a phase of the frames took."""

    seconds: Seconds = 0.0
    """In all [s]."""
    calls: Index | None = None
    """Frames that had it."""
    mean_seconds: Seconds | None = None
    """A call [s]."""


class FrameTime(BaseModel, extra="allow"):
    """What the phases of a frame took [s], each under its name."""

    __pydantic_extra__: dict[str, Seconds | None] = Field(init=False)

    index: Index
    """Number in the sequence."""

    @property
    def seconds(self) -> dict[str, float]:
        """By phase [s], of those that it had."""
        found: dict[str, Any] = self.__pydantic_extra__
        return {name: value for name, value in found.items() if value is not None}


class RunTiming(BaseModel):
    """Content of timing.json; empty where there is none. Other versions may have more, or not all."""

    phases: dict[str, PhaseTime] = Field(default_factory=dict)
    """By name."""
    stages_seconds: dict[str, Seconds | None] = Field(default_factory=dict)
    """Parts of the whole run [s]."""
    frames: list[FrameTime] = Field(default_factory=list)
    """Those that the method was given, in their order."""

    @classmethod
    def read(cls, path: Path) -> RunTiming:
        """Read timing.json.

        Raises:
            DatasetError: The file can't be read, or a field is not of its kind.
        """
        return read_as(path, cls)
