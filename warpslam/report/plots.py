"""PNG plots of a run: the path from above, the error over time, input beside rendering."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from warpslam.frames import FrameStatus
from warpslam.runs.panels import Panel
from warpslam.storage.atomic import replacing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from warpslam.evaluation import AteResult

_TRUTH_COLOR, _ESTIMATE_COLOR, _TROUBLE_COLOR = "0.55", "tab:blue", "tab:red"
_DEPTH_DIFFERENCE = 0.1  # [m], ends of the colour scale


def plot_top_view(path: str | Path, poses: np.ndarray, truth: np.ndarray | None, status: Sequence[str]) -> None:
    """Draw the camera path from above, over the ground truth where there is one.

    Args:
        path: PNG file to write.
        poses: Camera-to-world transforms, shape (N, 4, 4), in the frame of ``truth``.
        truth: Ground truth, shape (N, 4, 4), NaN where unknown, or None.
        status: "OK", "LOST" or "SKIPPED" a frame; the other two are marked.
    """
    figure = _figure(7, 6)
    axes = figure.add_subplot()
    across, along = top_view_axes(poses)
    if truth is not None:
        axes.plot(truth[:, across, 3], truth[:, along, 3], color=_TRUTH_COLOR, linewidth=3, label="ground truth")
    position = poses[:, :3, 3]
    axes.plot(position[:, across], position[:, along], color=_ESTIMATE_COLOR, linewidth=1.2, label="estimate")
    axes.plot(*position[0, [across, along]], "o", color=_ESTIMATE_COLOR, label="start")
    trouble = np.array([s != FrameStatus.OK for s in status])
    if trouble.any():
        axes.plot(*position[trouble][:, [across, along]].T, "x", color=_TROUBLE_COLOR, label="lost or skipped")
    axes.set(xlabel=f"{'xyz'[across]} [m]", ylabel=f"{'xyz'[along]} [m]", title="Camera path from above")
    axes.set_aspect("equal", adjustable="datalim")
    axes.grid(alpha=0.3)
    axes.legend()
    _save(figure, path)


def top_view_axes(poses: np.ndarray) -> tuple[int, int]:
    """The two world axes that span the ground, told from the cameras: people hold them upright."""
    camera_up = -poses[:, :3, 1].mean(axis=0)
    up = int(np.argmax(np.abs(camera_up)))
    across, along = (axis for axis in range(3) if axis != up)
    return across, along


def plot_error(
    path: str | Path,
    timestamps: np.ndarray,
    error: AteResult | None,
    losses: dict[str, np.ndarray],
    status: Sequence[str],
) -> None:
    """Draw the position error over time, or the tracking losses where there is no ground truth.

    Args:
        path: PNG file to write.
        timestamps: Times [s], shape (N,).
        error: Absolute trajectory error of the same frames.
        losses: Values of each loss, shape (N,), NaN where a frame has none.
        status: "OK", "LOST" or "SKIPPED" a frame; the other two are marked.
    """
    figure = _figure(9, 4)
    axes = figure.add_subplot()
    elapsed = timestamps - timestamps[0]
    if error is not None:
        axes.plot(elapsed[error.frame_indices], 100 * error.errors, color=_ESTIMATE_COLOR)
        axes.axhline(100 * error.rmse, color=_TRUTH_COLOR, linestyle="--", label=f"ATE RMSE {100 * error.rmse:.2f} cm")
        how = "aligned" if error.aligned else "not aligned"
        axes.set(ylabel="position error [cm]", title=f"Error against ground truth ({how})")
        axes.set_ylim(bottom=0)
    else:
        for name, values in losses.items():
            axes.plot(elapsed, values, label=name)
        axes.set(ylabel="loss", title="Tracking losses (no ground truth)")
        if losses:
            axes.set_yscale("log")
    for number, time in enumerate(elapsed[[s != FrameStatus.OK for s in status]]):
        axes.axvline(time, color=_TROUBLE_COLOR, alpha=0.3, label="lost or skipped" if number == 0 else None)
    axes.set_xlabel("time [s]")
    axes.grid(alpha=0.3)
    if axes.get_legend_handles_labels()[0]:
        axes.legend()
    _save(figure, path)


def plot_panels(path: str | Path, panels: list[Panel]) -> None:
    """Draw input, rendering and difference of some frames, colour on the left and depth on the right.

    All depth images share one scale; grey is missing depth. A positive depth difference is a surface rendered too far.

    Args:
        path: PNG file to write.
        panels: Frames, one a row.
    """
    height, width = panels[0].depth.shape
    image_width, gap, label = 3.0, 0.1, 0.55  # [inch]
    image_height = image_width * height / width
    figure_width = 6 * image_width + 7 * gap + label
    figure_height = len(panels) * (image_height + gap) + 2 * label
    # Places are known beforehand; a layout engine takes seconds to find them for this many axes.
    figure = _figure(figure_width, figure_height, layout=None)
    grid = figure.subplots(
        len(panels),
        6,
        squeeze=False,
        gridspec_kw={
            "left": label / figure_width,
            "right": 1 - label / 2 / figure_width,
            "bottom": label / figure_height,
            "top": 1 - label / figure_height,
            "wspace": gap / image_width,
            "hspace": gap / image_height,
        },
    )
    measured = np.concatenate([panel.depth[panel.depth > 0].ravel() for panel in panels])
    near, far = np.percentile(measured, [1, 99]) if len(measured) else (0.0, 1.0)
    titles = ("input", "rendered", "difference", "input depth [m]", "rendered depth [m]", "depth difference [m]")
    for column, title in enumerate(titles):
        grid[0, column].set_title(title)
    for row, panel in zip(grid, panels, strict=True):
        rgb = panel.rgb / 255.0
        valid = panel.depth > 0
        row[0].imshow(rgb)
        row[1].imshow(np.clip(panel.rendered_rgb, 0, 1))
        row[2].imshow(np.abs(rgb - panel.rendered_rgb).mean(axis=2), cmap="magma", vmin=0, vmax=0.5)
        row[3].imshow(np.ma.masked_array(panel.depth, ~valid), cmap="turbo", vmin=near, vmax=far)
        depth_image = row[4].imshow(panel.rendered_depth, cmap="turbo", vmin=near, vmax=far)
        difference = np.ma.masked_array(panel.rendered_depth - panel.depth, ~valid)
        error_image = row[5].imshow(difference, cmap="coolwarm", vmin=-_DEPTH_DIFFERENCE, vmax=_DEPTH_DIFFERENCE)
        row[0].set_ylabel(f"frame {panel.index}")
        for axes in row:
            axes.set(xticks=[], yticks=[], facecolor="0.6")
    for axes, image in ((grid[-1, 4], depth_image), (grid[-1, 5], error_image)):
        figure.colorbar(image, cax=axes.inset_axes([0.05, -0.12, 0.9, 0.06]), orientation="horizontal")
    _save(figure, path)


def _figure(width: float, height: float, layout: Literal["constrained"] | None = "constrained") -> Figure:
    # Figure, not pyplot: no window system, no global state that would outlive the call.
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout=layout)


def _save(figure: Any, path: str | Path) -> None:
    with replacing(Path(path)) as partial:
        figure.savefig(partial, dpi=100, format="png")
