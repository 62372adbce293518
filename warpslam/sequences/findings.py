"""What the checks of a sequence come to."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

OK, WARNING, ERROR = "ok", "warning", "error"


@dataclass(frozen=True)
class Finding:
    """What one check came to."""

    check: str
    """What was looked at."""
    severity: str
    """One of "error", "warning" and "ok"."""
    message: str
    """What is so, and where."""
    remedy: str = ""
    """What to do or type; empty where nothing is wrong."""

    def __str__(self) -> str:
        return f"{self.check}: {self.message}" + (f"; {self.remedy}" if self.remedy else "")


@dataclass(frozen=True)
class CheckReport:
    """All findings about one folder."""

    folder: str
    """What was checked."""
    name: str = ""
    """Of the sequence; empty if it can't be opened."""
    frames: int = 0
    """How many it has."""
    findings: tuple[Finding, ...] = field(default_factory=tuple)

    @property
    def errors(self) -> list[Finding]:
        """Findings that can't work."""
        return [finding for finding in self.findings if finding.severity == ERROR]

    @property
    def warnings(self) -> list[Finding]:
        """Findings that will cost something."""
        return [finding for finding in self.findings if finding.severity == WARNING]

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return {**asdict(self), "errors": len(self.errors), "warnings": len(self.warnings)}
