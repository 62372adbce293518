"""Charts: scales, gaps, and what is done with very many frames."""

from __future__ import annotations

import re

import numpy as np
import pytest

from tests.report.html_checks import Page
from warpslam.report import charts
from warpslam.report.page import Html, element, void


@pytest.mark.parametrize(("low", "high"), [(0, 1), (0, 83.7), (-0.003, 0.0041), (2.6, 3.4), (0, 1e6)])
def test_ticks_are_round_and_inside(low, high):
    """Between two and the wanted number of steps, each 1, 2 or 5 times a power of ten."""
    steps = charts.ticks(low, high, 5)
    assert 2 <= len(steps) <= 6 and min(steps) >= low and max(steps) <= high
    step = steps[1] - steps[0]
    assert min(abs(step / 10 ** np.floor(np.log10(step) + 1e-9) - digit) for digit in (1, 2, 5)) < 1e-6
    assert charts.ticks(1.0, 1.0) == [1.0]


def test_lines_break_where_nothing_is_known():
    """A NaN parts a line in two; a line of nothing has no path."""
    x = np.arange(5.0)
    assert charts.polyline(x, np.array([1, 2, np.nan, 4, 5]), "c0").count("M") == 2
    assert 'd=""' in charts.polyline(x, np.full(5, np.nan), "c0")


def test_what_only_some_frames_have_is_joined():
    """A loss of every fifth frame is one line, not a row of points that no one sees."""
    y = np.where(np.arange(20) % 5 == 0, 1.0 + np.arange(20), np.nan)
    for bridge, strokes in ((True, 3), (False, 0)):
        chart = charts.time_chart("t", np.arange(20.0), [("c0", "a", y)], x_label="x", y_label="y", bridge=bridge)
        assert re.search(r'd="([^"]*)"', chart)[1].count("L") == strokes


def test_long_lines_are_thinned_and_keep_their_peaks():
    """Of 20000 points few are drawn, the single peak among them."""
    y = np.zeros(20_000)
    y[12_345] = 77.0
    path = charts.polyline(np.arange(20_000.0), y, "c0")
    assert path.count("L") < 2 * charts.MAX_POINTS and "12345.0 77.0" in path


def test_time_chart_survives_odd_values():
    """Zeros on a logarithmic scale, nothing but NaN, a single frame: all are drawn without NaN in the markup."""
    for x, y in (
        (np.arange(3.0), np.array([0.0, 1e-3, 10.0])),
        (np.arange(2.0), np.full(2, np.nan)),
        (np.zeros(1), np.ones(1)),
    ):
        for logarithmic in (False, True):
            chart = charts.time_chart(
                "losses",
                x,
                [("c0", "a", y)],
                x_label="t",
                y_label="v",
                logarithmic=logarithmic,
                marks=[(0, "LOST", "x")],
            )
            assert Page(chart).problems == [] and "nan" not in chart and "inf" not in chart


def test_bars_of_many_frames_are_gathered_and_one_giant_is_cut():
    """No more bars than fit; a first frame a hundred times as long does not flatten the rest, and its value is told."""
    times = np.full(1000, 1.0)
    chart = charts.stacked_bars("time", list(range(1000)), [("c0", "mapping", times)], x_label="frame", y_label="s")
    assert chart.count("<rect") == charts.MAX_BARS and "frames 0 to 5, mean" in chart
    times = np.full(20, 1.0)
    times[0] = 100.0
    chart = charts.stacked_bars("time", list(range(20)), [("c0", "mapping", times)], x_label="frame", y_label="s")
    heights = [float(height) for height in re.findall(r'height="([\d.]+)"', chart)]
    assert "↑ 100 s" in chart and heights[1] > 0.7 * heights[0]


def test_ground_chart_keeps_proportions():
    """A metre is as long across as it is up, and the cursor's pixels are those of the path."""
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    _, pixels = charts.ground_chart("path", [("estimate", "e", square)], axis_names=("x", "y"), cursor=True)
    across, up = pixels[1] - pixels[0], pixels[2] - pixels[1]
    assert across[0] == pytest.approx(-up[1]) and across[0] > 100 and abs(across[1]) + abs(up[0]) < 1e-9
    still, _ = charts.ground_chart("path", [("estimate", "e", square[:1])], axis_names=("x", "y"))
    assert "nan" not in still


def test_elements_escape_text_and_attributes():
    """Text is escaped unless it is markup already; attributes always; None and False are left out."""
    inner = element("b", '<i> & "')
    assert inner == "<b>&lt;i&gt; &amp; &quot;</b>"
    assert (
        element("p", inner, None, ["x", Html("<br>")], class_='a"b', hidden=False)
        == f'<p class="a&quot;b">{inner}x<br></p>'
    )
    assert void("img", alt="", stroke_width=1.50) == '<img alt="" stroke-width="1.5">'
