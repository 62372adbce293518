"""What every setting means, for people: meaning, unit, range and default, told by the fields of `Config` themselves."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from warpslam.config.settings import Config


@dataclass(frozen=True)
class Setting:
    """One field of `Config`."""

    name: str
    """What ``--set`` takes, such as mapping.iterations."""
    default: Any
    choices: tuple[Any, ...]
    """The words it may be; empty where it is no choice."""
    range: str
    """Accepted numbers, such as "1 to 64" or "above 0"; empty where there is no bound."""
    unit: str
    """Such as m or px; empty for what has none."""
    meaning: str

    @property
    def accepted(self) -> str:
        """Choices or range, as text."""
        return " or ".join(map(str, self.choices)) or self.range


def groups() -> dict[str, str]:
    """Name and meaning of each group of settings; "" holds what is in no group."""
    return {"": Config.__doc__ or "", **{name: (group.__doc__ or "") for name, group in _group_types().items()}}


def settings() -> list[Setting]:
    """All settings, group by group."""
    types = _group_types()
    single = [_describe(name, field) for name, field in Config.model_fields.items() if name not in types]
    return single + [
        _describe(f"{group}.{name}", field)
        for group, kind in types.items()
        for name, field in kind.model_fields.items()
    ]


def _group_types() -> dict[str, type[BaseModel]]:
    fields = ((name, field.annotation) for name, field in Config.model_fields.items())
    return {name: kind for name, kind in fields if isinstance(kind, type) and issubclass(kind, BaseModel)}


def _describe(name: str, field: FieldInfo) -> Setting:
    meaning = field.description or ""
    choices = get_args(field.annotation) if get_origin(field.annotation) is Literal else ()
    unit = re.search(r"\[([^\]]+)\]", meaning)
    return Setting(name, field.default, choices, _range(field), unit[1] if unit else "", meaning)


def _range(field: FieldInfo) -> str:
    bounds = {
        kind: f"{getattr(rule, kind):g}"
        for kind in ("gt", "ge", "lt", "le")
        for rule in field.metadata
        if getattr(rule, kind, None) is not None
    }
    if bounds.keys() == {"ge", "le"}:
        return f"{bounds['ge']} to {bounds['le']}"
    words = {"gt": "above", "ge": "from", "lt": "below", "le": "up to"}
    return ", ".join(f"{words[kind]} {number}" for kind, number in bounds.items())
