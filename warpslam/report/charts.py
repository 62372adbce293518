"""Charts as inline SVG: paths on the ground, curves over time, bars. Their colours are CSS classes of the page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from warpslam.report.page import Html, element

WIDTH, HEIGHT = 720, 240
LEFT, RIGHT, TOP, BOTTOM = 52, 12, 12, 34
MAX_POINTS = 1500
MAX_BARS = 180
MAX_DECADES = 6


@dataclass(frozen=True)
class Scale:
    """Linear map from values to pixels; the ends may be the other way round."""

    low: float
    high: float
    start: float
    stop: float

    def __call__(self, value: np.ndarray | float) -> np.ndarray:
        """Pixel of a value."""
        share = (np.asarray(value, dtype=np.float64) - self.low) / ((self.high - self.low) or 1.0)
        return self.start + share * (self.stop - self.start)


def ticks(low: float, high: float, count: int = 5) -> list[float]:
    """Round values between ``low`` and ``high``, about ``count`` of them."""
    span = high - low
    if not span > 0:
        return [low]
    step = 10 ** np.floor(np.log10(span / count))
    step *= next(factor for factor in (1, 2, 5, 10) if span / (step * factor) <= count)
    return [round(float(k * step), 10) for k in range(int(np.ceil(low / step)), int(np.floor(high / step + 1e-9)) + 1)]


def polyline(x: np.ndarray, y: np.ndarray, class_: str, title: str | None = None) -> Html:
    """A line that breaks where a value is not finite."""
    known = np.isfinite(x) & np.isfinite(y)
    parts = []
    for run in np.split(np.arange(len(x)), np.flatnonzero(np.diff(known.astype(int))) + 1):
        if len(run) and known[run[0]]:
            keep = _thinned(y[run])
            parts.append("M" + "L".join(f"{x[i]:.1f} {y[i]:.1f}" for i in run[keep]))
    return element("path", element("title", title) if title else None, d="".join(parts), class_=f"line {class_}")


def time_chart(
    name: str,
    x: np.ndarray,
    curves: Sequence[tuple[str, str, np.ndarray]],
    *,
    x_label: str,
    y_label: str,
    marks: Sequence[tuple[int, str, str]] = (),
    level: tuple[float, str] | None = None,
    logarithmic: bool = False,
    bridge: bool = False,
    top: float | None = None,
) -> Html:
    """Curves over time or frames, with the cursor that all charts of a page share.

    Args:
        name: What a screen reader says.
        x: Position of each frame, rising, shape (N,).
        curves: (CSS class, name, values of shape (N,), NaN = none).
        x_label: With unit.
        y_label: With unit.
        marks: (frame, CSS class, what to say) of frames that stand out.
        level: A value to draw a dashed line at, and its name.
        logarithmic: Scale of the values.
        bridge: Draw on where a frame has no value, for what only some frames have.
        top: Upper end of the scale; the largest value by default.
    """
    values = np.concatenate([curve for _, _, curve in curves]) if curves else np.zeros(1)
    values = values[np.isfinite(values) & ((values > 0) | (not logarithmic))]
    low, high = (values.min(), values.max()) if len(values) else (0.1, 1.0)
    if logarithmic:
        low, high = np.floor(np.log10(low)), np.ceil(np.log10(high) + 1e-9)
        low = max(low, high - MAX_DECADES)
    else:
        low, high = 0.0, (top if top is not None else 1.06 * max(high, level[0] if level else 0) or 1.0)
    across = Scale(float(x[0]), float(x[-1]), LEFT, WIDTH - RIGHT)
    up = Scale(low, high, HEIGHT - BOTTOM, TOP)
    steps = list(np.arange(low, high + 1)) if logarithmic else ticks(low, high, 4)
    labels = [f"{10.0**step:g}" if logarithmic else f"{step:g}" for step in steps]
    drawn = [_frame(across, up, steps, labels, x_label, y_label)]
    for frame, key, text in marks:
        position = float(across(x[frame]))
        line = element("line", element("title", text), x1=position, x2=position, y1=TOP, y2=HEIGHT - BOTTOM)
        drawn.append(element("g", line, class_=f"mark {key}"))
    if level is not None and not logarithmic:
        y = float(up(level[0]))
        drawn.append(element("line", x1=LEFT, x2=WIDTH - RIGHT, y1=y, y2=y, class_="level"))
    pixels = across(x)
    with np.errstate(divide="ignore", invalid="ignore"):
        for key, title, curve in curves:
            height = up(np.log10(curve) if logarithmic else curve)
            shown = np.isfinite(height) if bridge else slice(None)
            drawn.append(polyline(pixels[shown], height[shown], key, title))
    if level is not None and not logarithmic:
        # After the curves, for its outline to part them.
        at = {"x": WIDTH - RIGHT - 4, "y": float(up(level[0])) - 5}
        drawn.append(element("text", level[1], **at, class_="level-name"))
    drawn.append(element("line", y1=TOP, y2=HEIGHT - BOTTOM, class_="cursor", visibility="hidden"))
    return svg(name, WIDTH, HEIGHT, drawn, "timeline")


def stacked_bars(
    name: str, frames: Sequence[int], parts: Sequence[tuple[str, str, np.ndarray]], *, x_label: str, y_label: str
) -> Html:
    """A bar of parts a frame; of many frames, the mean over neighbours. One bar far above all others is cut off.

    Args:
        name: What a screen reader says.
        frames: Number of each frame.
        parts: (CSS class, name, values of shape (N,)).
        x_label: With unit.
        y_label: With unit.
    """
    count = len(frames)
    groups = np.array_split(np.arange(count), min(count, MAX_BARS))
    heights = np.array([[values[group].mean() for group in groups] for _, _, values in parts]).reshape(len(parts), -1)
    across = Scale(0, len(groups), LEFT, WIDTH - RIGHT)
    totals = heights.sum(axis=0)
    top, second = float(totals.max()), float(np.sort(totals)[-2]) if len(totals) > 1 else 0.0
    # The first frame takes many times as long as the rest, which it would flatten.
    is_cut = 0 < 2.5 * second < top
    up = Scale(0, 1.25 * second if is_cut else 1.05 * top or 1.0, HEIGHT - BOTTOM, TOP)
    numbers = Scale(frames[0] - 0.5, frames[-1] + 0.5, LEFT, WIDTH - RIGHT)
    steps = ticks(0, up.high, 5)
    drawn = [_frame(numbers, up, steps, [f"{step:g}" for step in steps], x_label, y_label)]
    width = max(float(across(1) - across(0)) - (1.0 if len(groups) < 120 else 0.0), 0.5)
    for n, group in enumerate(groups):
        first, last = frames[group[0]], frames[group[-1]]
        lines = [f"frame {first}" if first == last else f"frames {first} to {last}, mean"]
        bars, base = [], 0.0
        for (key, title, _), height in zip(parts, heights[:, n], strict=True):
            if height > 0:
                lines.append(f"{title} {height:.3g} s")
            if height > 0 and up(base) > TOP:
                y = max(float(up(base + height)), TOP)
                bar = {"x": float(across(n)), "width": width, "y": y, "height": float(up(base)) - y}
                bars.append(element("rect", **bar, class_=f"fill {key}"))
            base += height
        drawn.append(element("g", element("title", "\n".join(lines)), bars))
        if totals[n] > up.high:
            beyond = {"x": float(across(n + 1)) + 4, "y": TOP + 9.0}
            drawn.append(element("text", f"↑ {totals[n]:.3g} s", **beyond, class_="cut"))
    return svg(name, WIDTH, HEIGHT, drawn, "bars")


def ground_chart(
    name: str,
    lines: Sequence[tuple[str, str, np.ndarray]],
    *,
    axis_names: tuple[str, str],
    points: Sequence[tuple[str, str, np.ndarray]] = (),
    links: Sequence[tuple[int, int, float, str]] = (),
    cursor: bool = False,
) -> tuple[Html, np.ndarray | None]:
    """Paths on the ground with one scale for both axes; returns the pixels of the last line for the cursor as well.

    Args:
        name: What a screen reader says.
        lines: (CSS class, name, positions [m] of shape (N, 2), NaN = unknown); the last one is the estimate.
        axis_names: Of the two axes.
        points: (CSS class, what to say, position [m] of shape (2,)).
        links: (a, b, strength in 0..1, what to say): lines between two of ``points``.
        cursor: Whether the chart takes part in the page's cursor.
    """
    every = np.concatenate([line for _, _, line in lines])
    every = every[np.isfinite(every).all(axis=1)]
    low, high = every.min(axis=0), every.max(axis=0)
    center, span = (low + high) / 2, np.maximum(high - low, 0.05) * 1.12
    inner = WIDTH - LEFT - RIGHT
    height = float(np.clip(inner * span[1] / span[0], 220, 520))
    scale = min(inner / span[0], height / span[1])
    half = np.array([inner, height]) / scale / 2
    across = Scale(center[0] - half[0], center[0] + half[0], LEFT, WIDTH - RIGHT)
    up = Scale(center[1] - half[1], center[1] + half[1], TOP + height, TOP)
    steps = ticks(up.low, up.high, 5)
    labels = (f"{axis_names[0]} [m]", f"{axis_names[1]} [m]")
    drawn = [_frame(across, up, steps, [f"{step:g}" for step in steps], *labels, grid=True)]
    for a, b, strength, text in links:
        (x1, y1), (x2, y2) = (points[n][2] for n in (a, b))
        ends = {"x1": float(across(x1)), "y1": float(up(y1)), "x2": float(across(x2)), "y2": float(up(y2))}
        opacity = 0.08 + 0.5 * strength
        drawn.append(element("line", element("title", text), **ends, class_="link", stroke_opacity=opacity))
    for key, title, line in lines:
        drawn.append(polyline(across(line[:, 0]), up(line[:, 1]), key, title))
    for key, text, (x, y) in points:
        at = {"cx": float(across(x)), "cy": float(up(y))}
        drawn.append(element("circle", element("title", text), **at, r=4, class_=f"point {key}"))
    if cursor:
        drawn.append(element("circle", r=6, class_="cursor", visibility="hidden"))
    drawing = svg(name, WIDTH, TOP + height + BOTTOM, drawn, "ground" if cursor else "graph")
    last = lines[-1][2]
    return drawing, np.stack([across(last[:, 0]), up(last[:, 1])], axis=1) if cursor else None


def share_bar(name: str, parts: Sequence[tuple[str, str, float]]) -> Html:
    """One bar cut into shares: (CSS class, what to say, value)."""
    total = sum(value for _, _, value in parts) or 1.0
    pieces = []
    for key, text, value in parts:
        piece = element("span", class_=f"piece {key}", title=text, style=f"width:{100 * value / total:.3f}%")
        pieces.append(piece)
    return element("div", pieces, class_="share", role="img", aria_label=name)


def value_bar(value: float, largest: float, class_: str = "") -> Html:
    """A bar in a table cell."""
    width = 100 * value / largest if largest > 0 else 0
    bar = element("span", class_=f"piece {class_}", style=f"width:{width:.2f}%")
    return element("div", bar, class_="value-bar")


def svg(name: str, width: float, height: float, content: Sequence[Html], class_: str) -> Html:
    """A drawing that fills the width it is given."""
    box = f"0 0 {width:g} {height:.0f}"
    return element("svg", content, viewBox=box, class_=class_, role="img", aria_label=name)


def _frame(
    across: Scale, up: Scale, steps: Sequence[float], labels: Sequence[str], x_label: str, y_label: str, *,
    grid: bool = False,
) -> Html:  # fmt: skip
    bottom, right = up.start, across.stop
    drawn = []
    for step, label in zip(steps, labels, strict=True):
        y = float(up(step))
        drawn.append(element("line", x1=LEFT, x2=right, y1=y, y2=y, class_="grid"))
        drawn.append(element("text", label, x=LEFT - 7, y=y + 4, class_="tick y"))
    for step in ticks(across.low, across.high, 8):
        x = float(across(step))
        if grid:
            drawn.append(element("line", x1=x, x2=x, y1=TOP, y2=bottom, class_="grid"))
        drawn.append(element("text", f"{step:g}", x=x, y=bottom + 16, class_="tick x"))
    drawn.append(element("text", x_label, x=right, y=bottom + 31, class_="label x"))
    middle = (TOP + bottom) / 2
    drawn.append(element("text", y_label, x=13, y=middle, class_="label y", transform=f"rotate(-90 13 {middle:.1f})"))
    # On a narrow page, in place of the one that stands upright.
    drawn.append(element("text", y_label, x=LEFT, y=TOP - 6.0, class_="label above", aria_hidden="true"))
    return element("g", drawn, class_="axes")


def _thinned(values: np.ndarray) -> np.ndarray:
    """Positions of at most about `MAX_POINTS` values that keep the shape: the extremes of each stretch."""
    if len(values) <= MAX_POINTS:
        return np.arange(len(values))
    keep = {0, len(values) - 1}
    for group in np.array_split(np.arange(len(values)), MAX_POINTS // 2):
        keep.update((int(group[np.argmin(values[group])]), int(group[np.argmax(values[group])])))
    return np.array(sorted(keep))
