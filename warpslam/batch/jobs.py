"""The jobs of a batch: one sequence each, with names of their own."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from warpslam import __version__
from warpslam.errors import ConfigError
from warpslam.pipeline.methods import DEFAULT_METHOD, check_method
from warpslam.runs.folder import as_file_name


@dataclass(frozen=True)
class Job:
    """One sequence of a batch and how it is run; fields as the options of ``warpslam run``.

    name: Of the folder for its results. frames: Slice as (start, stop, step). poses: Trajectory in the TUM format that
    is taken as given. checkpoint_every: Frames between two checkpoints; None for none. A method that has none starts
    again after a stop.
    """

    name: str
    path: str
    dataset: str = "auto"
    camera: str | None = None
    preset: str | None = None
    frames: tuple[int | None, int | None, int | None] = (None, None, None)
    overrides: tuple[str, ...] = ()
    decoders: str | None = None
    device: str | None = None
    seed: int = 0
    truth_mesh: str | None = None
    method: str = DEFAULT_METHOD
    poses: str | None = None
    checkpoint_every: int | None = None

    @property
    def settings_hash(self) -> str:
        """Of all that decides on the result: the version of warpslam and the fields, but for the checkpoints."""
        fields = {name: value for name, value in asdict(self).items() if name != "checkpoint_every"}
        text = json.dumps({**fields, "warpslam": __version__}, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)

    @classmethod
    def from_dict(cls, fields: dict[str, Any]) -> Job:
        """What `to_dict` gave, after a trip through JSON."""
        return cls(**{**fields, "frames": tuple(fields["frames"]), "overrides": tuple(fields["overrides"])})


def with_free_names(jobs: Iterable[Job]) -> list[Job]:
    """Jobs whose names can be folders and are all different: the second ``room`` is called ``room_2``."""
    taken: set[str] = set()
    result = []
    for job in jobs:
        name = base = as_file_name(job.name)
        number = 1
        while name in taken:
            number += 1
            name = f"{base}_{number}"
        taken.add(name)
        result.append(replace(job, name=name))
    return result


def check_jobs(jobs: Sequence[Job]) -> None:
    """Refuse settings that can't work before any worker starts. A folder that can't be read only fails its own job.

    Raises:
        ConfigError: A method, a preset, a setting or a number of the batch is not usable.
    """
    from warpslam.config import PRESETS, Config

    if not jobs:
        raise ConfigError("the batch is empty: name folders, or a manifest with --manifest")
    for job in jobs:
        check_method(job.method)
        if job.checkpoint_every is not None and job.checkpoint_every < 1:
            raise ConfigError(f"checkpoint_every = {job.checkpoint_every} of {job.name} must be at least 1 frame")
        Config.from_preset(job.preset or next(iter(PRESETS)), list(job.overrides))
