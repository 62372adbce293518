"""Single settings from a command line: ``group.field=value``."""

from __future__ import annotations

from typing import Any

from warpslam.errors import ConfigError
from warpslam.reading import load_yaml


def merge(into: dict[str, Any], values: dict[str, Any]) -> None:
    """Write nested ``values`` over those of ``into``."""
    for key, value in values.items():
        if isinstance(value, dict) and isinstance(into.get(key), dict):
            merge(into[key], value)
        else:
            into[key] = dict(value) if isinstance(value, dict) else value


def parse_override(text: str) -> dict[str, Any]:
    """Nested dictionary of an override such as ``mapping.iterations=30``.

    Raises:
        ConfigError: It has not that form.
    """
    name, separator, value = text.partition("=")
    if not separator or not name:
        raise ConfigError(f"--set {text!r}: expected group.field=value, for example mapping.iterations=30")
    try:
        parsed: Any = load_yaml(value)
    except ValueError:
        raise ConfigError(f"--set {text!r}: the value can't be parsed") from None
    # yaml reads 1e-3 as a string.
    if isinstance(parsed, str):
        try:
            parsed = float(parsed)
        except ValueError:
            pass
    for key in reversed(name.split(".")):
        parsed = {key: parsed}
    return parsed
