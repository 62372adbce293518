"""Several runs side by side."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from warpslam.report import charts
from warpslam.report.data import RunData
from warpslam.report.page import Html, element, figures, join, missing, page, section, table, void, write_page
from warpslam.report.sections import views_of
from warpslam.report.text import centimetres, decibels, duration, megabytes, percent
from warpslam.runs.folder import RunFolder
from warpslam.runs.metrics import RunMetrics
from warpslam.runs.record import FINISHED


@dataclass(frozen=True)
class Figure:
    """A figure of each run."""

    title: str
    """Its name."""

    value: Callable[[RunMetrics], float | None]
    """Where metrics.json has it."""

    text: Callable[[float], str | None]
    """How it is written."""

    lower_is_better: bool = True
    """Which value is best."""


FIGURES = (
    Figure("ATE RMSE", lambda run: run.ate_m.aligned.rmse, centimetres),
    Figure("Mesh accuracy", lambda run: run.reconstruction.accuracy_m, centimetres),
    Figure("Mesh completion", lambda run: run.reconstruction.completion_m, centimetres),
    Figure("Within 5 cm", lambda run: run.reconstruction.completion_ratio_5cm, percent, lower_is_better=False),
    Figure("Depth L1", lambda run: run.rendering.depth_l1_m, centimetres),
    Figure("PSNR", lambda run: run.rendering.psnr_db, decibels, lower_is_better=False),
    Figure("Speed", lambda run: run.fps, lambda fps: f"{fps:.2f} fps", lower_is_better=False),
    Figure("Time", lambda run: run.seconds.run, duration),
    Figure("Peak memory", lambda run: run.peak_memory_mib, lambda mib: megabytes(mib * 2**20)),
)


def write_comparison(path: str | Path, runs: Sequence[RunFolder | RunData]) -> Path:
    """Write a page that compares runs.

    Args:
        path: HTML file.
        runs: Run folders or what was gathered of them, in the order of the page; each links to its own report where
            that lies beside it.

    Raises:
        DatasetError: A file of a run is damaged.
        MeshError: A mesh can't be read.
        ConfigError: The page can't be written there.
    """
    path = Path(path)
    gathered = [run if isinstance(run, RunData) else RunData.gather(run) for run in runs]
    names = run_names(gathered)
    sections = [
        ("table", "Figures", table_section(gathered, names, path.parent)),
        ("bars", "Bars", bars_section(gathered, names)),
        ("meshes", "Meshes", meshes_section(gathered, names)),
        ("runs", "Runs", runs_section(gathered, names)),
    ]
    sequences = sorted({run.name for run in gathered})
    header = join(
        element("p", "warpslam comparison", class_="kicker"),
        element("h1", f"{len(gathered)} runs"),
        element("p", " · ".join(sequences), class_="facts"),
    )
    return write_page(page("Comparison · warpslam", header, sections), path)


def run_names(runs: Sequence[RunData]) -> list[str]:
    """A name a run, as short as tells them apart: the ends of their folders."""
    paths = [run.folder.path.resolve().parts for run in runs]
    for length in range(1, max(map(len, paths), default=1) + 1):
        names = ["/".join(parts[-length:]) for parts in paths]
        if len(set(names)) == len(names):
            return names
    return [f"{'/'.join(parts[-1:])} ({n})" for n, parts in enumerate(paths, start=1)]


def table_section(runs: Sequence[RunData], names: Sequence[str], base: Path) -> Html:
    """All figures; the best of each in bold, where runs went over the same frames."""
    shown = [figure for figure in FIGURES if any(figure.value(run.metrics) is not None for run in runs)]
    best = {figure: _best(figure, runs) for figure in shown}
    facts: list[tuple[str, Callable[[RunData], str]]] = [
        ("status", lambda run: run.metrics.status or "unknown"),
        ("tracked", _frames),
    ]
    if len({run.name for run in runs}) > 1:
        facts.insert(0, ("sequence", lambda run: run.name))
    if any(run.metrics.method for run in runs):
        facts.insert(0, ("method", lambda run: run.metrics.method or "–"))
    rows = []
    for run, name in zip(runs, names, strict=True):
        cells: list[str] = [_link(run, name, base)]
        cells += [text(run) for _, text in facts]
        for figure in shown:
            value = figure.value(run.metrics)
            text = "–" if value is None else figure.text(value) or "–"
            cells.append(element("strong", text) if value is not None and value == best[figure] else text)
        rows.append(cells)
    head = ["run", *(title for title, _ in facts), *(figure.title for figure in shown)]
    absent = [figure.title for figure in FIGURES if figure not in shown]
    note = missing(f"No run has: {', '.join(absent)}.") if absent else None
    differs = None if same_frames(runs) else missing("The runs went over different frames, so none is called the best.")
    return section("table", "Figures", table(head, rows, "numbers"), differs, note)


def bars_section(runs: Sequence[RunData], names: Sequence[str]) -> Html:
    """Each figure as bars, one a run."""
    blocks = []
    for figure in FIGURES:
        values = [figure.value(run.metrics) for run in runs]
        known = [value for value in values if value is not None]
        if not known:
            continue
        best = _best(figure, runs)
        rows = [
            [
                name,
                "–" if value is None else figure.text(value) or "–",
                charts.value_bar(value or 0.0, max(known), "c2" if value is not None and value == best else "c0"),
            ]
            for name, value in zip(names, values, strict=True)
        ]
        order = "lower is better" if figure.lower_is_better else "higher is better"
        heading = element("h3", figure.title, element("small", order))
        blocks.append(element("div", heading, table(("", "", ""), rows, "numbers bars")))
    content = element("div", blocks, class_="pair") if blocks else missing("No run has figures to compare.")
    return section("bars", "Figure by figure", content)


def meshes_section(runs: Sequence[RunData], names: Sequence[str]) -> Html:
    """A picture of each mesh, all from above."""
    pictures = []
    for run, name in zip(runs, names, strict=True):
        views = views_of(run, limit=2)[-1:]
        if views:
            content = void("img", src=views[0].uri, alt=f"mesh of {name}", class_="thumbnail")
            pictures.append(element("figure", content, element("figcaption", element("strong", name))))
        else:
            pictures.append(element("figure", missing("no mesh"), element("figcaption", element("strong", name))))
    return section("meshes", "Meshes", element("div", pictures, class_="views"))


def runs_section(runs: Sequence[RunData], names: Sequence[str]) -> Html:
    """How each run was made."""
    blocks = []
    for run, name in zip(runs, names, strict=True):
        command = run.source.command if run.source is not None else None
        metrics = run.metrics
        error = metrics.error
        facts = [
            ("Device", metrics.device, f"warpslam {metrics.warpslam}"),
            ("Seed", None if metrics.seed is None else str(metrics.seed), ""),
        ]
        blocks.append(
            element(
                "div",
                element("h3", name, element("small", run.name)),
                element("p", f"It failed: {error}", class_="failure") if error else None,
                element("pre", element("code", command)) if command else missing("Started by a program, no command."),
                element("details", element("summary", "Settings"), figures(facts), element("pre", run.config))
                if run.config is not None
                else missing("The run did not write its settings."),
            )
        )
    return section("runs", "Runs", blocks)


def _best(figure: Figure, runs: Sequence[RunData]) -> float | None:
    if not same_frames(runs):
        return None
    # What a run that broke off saved in time or memory is no merit.
    finished = [run for run in runs if run.metrics.status == FINISHED]
    values = [value for run in finished if (value := figure.value(run.metrics)) is not None]
    if len(values) < 2:
        return None
    return min(values) if figure.lower_is_better else max(values)


def same_frames(runs: Sequence[RunData]) -> bool:
    """Whether all that came to their end went over the same frames; only then is one of them better than another."""
    finished = [run for run in runs if run.metrics.status == FINISHED]
    return len({(run.name, tuple(run.record.frame_indices)) for run in finished}) <= 1


def _frames(run: RunData) -> str:
    counts = run.metrics.frames
    return "–" if counts.OK is None or counts.selected is None else f"{counts.OK} of {counts.selected}"


def _link(run: RunData, name: str, base: Path) -> Html | str:
    """The name, leading to the run's report by a relative path where there is one below the page's folder."""
    try:
        relative = run.folder.report.resolve().relative_to(base.resolve())
    except ValueError:
        return name
    return element("a", name, href=quote(relative.as_posix())) if run.folder.report.is_file() else name
