"""Reading an HTML page as strictly as a test should."""

from __future__ import annotations

import re
from html.parser import HTMLParser

VOID = {"meta", "link", "img", "br", "hr", "input"}
REFERENCES = {"src", "href", "srcset", "action", "poster", "data", "xlink:href"}


class Page(HTMLParser):
    """What is in a page: sections, text, references; ``problems`` names what is wrong with its structure."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.problems: list[str] = []
        self.ids: list[str] = []
        self.references: list[str] = []
        self.links: list[str] = []
        self.tags: list[str] = []
        self.headings: dict[str, str] = {}
        self.sections: dict[str, str] = {}
        self.text = ""
        self.styles = ""
        self.scripts: list[str] = []
        self._section: str | None = None
        self.feed(text)
        self.close()
        self.problems += [f"<{tag}> is never closed" for tag in self.open]
        self.problems += [f"id {name} is not unique" for name in set(self.ids) if self.ids.count(name) > 1]
        targets = [reference[1:] for reference in self.references if reference.startswith("#")]
        self.problems += [f"#{target} leads nowhere" for target in targets if target not in self.ids]

    @property
    def external(self) -> list[str]:
        """Everything that a browser would have to fetch from somewhere."""
        loaded = [r for r in self.references if not r.startswith(("data:", "#"))]
        return loaded + re.findall(r"@import|url\((?!\s*[\"']?(?:data:|#))[^)]*\)", self.styles)

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        self.tags.append(tag)
        if len(values) != len(attributes):
            self.problems.append(f"<{tag}> repeats an attribute")
        if tag == "img" and not values.get("alt"):
            self.problems.append("an image has no text in its place")
        found = [value or "" for name, value in attributes if name in REFERENCES]
        if tag == "a" and not found[0].startswith("#"):
            self.links += found  # what one may go to is not fetched
        else:
            self.references += found
        self.styles += values.get("style") or ""
        self.problems += [f"<{tag}> has {name}" for name in values if name.startswith("on")]
        if "id" in values:
            self.ids.append(values["id"])
        if tag == "section":
            self._section = values.get("id")
            self.sections[self._section] = ""
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        if not self.open or self.open.pop() != tag:
            self.problems.append(f"</{tag}> closes nothing")
        if tag == "section":
            self._section = None

    def handle_data(self, data):
        within = self.open[-1] if self.open else ""
        if within == "style":
            self.styles += data
        elif within == "script":
            self.scripts.append(data)
        else:
            self.text += data
            if self._section is not None:
                self.sections[self._section] += data
