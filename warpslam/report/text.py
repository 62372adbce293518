"""Quantities as text; None stays None, so that what is not known can be said in its own way."""

from __future__ import annotations


def number(value: float) -> str:
    """Two decimals."""
    return f"{value:.2f}"


def centimetres(metres: float | None) -> str | None:
    """A length in cm."""
    return None if metres is None else f"{100 * metres:.2f} cm"


def cubic_metres(value: float | None) -> str | None:
    """A volume."""
    return None if value is None else f"{value:.1f} m³"


def decibels(value: float | None) -> str | None:
    """A ratio in dB."""
    return None if value is None else f"{value:.1f} dB"


def percent(share: float) -> str:
    """A share of 1."""
    return f"{100 * share:.1f} %" if share < 0.995 else f"{100 * share:.0f} %"


def megabytes(count: float | None) -> str | None:
    """Bytes in a unit that fits."""
    if count is None:
        return None
    size, unit = next(((size, unit) for size, unit in ((1e9, "GB"), (1e6, "MB")) if count >= 0.1 * size), (1e3, "kB"))
    return f"{count / size:.2f} {unit}"


def duration(seconds: float | None) -> str | None:
    """A time in a unit that fits."""
    if seconds is None:
        return None
    if seconds < 1:
        return f"{1000 * seconds:.0f} ms" if seconds >= 0.01 or seconds == 0 else f"{1000 * seconds:.2g} ms"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes_left = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes_left} min"
    return f"{minutes} min {rest} s" if minutes else f"{seconds:.1f} s"
