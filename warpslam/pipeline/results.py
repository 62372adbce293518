"""What a run has come to, as files: trajectory, map, mesh and plots, and the figures that they give."""

from __future__ import annotations

import logging
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from warpslam.errors import DatasetError, InputError, MeshError
from warpslam.evaluation import (
    DEFAULT_PROTOCOL,
    AteResult,
    ReconstructionResult,
    ate,
    evaluate_mesh,
    reconstruction_metrics,
    rendering_metrics,
    trajectory_metrics,
)
from warpslam.meshing import write_mesh
from warpslam.report.plots import plot_error, plot_panels, plot_top_view
from warpslam.runs.panels import PANEL_COUNT, Panel, panel_stride, save_panels
from warpslam.spread import spread
from warpslam.storage.atomic import PARTIAL
from warpslam.storage.tum import write_tum

if TYPE_CHECKING:
    import trimesh

    from warpslam.pipeline.methods import Method
    from warpslam.runs.folder import RunFolder
    from warpslam.runs.metrics import RunMetrics
    from warpslam.runs.record import RunRecord
    from warpslam.sequences.base import Frame, RgbdSequence
    from warpslam.trajectory import Trajectory

log = logging.getLogger(__name__)


def trajectory_of(slam: Method, record: RunRecord) -> Trajectory:
    """Poses of the frames in the record.

    Before them a map that was loaded has those of its own frames, and after an interrupt there may be one of a frame
    that never came back.
    """
    trajectory = slam.trajectory
    part = slice(record.first_index, record.first_index + len(record.results))
    return replace(
        trajectory,
        timestamps=trajectory.timestamps[part],
        poses=trajectory.poses[part],
        status=trajectory.status[part],
    )


def write_trajectory(folder: RunFolder, trajectory: Trajectory, record: RunRecord) -> None:
    """Write the poses, and the true ones where there are any."""
    write_tum(folder.trajectory, trajectory.timestamps, trajectory.poses)
    if record.has_truth:
        write_tum(folder.ground_truth, trajectory.timestamps, record.truth)


def remove_leftovers(folder: RunFolder) -> None:
    """Remove files that were not written in full; half a map may be what filled the disk."""
    for leftover in folder.path.glob(f"*{PARTIAL}"):
        leftover.unlink(missing_ok=True)


def rescue_trajectory(folder: RunFolder, trajectory: Trajectory, record: RunRecord) -> None:
    """Write the trajectory of a run that failed: into its folder, or else to where temporary files are."""
    try:
        write_trajectory(folder, trajectory, record)
    except OSError:
        rescued = Path(tempfile.mkdtemp(prefix=f"warpslam_{folder.path.name}_")) / "trajectory.tum"
        write_tum(rescued, trajectory.timestamps, trajectory.poses)
        log.error("%s can't be written: the trajectory so far is in %s", folder.trajectory, rescued)


def evaluate_trajectory(trajectory: Trajectory, record: RunRecord, metrics: RunMetrics) -> AteResult | None:
    """Error after alignment; None without ground truth."""
    try:
        error = ate(trajectory.poses, record.truth)
    except InputError as reason:
        log.info("no trajectory error: %s", reason)
        return None
    metrics.fill(trajectory_metrics(trajectory.poses, record.truth))
    return error


def write_map(folder: RunFolder, slam: Method, record: RunRecord, metrics: RunMetrics) -> None:
    """Write the map, and note what it takes and what it holds."""
    metrics.fill({"map": {"bytes": slam.map_bytes, "flops_per_point": slam.flops_per_point}})
    with record.clock("inventory"):
        metrics.fill(slam.inventory())
    with record.clock("saving"):
        slam.save(folder.map)


def extract_and_write_mesh(folder: RunFolder, slam: Method, record: RunRecord, metrics: RunMetrics) -> None:
    """Write the mesh of the map, or note why there is none."""
    try:
        with record.clock("meshing"):
            mesh = slam.mesh()
            write_mesh(mesh, folder.mesh)
    except MeshError as error:
        metrics.fill({"mesh": {"error": str(error)}})
        if isinstance(error.__cause__, OSError):  # it is no matter of the map that the disk is full
            raise
        log.error("no mesh: %s", error)
        return
    metrics.fill({"mesh": size_of_mesh(mesh)})


def size_of_mesh(mesh: trimesh.Trimesh) -> dict[str, float]:
    """As metrics.json has it."""
    return {"vertices": len(mesh.vertices), "faces": len(mesh.faces), "area_m2": float(mesh.area)}


def evaluate_reconstruction(
    folder: RunFolder,
    truth_mesh: trimesh.Trimesh | None,
    sequence: RgbdSequence,
    trajectory: Trajectory,
    record: RunRecord,
    metrics: RunMetrics,
    device: str | None,
) -> ReconstructionResult | None:
    """The mesh against the true surface; None where there is none of them."""
    if truth_mesh is None or not folder.mesh.is_file():
        return None
    # What counts is decided at true poses: a wrong trajectory must not choose what it is judged by.
    is_known = np.isfinite(record.truth).all(axis=(1, 2))
    poses = np.where(is_known[:, None, None], record.truth, trajectory.poses)
    indices = [record.frame_indices[position] for position in record.usable]
    try:
        with record.clock("evaluation"):
            results = evaluate_mesh(folder.mesh, truth_mesh, sequence, indices, poses[record.usable], device=device)
    except (MeshError, DatasetError) as error:
        log.error("no reconstruction metrics: %s", error)
        metrics.fill({"reconstruction": {"error": str(error)}})
        return None
    metrics.fill({"reconstruction": reconstruction_metrics(results[DEFAULT_PROTOCOL])})
    return results[DEFAULT_PROTOCOL]


def draw_plots(folder: RunFolder, trajectory: Trajectory, error: AteResult | None, record: RunRecord) -> None:
    """Draw the path from above, and the error over time."""
    poses, truth = trajectory.poses, None
    if error is not None:
        poses, truth = np.einsum("ij,njk->nik", error.T_truth_estimate, poses), record.truth
    with record.clock("plotting"):
        plot_top_view(folder.top_view, poses, truth, trajectory.status)
        plot_error(folder.error_plot, trajectory.timestamps, error, record.losses, trajectory.status)


def draw_panels(
    folder: RunFolder,
    slam: Method,
    sequence: RgbdSequence,
    trajectory: Trajectory,
    record: RunRecord,
    metrics: RunMetrics,
) -> None:
    """Draw a few frames beside what the map renders from their poses, and note how alike they are."""
    usable = record.usable
    positions = [usable[i] for i in spread(len(usable), PANEL_COUNT)]
    stride = panel_stride(sequence.intrinsics.width)
    try:
        frames = [sequence[record.frame_indices[position]] for position in positions]
    except DatasetError as error:
        log.error("no panels: %s", error)
        return
    with record.clock("rendering"):
        panels = [
            render_panel(slam, frame, trajectory.poses[position], stride)
            for frame, position in zip(frames, positions, strict=True)
        ]
    with record.clock("plotting"):
        plot_panels(folder.panels, panels)
        save_panels(folder.panel_images, panels)
    metrics.fill({"rendering": rendering_metrics(panels)})


def render_panel(slam: Method, frame: Frame, T_world_camera: np.ndarray, stride: int = 1) -> Panel:
    """A frame beside what the map renders from ``T_world_camera`` (4, 4), every ``stride``-th pixel of both."""
    image = slam.render(T_world_camera, stride=stride)
    rgb, depth = frame.rgb[::stride, ::stride], frame.depth[::stride, ::stride]
    return Panel(frame.index, rgb, depth, np.asarray(image.rgb), np.asarray(image.depth))
