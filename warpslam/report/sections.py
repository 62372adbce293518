"""The report of a run: its page, and the sections on what came out."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

import numpy as np

from warpslam.errors import MeshError
from warpslam.evaluation import depth_l1, load_mesh, psnr
from warpslam.frames import FrameStatus
from warpslam.report import charts
from warpslam.report.accounts import (
    frames_section,
    memory_section,
    settings_section,
    timing_section,
    versions_section,
)
from warpslam.report.data import RunData, axis_name, upright_axes
from warpslam.report.page import Html, element, figures, join, legend, missing, page, section, table, void
from warpslam.report.pictures import VIEW_HEIGHT, VIEW_WIDTH, MeshView, color_map, color_stops, data_uri, mesh_views
from warpslam.report.text import centimetres, decibels, duration, number, percent
from warpslam.report.turntable import turntable

NO_TRUTH = "The sequence has no ground truth, so there is no error to measure."
NO_POSES = "The run stopped before its first frame, so there is no trajectory."
DEPTH_DIFFERENCE = 0.1  # [m], ends of the colour scale
COLOR_DIFFERENCE = 0.5
SHOWN_OVERLAP = 0.2


def run_page(run: RunData, folder: Path | None = None) -> Html:
    """The report of a run.

    Args:
        run: The run.
        folder: Where the page will lie, for its links to files of the run; None for beside them.
    """
    trajectory, pixels = trajectory_section(run)
    sections = [
        ("figures", "Figures", figures_section(run)),
        ("trajectory", "Trajectory", trajectory),
        ("error", "Error", error_section(run)),
        ("images", "Images", images_section(run)),
        ("mesh", "Mesh", mesh_section(run)),
        ("keyframes", "Keyframes", keyframes_section(run)),
        ("timing", "Timing", timing_section(run)),
        ("memory", "Memory", memory_section(run)),
        ("frames", "Frames", frames_section(run)),
        ("settings", "Settings", settings_section(run)),
        ("versions", "Versions", versions_section(run)),
        ("files", "Files", files_section(run, folder)),
    ]
    return page(f"{run.name} · warpslam", run_header(run), sections, _cursor_data(run, pixels))


def run_header(run: RunData) -> Html:
    """Name, state and circumstances of a run."""
    metrics = run.metrics
    status, frames = metrics.status or "unknown", metrics.frames
    facts = [
        f"{frames.processed} of {frames.selected} frames" if frames.processed is not None else None,
        metrics.method,
        f"on {metrics.device}" if metrics.device else None,
        f"seed {metrics.seed}" if metrics.seed is not None else None,
        f"started {metrics.started}".replace("T", " ") if metrics.started else None,
    ]
    error = metrics.error
    return join(
        element("p", "warpslam run", class_="kicker"),
        element("h1", run.name, " ", element("span", status, class_=f"status {status}")),
        element("p", " · ".join(fact for fact in facts if fact), class_="facts"),
        element("p", element("strong", "The run failed. "), str(error), class_="failure") if error else None,
    )


def figures_section(run: RunData) -> Html:
    """Headline figures."""
    metrics, surface, rendering = run.metrics, run.metrics.reconstruction, run.metrics.rendering
    ate, fps, share = metrics.ate_m.aligned.rmse, metrics.fps, surface.completion_ratio_5cm
    no_surface = surface.error or metrics.mesh.error or "no true surface to compare with"
    frames, compiling = metrics.frames.processed, duration(metrics.seconds.kernel_compile) or "no time"
    parts = [f"{count} {name}" for name, count in metrics.frames.by_status]
    rows = [
        ("ATE RMSE", centimetres(ate), "after alignment" if ate is not None else "no ground truth"),
        ("Mesh accuracy", centimetres(surface.accuracy_m), "" if share else no_surface),
        ("Mesh completion", centimetres(surface.completion_m), _within(share, no_surface)),
        ("Depth error", centimetres(rendering.depth_l1_m), "L1 of rendered images, not the mesh"),
        ("Colour", decibels(rendering.psnr_db), "PSNR of rendered images"),
        ("Frames", None if frames is None else str(frames), ", ".join(parts)),
        ("Speed", f"{fps:.2f} fps" if fps else None, f"device {metrics.device}"),
        ("Time", duration(metrics.seconds.run), f"and {compiling} compiling"),
    ]
    return section("figures", "Figures", figures(rows))


def _within(share: float | None, reason: str) -> str:
    return reason if share is None else f"{percent(share)} within 5 cm"


def trajectory_section(run: RunData) -> tuple[Html, np.ndarray | None]:
    """The path from above, over the truth where there is one; and where each frame is in the drawing."""
    if not len(run.poses):
        return section("trajectory", "Trajectory", missing(NO_POSES)), None
    poses = run.aligned_poses
    axes = upright_axes(poses)
    ground = poses[:, :3, 3] @ axes[:2].T
    lines = [("estimate", "estimate", ground)]
    if run.truth is not None:
        lines.insert(0, ("truth", "ground truth", run.truth[:, :3, 3] @ axes[:2].T))
    points = [("start", f"start, frame {run.frame_indices[0]}", ground[0])]
    for position, status in enumerate(run.statuses):
        if status != FrameStatus.OK:
            points.append((status, f"frame {run.frame_indices[position]}: {status}", ground[position]))
    chart, pixels = charts.ground_chart(
        "Camera path from above", lines, axis_names=(axis_name(axes[0]), axis_name(axes[1])), points=points, cursor=True
    )
    entries = [("estimate", "estimate"), ("start", "start")]
    if run.truth is not None:
        entries.insert(0, ("truth", "ground truth"))
    entries += [(status, status) for status in sorted({*run.statuses} - {FrameStatus.OK})]
    length = float(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum())
    seconds = run.timestamps[-1] - run.timestamps[0]
    caption = f"Seen from above; the path is {length:.2f} m long and takes {duration(float(seconds))}."
    if run.truth is None:
        caption += " There is no ground truth to compare it with."
    content = [element("figure", chart, legend(*entries), element("figcaption", caption)), _error_table(run)]
    return section("trajectory", "Trajectory", content), pixels


def _error_table(run: RunData) -> Html:
    ate, rpe = run.metrics.ate_m, run.metrics.rpe
    rows = []
    for title, error, scale, unit in (
        ("ATE aligned", ate.aligned, 100, " cm"),
        ("ATE unaligned", ate.unaligned, 100, " cm"),
        ("RPE translation", rpe.translation_m, 100, " cm"),
        ("RPE rotation", rpe.rotation_deg, 1, "°"),
    ):
        values = (error.rmse, error.mean, error.median, error.max)
        if error.rmse is not None:
            rows.append([title, *("–" if value is None else f"{scale * value:.3f}{unit}" for value in values)])
    return table(("", "RMSE", "mean", "median", "largest"), rows, "numbers") if rows else missing(NO_TRUTH)


def error_section(run: RunData) -> Html:
    """Error over time, and what the tracker itself knew."""
    if not len(run.poses):
        return section("error", "Error over time", missing(NO_POSES))
    x = run.timestamps - run.timestamps[0]
    marks = [
        (position, status, f"frame {run.frame_indices[position]}: {status}")
        for position, status in enumerate(run.statuses)
        if status != FrameStatus.OK
    ]
    content = []
    if run.ate is None:
        content.append(missing(NO_TRUTH))
    else:
        errors = np.full(len(x), np.nan)
        errors[run.ate.frame_indices] = 100 * run.ate.errors
        chart = charts.time_chart(
            "Position error over time", x, [("estimate", "position error", errors)],
            x_label="time [s]", y_label="position error [cm]", marks=marks,
            level=(100 * run.ate.rmse, f"RMSE {100 * run.ate.rmse:.2f} cm"),
        )  # fmt: skip
        skipped = run.ate.skipped_count
        unknown = f"; {skipped} frames have no truth" if skipped else ""
        caption = f"Distance from the true position, after alignment{unknown}."
        content.append(element("figure", chart, element("figcaption", caption)))
    if run.record.frames:
        content.append(_tracking_charts(run, x, marks))
    else:
        content.append(missing("The run did not record losses and inliers of its frames."))
    return section("error", "Error over time", content)


def _tracking_charts(run: RunData, x: np.ndarray, marks: Sequence[tuple[int, str, str]]) -> Html:
    values = run.record.losses
    names = sorted(values, key=lambda name: (name != "tracking", name))
    losses = [(f"c{n % 6}", name, values[name]) for n, name in enumerate(names)]
    content = []
    if losses:
        chart = charts.time_chart(
            "Losses over time",
            x,
            losses,
            x_label="time [s]",
            y_label="loss",
            marks=marks,
            logarithmic=True,
            bridge=True,
        )
        entries = legend(*((key, name) for key, name, _ in losses))
        content.append(element("figure", chart, entries, element("figcaption", "Mean loss per ray, by stage.")))
    inliers = np.array([100 * result.inliers for result in run.record.results])
    chart = charts.time_chart(
        "Inliers over time", x, [("estimate", "inliers", inliers)],
        x_label="time [s]", y_label="inliers [%]", marks=marks, top=105.0,
    )  # fmt: skip
    caption = "Share of the depth that agrees with what is expected at the pose: the keyframe's, or the map's."
    content.append(element("figure", chart, element("figcaption", caption)))
    if any(result.correlation is not None for result in run.record.results):
        content += _certainty_charts(run, x, marks)
    return element("div", content, class_="pair")


def _certainty_charts(run: RunData, x: np.ndarray, marks: Sequence[tuple[int, str, str]]) -> list[Html]:
    """How alike the frames are to their keyframes, and how far the estimated poses may be off."""
    results = run.record.results
    correlation = np.array([np.nan if one.correlation is None else one.correlation for one in results])
    sigma = np.array([1000 * one.sigma[0] for one in results])
    likeness = charts.time_chart(
        "Correlation over time", x, [("estimate", "correlation", correlation)],
        x_label="time [s]", y_label="correlation of grey values", marks=marks, top=1.05,
    )  # fmt: skip
    spread = charts.time_chart(
        "Uncertainty over time", x, [("estimate", "sigma", sigma)],
        x_label="time [s]", y_label="standard deviation [mm]", marks=marks,
    )  # fmt: skip
    return [
        element("figure", likeness, element("figcaption", "Grey values of a frame and of its keyframe.")),
        element("figure", spread, element("figcaption", "Of the position, in the direction that is least certain.")),
    ]


def images_section(run: RunData) -> Html:
    """Input, rendering and difference of some frames."""
    if not run.panels:
        return section("images", "Input and rendering", missing("The run rendered no images of its map."))
    measured = np.concatenate([panel.depth[panel.depth > 0] for panel in run.panels])
    near, far = np.percentile(measured, [1, 99]) if len(measured) else (0.0, 1.0)
    blocks = []
    for panel in run.panels:
        known = panel.depth > 0
        rgb = panel.rgb / 255.0
        error = np.abs(rgb - panel.rendered_rgb).mean(axis=2)
        rendered = np.rint(255 * np.clip(panel.rendered_rgb, 0, 1)).astype(np.uint8)
        difference = panel.rendered_depth - panel.depth
        pictures = [
            ("input", panel.rgb),
            ("rendered", rendered),
            ("difference", color_map(error, "magma", 0, COLOR_DIFFERENCE)),
            ("input depth", color_map(panel.depth, "turbo", near, far, known)),
            ("rendered depth", color_map(panel.rendered_depth, "turbo", near, far)),
            ("depth difference", color_map(difference, "coolwarm", -DEPTH_DIFFERENCE, DEPTH_DIFFERENCE, known)),
        ]
        cells = [
            element("figure", void("img", src=data_uri(image), alt=f"frame {panel.index}: {title}", loading="lazy"),
                    element("figcaption", title))
            for title, image in pictures
        ]  # fmt: skip
        depth_error = centimetres(depth_l1(panel.rendered_depth, panel.depth)) if known.any() else "unknown"
        likeness = decibels(psnr(panel.rendered_rgb, panel.rgb))
        heading = element("h3", f"Frame {panel.index}", element("small", f"PSNR {likeness} · depth L1 {depth_error}"))
        blocks.append(element("div", heading, element("div", cells, class_="six"), class_="panel"))
    scales = element(
        "div",
        _color_scale("magma", "0", f"{COLOR_DIFFERENCE:g}", "colour difference"),
        _color_scale("turbo", f"{near:.2f} m", f"{far:.2f} m", "depth; grey is missing"),
        _color_scale("coolwarm", f"−{100 * DEPTH_DIFFERENCE:g} cm", f"+{100 * DEPTH_DIFFERENCE:g} cm",
                     "rendered too near or too far"),
        class_="scales",
    )  # fmt: skip
    note = "What came in, what the final map renders from the estimated pose, and the difference."
    return section("images", "Input and rendering", element("p", note), element("div", blocks, class_="panels"), scales)


def _color_scale(name: str, low: str, high: str, title: str) -> Html:
    bar = element("span", class_="ramp", style=f"background:linear-gradient(90deg, {color_stops(name)})")
    ends = element("span", element("span", low), element("span", title), element("span", high), class_="ends")
    return element("div", bar, ends)


def mesh_section(run: RunData) -> Html:
    """The mesh from several sides, with the path of the camera."""
    title = "Mesh"
    if not run.folder.mesh.is_file():
        reason = run.metrics.mesh.error or run.metrics.error
        return section("mesh", title, missing(f"There is no mesh{': ' + reason if reason else '.'}"))
    size, surface = run.metrics.mesh, run.metrics.reconstruction
    counts = (("vertices", size.vertices), ("faces", size.faces))
    facts = [f"{count:,} {name}".replace(",", " ") for name, count in counts if count is not None]
    if size.area_m2 is not None:
        facts.append(f"{size.area_m2:.1f} m² of surface")
    views = element("div", [_mesh_figure(view, n == 0) for n, view in enumerate(views_of(run))], class_="views")
    canvas = turntable(load_mesh(run.folder.mesh), run.poses if len(run.poses) else np.eye(4)[None])
    rows: list[list[str]] = []
    if surface.error is not None:
        facts.append(f"not compared with the true surface: {surface.error}")
    elif surface.accuracy_m is None:
        facts.append("no true surface to compare it with")
    else:
        ratio = surface.completion_ratio_5cm
        rows = [
            ["Accuracy", centimetres(surface.accuracy_m) or "–", "from the mesh to the true surface"],
            ["Completion", centimetres(surface.completion_m) or "–", "from the true surface to the mesh"],
            ["Completion ratio", "–" if ratio is None else percent(ratio), "of the true surface within 5 cm"],
        ]
    figures = table(("", "", ""), rows) if rows else None
    return section("mesh", title, element("p", " · ".join(facts)), canvas, views, figures)


def views_of(run: RunData, limit: int | None = None) -> list[MeshView]:
    """Pictures of the run's mesh; none where it has no mesh, or one that can't be read any more."""
    if not run.folder.mesh.is_file():
        return []
    mesh = load_mesh(run.folder.mesh)
    if not np.isfinite(mesh.vertices).all():
        raise MeshError(f"{run.folder.mesh}: a vertex is not finite; extract it again with 'warpslam mesh'")
    return mesh_views(mesh, run.poses if len(run.poses) else np.eye(4)[None], limit)


def _mesh_figure(view: MeshView, first: bool) -> Html:
    picture = element("image", href=view.uri, width=VIEW_WIDTH, height=VIEW_HEIGHT)
    path = None
    if view.path is not None:
        path = charts.polyline(view.path[:, 0], view.path[:, 1], "overlay", "camera path")
    drawing = charts.svg(view.title, VIEW_WIDTH, VIEW_HEIGHT, [picture, *([path] if path else [])], "view")
    note = "; the line is the camera's path" if first else ""
    return element("figure", drawing, element("figcaption", view.title + note))


def files_section(run: RunData, folder: Path | None = None) -> Html:
    """Links to what the run wrote, as long as the page lies where it was written."""
    files = run.folder
    entries = [
        (files.mesh, "mesh"), (files.trajectory, "camera poses (TUM: time, position, quaternion x y z w)"),
        (files.ground_truth, "true poses of these frames"), (files.config, "settings, for --config"),
        (files.metrics, "all figures"), (files.frames, "table of the frames"), (files.timing, "times"),
        (files.map, "map, for --map"), (files.log, "what happened"),
    ]  # fmt: skip
    base = (folder or files.path).absolute()
    items = [
        element("li", element("a", path.name, href=quote(os.path.relpath(path.absolute(), base))), " ",
                element("span", what))
        for path, what in entries if path.is_file()
    ]  # fmt: skip
    if not items:
        return section("files", "Files", missing("The run left no other files."))
    return section("files", "Files", element("ul", items, class_="files"))


def keyframes_section(run: RunData) -> Html:
    """Keyframes along the path, and which of them see the same."""
    title = "Keyframes"
    frames = run.metrics.keyframes.frames
    if not frames or not len(run.poses):
        return section("keyframes", title, missing("The run recorded no keyframes."))
    axes = upright_axes(run.poses)
    ground = run.poses[:, :3, 3] @ axes[:2].T
    numbers = run.frame_indices
    frames = [frame for frame in frames if frame < len(ground)]
    points = [("keyframe", f"keyframe {n}: frame {numbers[frame]}", ground[frame]) for n, frame in enumerate(frames)]
    pairs = [
        (a, b, share) for a, b, share in run.metrics.keyframes.overlaps
        if share >= SHOWN_OVERLAP and max(a, b) < len(frames)
    ]  # fmt: skip
    links = [
        (a, b, share, f"frames {numbers[frames[a]]} and {numbers[frames[b]]}: {percent(share)} in common")
        for a, b, share in pairs
    ]
    number_of = {frame: n for n, frame in enumerate(frames)}
    loops = [pair for pair in run.metrics.loops.edges if all(frame in number_of for frame in pair)]
    links += [
        (number_of[a], number_of[b], 1.0, f"loop: frames {numbers[a]} and {numbers[b]} show one place")
        for a, b in loops
    ]
    chart, _ = charts.ground_chart(
        "Keyframes from above", [("faint", "camera path", ground)],
        axis_names=(axis_name(axes[0]), axis_name(axes[1])), points=points, links=links,
    )  # fmt: skip
    caption = (
        f"{len(frames)} keyframes; {len(pairs)} pairs see at least {100 * SHOWN_OVERLAP:.0f} % of the same space. "
        "The stronger a line, the more they share."
    )
    content: list[Html] = [element("figure", chart, element("figcaption", caption))]
    if run.metrics.has("loops"):
        content.append(element("p", f"Loops: {run.metrics.loops.text}."))
    return section("keyframes", title, content)


def _cursor_data(run: RunData, pixels: np.ndarray | None) -> str:
    """What the script shows of the frame under the pointer: where it is, and what to say about it."""
    if pixels is None:
        return "null"
    errors = np.full(len(pixels), np.nan)
    if run.ate is not None:
        errors[run.ate.frame_indices] = run.ate.errors
    elapsed = run.timestamps - run.timestamps[0]
    said = [
        f"frame {index} · {number(float(t))} s · {status}" + (f" · {centimetres(float(e))}" if np.isfinite(e) else "")
        for index, t, status, e in zip(run.frame_indices, elapsed, run.statuses, errors, strict=True)
    ]
    across = charts.Scale(0.0, float(elapsed[-1]), charts.LEFT, charts.WIDTH - charts.RIGHT)
    data = {"time": np.round(across(elapsed), 1).tolist(), "path": np.round(pixels, 1).tolist(), "text": said}
    return json.dumps(data, ensure_ascii=False, separators=(",", ":"))
