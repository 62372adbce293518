"""The page of a bench: all tables and plots in one HTML file, with links to the reports of its runs."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any
from urllib.parse import quote

import yaml

from warpslam.bench.results import Bench, Direction, StudyResult
from warpslam.bench.tables import bench_facts, header, how_to_read, made_with, plot_path, table_rows, trouble
from warpslam.report.page import Html, element, figures, join, missing, page, section, table, void, write_page


def write_bench_page(bench: Bench) -> Path:
    """Write ``report.html`` in the folder of a bench, whose plots must be there.

    Raises:
        ConfigError: The page can't be written.
        OSError: A plot can't be read.
    """
    facts = bench_facts(bench)
    sections = [("overview", "Overview", _overview(bench, facts))]
    sections += [(result.study.name, result.study.title, _study(bench, result)) for result in bench.results]
    sections.append(("made", "How it was made", _made(facts)))
    runs = ", ".join(f"{count} {status}" for status, count in facts["runs"].items())
    heading = join(
        element("p", "warpslam bench", class_="kicker"),
        element("h1", bench.suite.name),
        element("p", f"{len(bench.jobs)} runs ({runs}) · seeds {', '.join(map(str, facts['seeds']))}", class_="facts"),
    )
    return write_page(page(f"{bench.suite.name} · warpslam bench", heading, sections), bench.folder / "report.html")


def _overview(bench: Bench, facts: dict[str, Any]) -> Html:
    directions = [direction for result in bench.results for direction in result.directions()]
    known = [direction for direction in directions if direction.holds is not None]
    good = sum(bool(direction.holds) for direction in known)
    failed = sum(not outcome.is_finished for r in bench.results for row in r.rows for outcome in row.outcomes)
    cards = figures(
        [
            ("Studies", str(len(bench.results)), "of the paper and its supplement"),
            ("Expected directions", f"{good} of {len(known)}", f"hold; {len(directions) - len(known)} not known"),
            ("Runs", str(len(bench.jobs)), f"{failed} entries of the tables failed" if failed else "none failed"),
        ]
    )
    rows: list[list[str]] = []
    for result in bench.results:
        link = element("a", result.study.title, href=f"#{result.study.name}")
        name = join(link, " ", element("small", result.study.source))
        for number, direction in enumerate(result.directions()):
            rows.append([name if number == 0 else "", direction.text, _verdict(direction)])
    content = table(("study", "expected (ours)", "holds"), rows) if rows else missing("No study expects anything.")
    description = element("p", facts["description"]) if facts["description"] else None
    return section("overview", "Overview", description, cards, content)


def _study(bench: Bench, result: StudyResult) -> Html:
    study = result.study
    content = [
        element("p", study.text, " ", how_to_read(result)),
        table(*_joined(header(result), table_rows(result)), "numbers"),
        element("figure", _plot(bench, result)),
    ]
    directions = result.directions()
    if directions:
        rows = [[direction.text, _verdict(direction)] for direction in directions]
        content.append(table(("expected (ours)", "holds"), rows))
    problems = trouble(result.rows)
    if problems:
        content.append(element("div", [element("p", problem) for problem in problems], class_="failure"))
    runs = [
        [row.sequence, row.variant.name, str(outcome.seed), outcome.status, _link(bench, outcome.run)]
        for row in result.rows
        for outcome in row.outcomes
    ]
    listing = table(("sequence", "variant", "seed", "status", "report"), runs)
    content.append(element("details", element("summary", f"{len(runs)} runs"), listing))
    return section(study.name, f"{study.title} · {study.source}", content)


def _made(facts: dict[str, Any]) -> Html:
    command = facts["command"]
    rows = [[name, text] for name, text in made_with(facts) if name != "command"]
    spec = yaml.safe_dump(facts["spec"], sort_keys=False, allow_unicode=True)
    return section(
        "made",
        "How it was made",
        element("pre", element("code", command)) if command else missing("Started by a program, no command."),
        table(("", ""), rows, "versions"),
        element("details", element("summary", "Suite"), element("pre", spec)),
    )


def _verdict(direction: Direction) -> Html:
    kind = "" if direction.holds is None else " finished" if direction.holds else " failed"
    word, _, rest = direction.verdict.partition(" ")
    if direction.holds is None:
        word, rest = "?", direction.reason
    return join(element("span", word, class_=f"status{kind}"), f" {rest}" if rest else None)


def _link(bench: Bench, run: str) -> Html | str:
    report = bench.run_folder(run).report
    return element("a", run, href=quote(report.relative_to(bench.folder).as_posix())) if report.is_file() else run


def _joined(head: list[str], rows: list[list[str]]) -> tuple[list[str], list[list[str]]]:
    """Sequence and variant as one column, which names the row."""
    joined = [[f"{sequence} · {variant}", *rest] for sequence, variant, *rest in rows]
    return [f"{head[0]} · {head[1]}", *head[2:]], joined


def _plot(bench: Bench, result: StudyResult) -> Html:
    content = base64.b64encode(plot_path(bench.folder, result).read_bytes()).decode("ascii")
    # Not wider than it is: a single chart would fill the page.
    style = "width:auto;max-width:100%"
    source = f"data:image/png;base64,{content}"
    return void("img", src=source, alt=result.study.title, class_="thumbnail", style=style)
