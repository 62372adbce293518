"""What a run is asked for: described once, for the command line, a batch, a checkpoint and `warpslam.pipeline.run`."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

from warpslam.config import Config
from warpslam.errors import ConfigError
from warpslam.storage.json_files import checked

if TYPE_CHECKING:
    from warpslam.sequences.base import RgbdSequence

DEFAULT_METHOD = "nice-slam"
DEMO = "demo"
"""Dataset of a `Source` that is the built-in sequence, which lies in no folder."""

Slice = tuple[int | None, int | None, int | None]
ALL_FRAMES: Slice = (None, None, None)

# Room for more changes no result, and a run that ran out of it is one to resume.
_FREE_TO_CHANGE = ("config.grid.max_gigabytes", "config.keyframes.max_gigabytes", "checkpoint_every", "truth_mesh")


@dataclass(frozen=True)
class Source:
    """How to open the sequence of a run, and to open it again."""

    path: str | None
    """Folder of the sequence; None for the built-in one."""

    dataset: str = "auto"
    """Format, as `warpslam.sequences.open_sequence` takes it, or `DEMO`."""

    camera: str | None = None
    """Camera given by hand, "fx,fy,cx,cy,width,height,depth_scale"; None for the dataset's own."""

    command: str | None = None
    """Command line that started the run; None if a program did."""

    topics: str | None = None
    """Topics of a bag, "COLOR,DEPTH" or "COLOR,DEPTH,POSES"; None to tell them from their names."""

    @classmethod
    def demo(cls, command: str | None = None) -> Source:
        """The built-in sequence."""
        return cls(None, DEMO, command=command)

    @classmethod
    def from_dict(cls, fields: dict[str, Any]) -> Source:
        """What `dataclasses.asdict` gave, in files of earlier versions as well.

        Raises:
            ValueError: A field is missing, unknown or not of its kind.
        """
        source = checked(cls, fields)
        # Early files know the built-in sequence by its missing folder alone.
        return source if source.path is not None else replace(source, dataset=DEMO)

    @property
    def is_demo(self) -> bool:
        """Whether it is the built-in sequence."""
        return self.dataset == DEMO


@dataclass(frozen=True)
class RunRequest:
    """What is asked of a run.

    Settings are those of ``config``, or else of ``preset``, with ``overrides``, ``decoders`` and given ``poses`` on
    top. A run starts with the request `resolved`: then ``config`` has all of that, and what follows from it.
    """

    source: Source | None = None
    """How to open the sequence; None where it is handed over as an object, and can't be opened again."""

    frames: Slice = ALL_FRAMES
    """Start, stop and step of the frames to use."""

    config: Config | None = None
    """Settings to start from in place of a preset."""

    preset: str | None = None
    """Name of the settings to start from; None for the map's where there is one, or else the dataset's."""

    overrides: tuple[str, ...] = ()
    """Single settings on top, ``group.field=value``."""

    decoders: str | None = None
    """Decoder checkpoint; None for that of the settings."""

    device: str | None = None
    """Warp device, such as "cpu" or "cuda:0"; None for Warp's preferred one."""

    seed: int = 0
    """Seed of every random choice."""

    method: str = DEFAULT_METHOD
    """One of `warpslam.pipeline.methods.METHODS`."""

    poses: str | None = None
    """Trajectory in the TUM format whose poses are taken as given, in place of the sequence's own; frames without one
    are left out. Errors are against the sequence's own as ever."""

    map: str | None = None
    """Map to start from, a file that `Slam.save` wrote; the first frame is looked for in it."""

    localize_only: bool = False
    """The map is left as it is."""

    checkpoint_every: int | None = None
    """Frames between two checkpoints; None for none. With the schedule strict a resumed run gives the same bytes as one
    that was never stopped; with overlapped it gives a result as good as any other run's."""

    truth_mesh: str | None = None
    """True surface in the world frame of the sequence; adds the reconstruction metrics."""

    def settings(self, preset: str) -> Config:
        """All settings in effect.

        Args:
            preset: Settings to start from where the request names none.

        Raises:
            ConfigError: A setting is unknown or out of range, or there are both a config and a preset.
        """
        if self.config is not None and self.preset is not None:
            raise ConfigError(f"a config and the preset {self.preset} do not go together: leave one of them out")
        if self.config is None:
            config = Config.from_preset(self.preset or preset, list(self.overrides))
        else:
            config = self.config.updated(list(self.overrides))
        return config.with_files(self.decoders, self.poses)

    def resolved(self, preset: str, selected: range, device: str) -> RunRequest:
        """The same request with nothing left open: settings, frames and device are what the run goes by.

        Raises:
            ConfigError: As `settings` does.
        """
        return replace(
            self,
            frames=(selected.start, selected.stop, selected.step),
            config=self.settings(preset).resolved(),
            preset=None,
            overrides=(),
            decoders=None,
            device=device,
        )

    def differences(self, other: RunRequest) -> list[str]:
        """What ``other`` asks for that is not the same, one line each; what changes no result does not count."""
        return differences(self.to_dict(), other.to_dict())

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        fields = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return {
            **fields,
            "source": None if self.source is None else asdict(self.source),
            "frames": list(self.frames),
            "config": None if self.config is None else self.config.model_dump(),
            "overrides": list(self.overrides),
        }

    @classmethod
    def from_dict(cls, fields: dict[str, Any]) -> RunRequest:
        """What `to_dict` gave, after a trip through JSON.

        Raises:
            KeyError: A field is missing.
            ValueError: A field is unknown or not of its kind, or (`ConfigError`) a setting does not fit.
        """
        source, config = fields["source"], fields["config"]
        if not isinstance(source, dict | None) or not isinstance(config, dict | None):
            raise ValueError(f"source and config are {source!r} and {config!r}, expected mappings")
        return checked(
            cls,
            {
                **fields,
                "source": None if source is None else Source.from_dict(source),
                "config": None if config is None else Config.from_dict(config),
            },
        )


@dataclass(frozen=True)
class SequenceFacts:
    """What a sequence must still be like for a run over it to go on."""

    sequence: str
    """Name."""

    frame_count: int
    """Frames it has."""

    intrinsics: dict[str, Any]
    """Its camera, by field."""

    timing: dict[str, Any]
    """When its pixels are taken, by field."""

    @classmethod
    def from_dict(cls, fields: dict[str, Any]) -> SequenceFacts:
        """What `dataclasses.asdict` gave.

        Raises:
            ValueError: A field is missing, unknown or not of its kind.
        """
        return checked(cls, fields)

    @classmethod
    def of(cls, sequence: RgbdSequence) -> SequenceFacts:
        """The facts of a sequence as it is now."""
        return cls(sequence.name, len(sequence), asdict(sequence.intrinsics), asdict(sequence.timing))


def differences(was: dict[str, Any], is_now: dict[str, Any]) -> list[str]:
    """What differs in nested dictionaries, one line each, but for what is `_FREE_TO_CHANGE`."""
    old, new = dict(_leaves(was)), dict(_leaves(is_now))
    return [
        f"{name} is {new.get(name)!r}, was {old.get(name)!r}"
        for name in sorted(old.keys() | new.keys())
        if name not in _FREE_TO_CHANGE and old.get(name) != new.get(name)
    ]


def _leaves(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Names such as config.tracking.pixels, and their values."""
    if not isinstance(value, dict):
        yield name, list(value) if isinstance(value, tuple) else value
        return
    for key, item in value.items():
        yield from _leaves(item, f"{name}.{key}" if name else str(key))


def parse_slice(text: str) -> Slice:
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
