"""The yaml file that says which studies are made on which sequences."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from warpslam.bench.studies import STUDIES, Study
from warpslam.config import Config
from warpslam.errors import ConfigError, brief
from warpslam.reading import load_yaml, read_text
from warpslam.runs.request import parse_slice

SHIPPED = ("quick",)
"""Suites that come with the package."""


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid")


class Rendering(_Section):
    """A synthetic sequence that the bench renders itself; as ``warpslam render-room sequence``."""

    kind: Literal["room", "moving", "gap"]
    seed: int = Field(0, ge=0)
    frames: int | None = Field(None, ge=1)
    size: tuple[int, int] = Field((320, 240), description="width and height [px]")
    gap: Literal["black", "absent"] = "black"

    @property
    def digest(self) -> str:
        """Of everything that decides on the images."""
        return hashlib.sha256(json.dumps(self.model_dump(), sort_keys=True).encode()).hexdigest()[:8]


class SequenceSpec(_Section):
    """One sequence and how it is run. Either ``path`` or ``render`` says where its frames come from.

    ``published`` declares that it is, frame for frame, a sequence of the paper, whose figures then stand beside ours.
    """

    path: str | None = None
    render: Rendering | None = None
    dataset: str = "auto"
    camera: str | None = None
    preset: str | None = None
    frames: str | None = None
    set: list[str] = Field(default_factory=list)
    truth_mesh: str | None = None
    poses: str | None = None
    decoders: str | None = None
    published: str | None = None

    @model_validator(mode="after")
    def _has_one_source(self) -> SequenceSpec:
        if (self.path is None) == (self.render is None):
            raise ValueError("give either path, a folder, or render, a synthetic sequence")
        if self.published is not None and self.published not in published_figures():
            raise ValueError(f"published must be one of {', '.join(published_figures())}")
        return self


class StudySpec(_Section):
    """How one study is made; what is left out is the suite's."""

    sequences: list[str] | None = None
    seeds: list[int] | None = Field(None, min_length=1)
    variants: list[str] | None = Field(None, min_length=1)
    frames: str | None = None
    set: list[str] = Field(default_factory=list)


class SuiteSpec(_Section):
    """Content of a suite file."""

    description: str = ""
    seeds: list[int] = Field(default_factory=lambda: [0], min_length=1)
    device: str | None = None
    set: list[str] = Field(default_factory=list)
    sequences: dict[str, SequenceSpec] = Field(min_length=1)
    studies: dict[str, StudySpec | None] = Field(min_length=1)


@dataclass(frozen=True)
class Suite:
    """A suite that has been read and checked."""

    name: str
    """Of the file, without its ending."""

    spec: SuiteSpec
    """Its content."""

    bases: tuple[Path, ...]
    """Folders that its paths are looked for in, one after the other."""

    source: str
    """The file, or ``shipped``."""

    def studies(self, wanted: Iterable[str] | None = None) -> list[tuple[Study, StudySpec]]:
        """Its studies in the order of `STUDIES`, or those of them that are wanted.

        Raises:
            ConfigError: One that is wanted is not part of the suite.
        """
        mine = [name for name in STUDIES if name in self.spec.studies]
        chosen = mine if wanted is None else list(wanted)
        for name in chosen:
            if name not in mine:
                raise ConfigError(f"study {name!r} is not in suite {self.name}; it has {', '.join(mine)}")
        return [(STUDIES[name], self.spec.studies[name] or StudySpec()) for name in mine if name in chosen]

    def sequences_of(self, study: StudySpec) -> dict[str, SequenceSpec]:
        """Sequences of a study: all of the suite, if the study names none."""
        return {name: self.spec.sequences[name] for name in study.sequences or self.spec.sequences}

    def resolve(self, path: str | None) -> str | None:
        """A path of the suite as an absolute one: where it exists, or else in the first folder."""
        if path is None:
            return None
        places = [(base / Path(path).expanduser()).resolve() for base in self.bases]
        return str(next((place for place in places if os.path.exists(place)), places[0]))


def read_suite(name: str, *data: str | Path) -> Suite:
    """Read a suite by its file, or one that comes with the package by its name.

    Args:
        name: File, or one of `SHIPPED`.
        data: Folders that paths are looked for in; the file's own by default.

    Raises:
        ConfigError: There is no such suite, it can't be read, or a field is unknown or has a value that does not fit.
    """
    path = Path(name)
    if not os.path.isfile(path) and name in SHIPPED:
        text = resources.files("warpslam.bench").joinpath("suites", f"{name}.yaml").read_text(encoding="utf-8")
        own, source, where = Path("."), "shipped", f"suite {name}"
    else:
        try:
            text = read_text(path)
        except (OSError, ValueError) as error:
            shipped = ", ".join(SHIPPED)
            raise ConfigError(f"suite {name} can't be read ({error}); give a file, or one of: {shipped}") from error
        own, source, where = path.parent, str(path), str(path)
    try:
        content = load_yaml(text)
    except ValueError as error:
        raise ConfigError(f"{where}: can't be read as yaml ({brief(error)})") from error
    try:
        spec = SuiteSpec.model_validate(content)
    except ValidationError as error:
        raise ConfigError(f"{where}: " + "; ".join(map(_say, error.errors()))) from None
    _check(spec, where)
    return Suite(path.stem, spec, tuple(map(Path, data)) or (own,), source)


@cache
def published_figures() -> dict[str, dict[str, dict[str, dict[str, float | str]]]]:
    """What the paper prints: sequence, study, variant, figure."""
    text = resources.files("warpslam.bench").joinpath("published.yaml").read_text(encoding="utf-8")
    return yaml.safe_load(text)


def _say(error: Any) -> str:
    place = ".".join(map(str, error["loc"])) or "the file"
    got = f" (got {error['input']!r})" if isinstance(error["input"], str | int | float | bool) else ""
    return f"{place}: {error['msg'].removeprefix('Value error, ')}{got}"


def _check(spec: SuiteSpec, where: str) -> None:
    """What one section says about another, and settings."""
    for name, study in spec.studies.items():
        place = f"{where}: studies.{name}"
        if name not in STUDIES:
            raise ConfigError(f"{place}: there is no such study; known are {', '.join(STUDIES)}")
        study = study or StudySpec()
        for wanted in study.sequences or ():
            if wanted not in spec.sequences:
                known = ", ".join(spec.sequences)
                raise ConfigError(f"{place}.sequences: {wanted!r} is not among the suite's sequences: {known}")
        names = [variant.name for variant in STUDIES[name].variants]
        for variant in study.variants or ():
            if variant not in names:
                raise ConfigError(f"{place}.variants: {variant!r} is unknown; the study has {', '.join(names)}")
        _check_run(place, None, [*spec.set, *study.set], study.frames)
    for name, sequence in spec.sequences.items():
        _check_run(f"{where}: sequences.{name}", sequence.preset, sequence.set, sequence.frames)


def _check_run(place: str, preset: str | None, overrides: list[str], frames: str | None) -> None:
    try:
        Config.from_preset(preset or "default", overrides)
        if frames is not None:
            parse_slice(frames)
    except ConfigError as error:
        raise ConfigError(f"{place}: {error}") from error
