"""The yaml file that names the sequences of a batch and their settings."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from warpslam.batch.jobs import Job
from warpslam.errors import ConfigError
from warpslam.runs.request import parse_slice

FIELDS = (
    "path", "name", "dataset", "camera", "preset", "frames", "set", "decoders", "device", "seed", "truth_mesh",
    "method", "poses", "checkpoint_every",
)  # fmt: skip


def read_manifest(path: str | Path, common: Job) -> list[Job]:
    """Jobs of a yaml file: ``sequences``, each a path or a mapping, and ``defaults`` for all of them.

    Fields are path, name, dataset, camera, preset, frames ("A:B:STEP"), set (a list of KEY=VALUE), decoders, device,
    seed, truth_mesh, method, poses and checkpoint_every (0 for none). Paths are relative to the file.

    Args:
        path: File.
        common: Values for what the file leaves open.

    Raises:
        ConfigError: The file can't be read, or a field is unknown or has a value that does not fit.
    """
    import yaml

    path = Path(path)
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, yaml.YAMLError, ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: can't be read as yaml ({' '.join(str(error).split())})") from error
    if not isinstance(content, dict) or not isinstance(content.get("sequences"), list) or not content["sequences"]:
        raise ConfigError(f"{path}: expected a list 'sequences' of folders, and 'defaults' where wanted")
    unknown = set(content) - {"sequences", "defaults"}
    if unknown:
        raise ConfigError(f"{path}: unknown field {', '.join(map(str, unknown))}; known are sequences and defaults")
    common = _with_fields(common, content.get("defaults") or {}, path, "defaults")
    jobs = []
    for number, entry in enumerate(content["sequences"], start=1):
        fields = {"path": entry} if isinstance(entry, str) else entry
        where = f"sequences, entry {number}"
        if not isinstance(fields, dict) or not isinstance(fields.get("path"), str):
            raise ConfigError(f"{path}: {where}: expected a folder, or a mapping with 'path'")
        job = _with_fields(common, fields, path, where)
        jobs.append(job if "name" in fields else replace(job, name=Path(job.path).name))
    return jobs


def _with_fields(job: Job, fields: Any, path: Path, where: str) -> Job:
    if not isinstance(fields, dict) or set(fields) - set(FIELDS):
        raise ConfigError(f"{path}: {where}: got {fields!r}; known fields are {', '.join(FIELDS)}")
    values: dict[str, Any] = {}
    for name, value in fields.items():
        if name == "set":
            if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
                raise ConfigError(f"{path}: {where}: set = {value!r} must be a list of texts KEY=VALUE")
            values["overrides"] = (*job.overrides, *value)
        elif name == "frames":
            # Unquoted, yaml reads 1:20 as a number in base 60.
            if not isinstance(value, str):
                raise ConfigError(f"{path}: {where}: frames = {value!r} must be a text in quotes, such as '0:200'")
            values["frames"] = parse_slice(value)
        elif name in ("seed", "checkpoint_every"):
            if isinstance(value, bool) or not isinstance(value, int):
                raise ConfigError(f"{path}: {where}: {name} = {value!r} must be a whole number")
            values[name] = None if name == "checkpoint_every" and value == 0 else value
        elif not isinstance(value, str):
            raise ConfigError(f"{path}: {where}: {name} = {value!r} must be a text")
        else:
            is_path = name in ("path", "decoders", "truth_mesh", "poses")
            values[name] = str((path.parent / Path(value).expanduser()).resolve()) if is_path else value
    return replace(job, **values)
