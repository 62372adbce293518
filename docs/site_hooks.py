"""What the site has beyond the files in docs: the table of settings, and no links to where the site does not reach."""

from __future__ import annotations

import re
from typing import Any

_OUTSIDE = re.compile(r"\[([^\]]+)\]\(\.\./([^)]+)\)")


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Text of a page before it is rendered."""
    if page.file.src_uri == "settings.md":
        markdown += "\n" + settings_table()
    return _OUTSIDE.sub(lambda found: f"{found[1]} (`{found[2]}` in the sources)", markdown)


def settings_table() -> str:
    """Every setting, group by group, as `warpslam info --settings` explains it."""
    from warpslam.config.description import groups, settings

    parts = []
    for group, text in groups().items():
        rows = [one for one in settings() if one.name.rpartition(".")[0] == group]
        if not rows:
            continue
        parts.append(f"\n## {group or 'Without a group'}\n\n{text.strip().splitlines()[0]}\n")
        parts.append("| setting | default | accepted | meaning |\n|---|---|---|---|")
        parts += [f"| `{one.name}` | `{one.default}` | {_cell(one.accepted)} | {_cell(one.meaning)} |" for one in rows]
    return "\n".join(parts) + "\n"


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")
