"""HTML that is escaped unless said otherwise, and the page around the sections."""

from __future__ import annotations

import html
from collections.abc import Iterable
from importlib import resources
from pathlib import Path

from warpslam.errors import ConfigError
from warpslam.storage.atomic import replacing


class Html(str):
    """Markup, as opposed to text that has yet to be escaped."""


def element(name: str, /, *children: str | Iterable[str] | None, **attributes: object) -> Html:
    """``<name attributes>children</name>``.

    Children that are not `Html` are escaped, and None is left out. In attribute names a trailing underscore falls away
    and others become dashes; an attribute that is None or False is left out.
    """
    head = [name]
    for key, value in attributes.items():
        if value is None or value is False:
            continue
        key = key.rstrip("_").replace("_", "-")
        head.append(f'{key}="{html.escape(_attribute(value))}"')
    return Html(f"<{' '.join(head)}>{join(*children)}</{name}>")


def void(name: str, /, **attributes: object) -> Html:
    """An element without content or end tag, such as img."""
    return Html(element(name, **attributes).removesuffix(f"</{name}>"))


def join(*children: str | Iterable[str] | None) -> Html:
    """Children one after the other, those that are not `Html` escaped."""
    parts: list[str] = []
    for child in children:
        if isinstance(child, Html):
            parts.append(child)
        elif isinstance(child, str):
            parts.append(html.escape(child))
        elif child is not None:
            parts.append(join(*child))
    return Html("".join(parts))


def section(identifier: str, title: str, *children: str | Iterable[str] | None) -> Html:
    """A section with its heading; the page's navigation leads to it."""
    return element("section", element("h2", title), *children, id=identifier)


def missing(text: str) -> Html:
    """Says that something is not there, and why."""
    return element("p", text, class_="missing")


def figures(rows: Iterable[tuple[str, str | None, str]]) -> Html:
    """Cards of headline figures: label, value (None = not known) and a line below."""
    cards = [
        element(
            "div",
            element("dt", label),
            element("dd", value if value is not None else "–", class_="unknown" if value is None else None),
            element("p", note) if note else None,
            class_="card",
        )
        for label, value, note in rows
    ]
    return element("dl", cards, class_="cards")


def table(head: Iterable[str], rows: Iterable[Iterable[str]], class_: str | None = None) -> Html:
    """A table whose first column names the row; it scrolls sideways on a narrow screen."""
    body = []
    for row in rows:
        first, *rest = row
        body.append(element("tr", element("th", first, scope="row"), [element("td", cell) for cell in rest]))
    header = element("tr", [element("th", cell, scope="col") for cell in head])
    content = element("table", element("thead", header), element("tbody", body), class_=class_)
    return element("div", content, class_="scroll")


def legend(*entries: tuple[str, str]) -> Html:
    """Names of colours: (CSS class of the swatch, text)."""
    items = [element("li", element("i", class_=f"swatch {key}"), text) for key, text in entries]
    return element("ul", items, class_="legend")


def page(title: str, header: str, sections: Iterable[tuple[str, str, Html]], data: str = "null") -> Html:
    """The whole document.

    Args:
        title: Of the browser's tab.
        header: What stands above the sections.
        sections: (identifier, name in the navigation, content).
        data: JSON that the script reads: positions of the cursor by frame.
    """
    sections = list(sections)
    links = [element("a", name, href=f"#{identifier}") for identifier, name, _ in sections]
    # In a script element only "<" could end it early.
    embedded = Html(data.replace("<", "\\u003c"))
    # The empty icon keeps browsers from asking for one.
    head = join(
        void("meta", charset="utf-8"),
        void("meta", name="viewport", content="width=device-width, initial-scale=1"),
        void("meta", name="color-scheme", content="light dark"),
        void("link", rel="icon", href="data:,"),
        element("title", title),
        element("style", Html(asset("report.css"))),
    )
    body = join(
        element("header", header, element("nav", links)),
        element("main", [content for _, _, content in sections]),
        element("script", embedded, type="application/json", id="frame-data"),
        element("script", Html(asset("report.js"))),
    )
    return Html("<!doctype html>\n" + element("html", element("head", head), element("body", body), lang="en") + "\n")


def write_page(content: Html, path: str | Path) -> Path:
    """Write a page; an existing file is replaced only once all is written.

    Raises:
        ConfigError: The file can't be written.
    """
    path = Path(path)
    try:
        with replacing(path) as partial:
            # Names of files need not be UTF-8.
            partial.write_text(content, encoding="utf-8", errors="backslashreplace")
    except OSError as error:
        raise ConfigError(f"report {path} can't be written ({error.strerror}); choose another file with -o") from error
    return path


def _attribute(value: object) -> str:
    return f"{value:.2f}".rstrip("0").rstrip(".") if isinstance(value, float) else str(value)


def asset(name: str) -> str:
    """Text of a file of this package."""
    return resources.files("warpslam.report").joinpath(name).read_text(encoding="utf-8")
