"""One PNG a study: bars by sequence and variant, or curves where variants have a position."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from warpslam.bench.results import StudyResult
from warpslam.bench.studies import Metric

COLORS = ("#1f6fb5", "#d9822b", "#3b9a6d", "#b5507f", "#7a68c4", "#8a7a4a")
_MARKERS = "osD^vP"
_COLUMNS = 3
_WIDTH, _HEIGHT = 4.2, 3.2  # [inch], of one chart


def plot_study(path: str | Path, result: StudyResult) -> None:
    """Draw all figures of a study, each in a chart of its own, with error bars of one standard deviation.

    Args:
        path: PNG file to write.
        result: The study; a variant without a figure leaves a gap that says so.
    """
    from matplotlib.figure import Figure

    curves = [(row, outcome) for row in result.rows for outcome in row.outcomes if outcome.curve]
    draws: list[Any] = [(_draw_convergence, None)] if curves else []
    chart = _draw_curves if result.study.axis is not None else _draw_bars
    draws += [(chart, metric) for metric in result.metrics]
    columns = min(len(draws), _COLUMNS)
    rows = -(-len(draws) // columns)
    figure = Figure(figsize=(max(columns * _WIDTH, 5.5), rows * _HEIGHT + 0.5), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False)
    for axes, (draw, metric) in zip(grid.flat, draws, strict=False):
        draw(axes, result, metric)
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="y", alpha=0.3)
        axes.set_axisbelow(True)
    for axes in grid.flat[len(draws) :]:
        axes.set_visible(False)
    # Charts with the same names in their legends share one below them.
    handles: dict[str, Any] = {}
    for axes in grid.flat:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    if "paper" in handles:
        handles["paper"] = handles.pop("paper")  # last
    if handles:
        figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=4, frameon=False)
    figure.savefig(path, dpi=110, format="png")


def _draw_bars(axes: Any, result: StudyResult, metric: Metric) -> None:
    variants, sequences = result.variants, result.sequences
    width = 0.8 / len(variants)
    for number, variant in enumerate(variants):
        color = COLORS[number % len(COLORS)]
        places = np.arange(len(sequences)) + (number - (len(variants) - 1) / 2) * width
        rows = [result.row(sequence, variant.name) for sequence in sequences]
        summaries = [None if row is None else row.summary(metric) for row in rows]
        means = [np.nan if s is None or s.mean is None else s.mean for s in summaries]
        spreads = [0.0 if s is None or s.std is None else s.std for s in summaries]
        has_spread = any(spread > 0 for spread in spreads)
        axes.bar(places, means, 0.92 * width, yerr=spreads if has_spread else None, color=color, label=variant.name,
                 error_kw={"ecolor": "0.25", "capsize": 2.5, "linewidth": 1})  # fmt: skip
        for place, row, mean in zip(places, rows, means, strict=True):
            if row is None:
                continue
            paper = row.published.get(metric.key)
            if isinstance(paper, float | int):
                axes.hlines(paper, place - 0.46 * width, place + 0.46 * width, "black", linewidth=1.6, label="paper")
            if np.isnan(mean):
                axes.annotate("none" if any(o.is_finished for o in row.outcomes) else "failed", (place, 0),
                              rotation=90, ha="center", va="bottom", fontsize=8, color="tab:red")  # fmt: skip
    axes.set_xticks(range(len(sequences)), sequences)
    axes.set_xlim(-0.5, len(sequences) - 0.5)
    axes.set_ylim(bottom=0)
    axes.set_title(metric.heading, fontsize=10)


def _draw_curves(axes: Any, result: StudyResult, metric: Metric) -> None:
    for number, sequence in enumerate(result.sequences):
        color = COLORS[number % len(COLORS)]
        rows = [row for row in result.rows if row.sequence == sequence]
        points = [(row.variant.position, row.summary(metric)) for row in rows]
        known = [(x, s.mean, s.std or 0.0) for x, s in points if x is not None and s.mean is not None]
        if known:
            x, mean, spread = zip(*known, strict=True)
            axes.errorbar(x, mean, yerr=spread if any(spread) else None, color=color, capsize=2.5, linewidth=1.4,
                          marker=_MARKERS[number % len(_MARKERS)], markersize=4.5, label=sequence)  # fmt: skip
        paper = [(row.variant.position, row.published[metric.key]) for row in rows if metric.key in row.published]
        if paper:
            axes.plot(*zip(*paper, strict=True), color=color, linestyle=":", label=f"{sequence} (paper)")
    positions = sorted({variant.position for variant in result.variants if variant.position is not None})
    axes.set_xscale("log")
    axes.set_xticks(positions, [f"{position:g}" for position in positions])
    axes.minorticks_off()
    axes.set_xlabel(result.study.axis)
    axes.set_title(metric.heading, fontsize=10)


def _draw_convergence(axes: Any, result: StudyResult, _: None) -> None:
    """Curves of the probe, one a run: colours as the bars of the variants."""
    for number, variant in enumerate(result.variants):
        for row in result.rows:
            for outcome in row.outcomes:
                if row.variant is variant and outcome.curve:
                    x, y = zip(*outcome.curve, strict=True)
                    axes.plot(x, y, color=COLORS[number % len(COLORS)], linewidth=1.1, alpha=0.8)
    axes.set_yscale("log")
    axes.set_xlabel("iteration on the first frame")
    axes.set_title("depth L1 of the view [cm]", fontsize=10)
