"""The yaml file that names the sequences of a batch and their settings."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from warpslam.batch.jobs import Job
from warpslam.config import Config
from warpslam.errors import ConfigError, brief
from warpslam.reading import load_yaml, read_text
from warpslam.runs.request import RunRequest, Source, parse_slice

_OF_SOURCE = ("path", "dataset", "camera")
_PATHS = ("path", "decoders", "truth_mesh", "poses", "map", "config")
_NUMBERS = ("seed", "checkpoint_every")
FIELDS = (
    *_OF_SOURCE, "name", "set",
    *(field.name for field in fields(RunRequest) if field.name not in ("source", "overrides")),
)  # fmt: skip
"""Those of `RunRequest`, with its source spelled out, and ``set`` for its overrides."""


def read_manifest(path: str | Path, common: Job) -> list[Job]:
    """Jobs of a yaml file: ``sequences``, each a path or a mapping, and ``defaults`` for all of them.

    Fields are a name and those of `warpslam.runs.request.RunRequest`, with path, dataset and camera for its source;
    frames is "A:B:STEP", set a list of KEY=VALUE, config a file of settings, checkpoint_every 0 for none. Paths are
    relative to the file.

    Args:
        path: File.
        common: Values for what the file leaves open.

    Raises:
        ConfigError: The file can't be read, or a field is unknown or has a value that does not fit.
    """
    path = Path(path)
    try:
        content = load_yaml(read_text(path))
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: can't be read as yaml ({brief(error)})") from error
    if not isinstance(content, dict) or not isinstance(content.get("sequences"), list) or not content["sequences"]:
        raise ConfigError(f"{path}: expected a list 'sequences' of folders, and 'defaults' where wanted")
    unknown = set(content) - {"sequences", "defaults"}
    if unknown:
        raise ConfigError(f"{path}: unknown field {', '.join(map(str, unknown))}; known are sequences and defaults")
    common = _with_fields(common, content.get("defaults") or {}, path, "defaults")
    jobs = []
    for number, entry in enumerate(content["sequences"], start=1):
        values = {"path": entry} if isinstance(entry, str) else entry
        where = f"sequences, entry {number}"
        if not isinstance(values, dict) or not isinstance(values.get("path"), str):
            raise ConfigError(f"{path}: {where}: expected a folder, or a mapping with 'path'")
        job = _with_fields(common, values, path, where)
        jobs.append(job if "name" in values else replace(job, name=Path(values["path"]).name))
    return jobs


def _with_fields(job: Job, values: Any, path: Path, where: str) -> Job:
    if not isinstance(values, dict) or set(values) - set(FIELDS):
        raise ConfigError(f"{path}: {where}: got {values!r}; known fields are {', '.join(FIELDS)}")
    if "preset" in values and "config" in values:
        raise ConfigError(f"{path}: {where}: config and preset do not go together: leave one of them out")
    read = {name: _read(name, value, path, f"{path}: {where}") for name, value in values.items()}
    # Of what is here and what is given for all, this is the nearer one.
    read |= {"config": None} if "preset" in read else {"preset": None} if "config" in read else {}
    if "set" in read:
        read["overrides"] = (*job.request.overrides, *read.pop("set"))
    source = job.request.source or Source("")
    source = replace(source, **{name: read.pop(name) for name in _OF_SOURCE if name in read})
    return replace(job, name=read.pop("name", job.name)).asking(source=source, **read)


def _read(name: str, value: Any, path: Path, where: str) -> Any:
    """The value of a field as the request has it."""
    if name == "set":
        if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
            raise ConfigError(f"{where}: set = {value!r} must be a list of texts KEY=VALUE")
        return value
    if name == "frames":
        # Unquoted, yaml reads 1:20 as a number in base 60.
        if not isinstance(value, str):
            raise ConfigError(f"{where}: frames = {value!r} must be a text in quotes, such as '0:200'")
        return parse_slice(value)
    if name in _NUMBERS:
        if isinstance(value, bool) or not isinstance(value, int):
            raise ConfigError(f"{where}: {name} = {value!r} must be a whole number")
        return None if name == "checkpoint_every" and value == 0 else value
    if name == "localize_only":
        if not isinstance(value, bool):
            raise ConfigError(f"{where}: {name} = {value!r} must be true or false")
        return value
    if not isinstance(value, str):
        raise ConfigError(f"{where}: {name} = {value!r} must be a text")
    if name in _PATHS:
        value = str((path.parent / Path(value).expanduser()).resolve())
    return Config.load(value) if name == "config" else value
