"""What a run is asked for."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from warpslam.errors import ConfigError


def parse_slice(text: str) -> tuple[int | None, int | None, int | None]:
    """The parts of A:B or A:B:STEP.

    Raises:
        ConfigError: It is something else.
    """
    try:
        parts = [int(part) if part.strip() else None for part in text.split(":")]
    except ValueError:
        parts = []
    if not 2 <= len(parts) <= 3:
        raise ConfigError(f"frames = {text!r} is not A:B or A:B:STEP, for example 0:200 or ::2")
    return parts[0], parts[1], parts[2] if len(parts) == 3 else None


# Room for more changes no result, and a run that ran out of it is one to resume.
_FREE_TO_CHANGE = ("config.grid.max_gigabytes", "config.keyframes.max_gigabytes")


@dataclass(frozen=True)
class RunRequest:
    """What a run was asked for; a resumed run must be asked for the same (but for the memory it may take).

    sequence: Name of the input. frame_count: Frames it has. intrinsics: Its camera, by field. frames: Start, stop and
    step of those used. config: All settings. seed: Of every random choice. device: Where it runs. map: Map it started
    from. localize_only: Whether that map is left as it is. source: How to open the input, by field. poses: File of
    the poses that were given.
    """

    sequence: str
    frame_count: int
    intrinsics: dict[str, Any]
    frames: tuple[int, int, int]
    config: dict[str, Any]
    seed: int
    device: str
    map: str | None = None
    localize_only: bool = False
    source: dict[str, Any] | None = None
    poses: str | None = None

    def differences(self, other: RunRequest) -> list[str]:
        """What ``other`` asks for that is not the same, one line each."""
        mine, theirs = (dict(_leaves(dataclasses.asdict(request))) for request in (self, other))
        lines = []
        for name in sorted(mine.keys() | theirs.keys()):
            if name not in _FREE_TO_CHANGE and mine.get(name) != theirs.get(name):
                lines.append(f"{name} is {theirs.get(name)!r}, was {mine.get(name)!r}")
        return lines


def _leaves(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Names such as config.tracking.pixels, and their values."""
    if not isinstance(value, dict):
        yield name, list(value) if isinstance(value, tuple) else value
        return
    for key, item in value.items():
        yield from _leaves(item, f"{name}.{key}" if name else str(key))


@dataclass(frozen=True)
class Source:
    """How to open the sequence of a run again.

    path: Folder of the sequence; None for the built-in demo sequence.
    dataset: Format, as `warpslam.sequences.open_sequence` takes it.
    camera: Camera given by hand, "fx,fy,cx,cy,width,height,depth_scale"; None for the dataset's own.
    command: Command line that started the run; None if a program did.
    """

    path: str | None
    dataset: str = "auto"
    camera: str | None = None
    command: str | None = None
