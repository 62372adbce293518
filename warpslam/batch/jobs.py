"""The jobs of a batch: one sequence each, with names of their own."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from warpslam import __version__
from warpslam.config import PRESETS
from warpslam.errors import ConfigError
from warpslam.pipeline.methods import check_method
from warpslam.runs.folder import as_file_name
from warpslam.runs.request import RunRequest


@dataclass(frozen=True)
class Job:
    """One run of a batch. A method that has no checkpoints starts again after a stop."""

    name: str
    """Of the folder for its results, in the folder of the batch."""

    request: RunRequest
    """What is asked for; it names its source."""

    log: str = ""
    """Where its figures go beside its folder, as `warpslam.viewer.figures.FigureLog` has it; empty for nowhere."""

    @property
    def settings_hash(self) -> str:
        """Of all that decides on the result: name, request and the version of warpslam, but not the checkpoints, nor
        where figures go.
        """
        fields = replace(self.request, checkpoint_every=None).to_dict()
        text = json.dumps({**fields, "name": self.name, "warpslam": __version__}, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def asking(self, **changes: Any) -> Job:
        """The same job with other fields of its request."""
        return replace(self, request=replace(self.request, **changes))

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return {"name": self.name, "request": self.request.to_dict(), "log": self.log}

    @classmethod
    def from_dict(cls, fields: dict[str, Any]) -> Job:
        """What `to_dict` gave, after a trip through JSON."""
        return cls(fields["name"], RunRequest.from_dict(fields["request"]), fields.get("log", ""))


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
    if not jobs:
        raise ConfigError("the batch is empty: name folders, or a manifest with --manifest")
    for job in jobs:
        every = job.request.checkpoint_every
        check_method(job.request.method)
        if every is not None and every < 1:
            raise ConfigError(f"checkpoint_every = {every} of {job.name} must be at least 1 frame")
        job.request.settings(next(iter(PRESETS)))
