"""What can be done with a run folder afterwards: errors, renderings, another mesh."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpslam.errors import CheckpointError, ConfigError, DatasetError, InputError, MeshError
from warpslam.evaluation import (
    DEFAULT_PROTOCOL,
    ate,
    evaluate_mesh,
    load_mesh,
    reconstruction_metrics,
    rendering_metrics,
    trajectory_metrics,
)
from warpslam.frames import FrameStatus
from warpslam.meshing import check_mesh_path, point_cloud, simplified, write_mesh, write_points
from warpslam.meshing.texture import textured, write_textured
from warpslam.pipeline.results import render_panel, size_of_mesh
from warpslam.pipeline.setup import as_configured, load_slam, open_source
from warpslam.poses import transform_poses
from warpslam.report.plots import plot_error, plot_panels, plot_top_view
from warpslam.runs.folder import RunFolder
from warpslam.runs.manifest import note_changed
from warpslam.runs.metrics import RunMetrics
from warpslam.runs.record import FINISHED, UNFINISHED, RunRecord
from warpslam.runs.timing import RunTiming
from warpslam.spread import spread
from warpslam.storage.tum import associate, read_tum

if TYPE_CHECKING:
    import trimesh

log = logging.getLogger(__name__)


def is_finished(folder: RunFolder) -> bool:
    """Whether a run has come to its end and all it wrote is there.

    Raises:
        DatasetError: Its figures are damaged.
    """
    folder.finish_taking_place()
    if not folder.metrics.is_file() or folder.is_unfinished:
        return False
    return RunMetrics.read(folder.metrics).status == FINISHED


def complete(folder: RunFolder, device: str | None = None) -> list[str]:
    """Make what is missing in the folder of a run that was ended on its last metres, of what lies there.

    Its mesh comes from its map, figures of the trajectory from the trajectory, plots from both.

    Returns:
        What was made, for the user.
    """
    if folder.is_unfinished or not folder.trajectory.is_file():
        return []
    made = []
    metrics = RunMetrics.read(folder.metrics) if folder.metrics.is_file() else RunMetrics()
    if metrics.status == FINISHED:
        return []
    times, poses = read_tum(folder.trajectory, leave_out_unknown=True)
    record, error, truth = RunRecord(), None, None
    if folder.ground_truth.is_file():
        truth_times, truth_poses = read_tum(folder.ground_truth)
        partner = associate(times, truth_times, 1e-6)
        truth = np.where((partner >= 0)[:, None, None], truth_poses[partner], np.nan)
    if metrics.status is None:
        facts = {"sequence": folder.path.name, "status": UNFINISHED, "frames": {"processed": len(times)}}
        metrics.fill(facts)
    try:
        if truth is not None:
            error = ate(poses, truth)
            metrics.fill(trajectory_metrics(poses, truth))
    except InputError as reason:
        log.info("no trajectory error: %s", reason)
    if folder.map.is_file() and not folder.mesh.is_file():
        try:
            mesh = load_slam(folder, device).mesh()
            write_mesh(mesh, folder.mesh)
            metrics.fill({"mesh": size_of_mesh(mesh)})
            made.append(folder.mesh.name)
        except (MeshError, CheckpointError, ConfigError) as reason:
            log.warning("no mesh: %s", reason)
    if not folder.top_view.is_file():
        shown = poses if error is None else transform_poses(error.T_truth_estimate, poses)
        status = [FrameStatus.OK] * len(poses)
        plot_top_view(folder.top_view, shown, None if error is None else truth, status)
        plot_error(folder.error_plot, times, error, record.losses, status)
        made.append(folder.top_view.name)
    if made or not folder.metrics.is_file():
        metrics.write(folder.metrics)
        made.append(folder.metrics.name)
    return made


def evaluate_run(
    folder: RunFolder,
    truth: str | Path | None = None,
    *,
    max_difference: float = 0.02,
    truth_mesh: str | Path | None = None,
    protocols: Sequence[str] = (DEFAULT_PROTOCOL,),
    rendered_views: int = 0,
    device: str | None = None,
) -> dict[str, Any]:
    """Errors of a run, under the names of metrics.json.

    Args:
        folder: Run.
        truth: Trajectory in the TUM format; None for the ground truth that came with the sequence.
        max_difference: Largest difference in time of an estimated and a true pose [s].
        truth_mesh: True surface to compare the mesh with.
        protocols: Culling protocols of that comparison, of `warpslam.evaluation.PROTOCOLS`. The figures of the first
            are "reconstruction"; those of all are "reconstruction_by_protocol" if there are several.
        rendered_views: Frames, evenly spread, that are rendered from the map at their estimated poses, in full, and
            compared with what the camera saw; slow without a GPU.
        device: Warp device.

    Raises:
        ConfigError: There is no such protocol or device.
        DatasetError: A file is missing or damaged, or no pose has a partner.
        MeshError: A mesh can't be read or has nothing in view.
    """
    times, poses = read_tum(folder.require(folder.trajectory, "the run stopped before its first frame"))
    truth = truth or folder.require(folder.ground_truth, "its sequence has no ground truth; name one with --truth")
    truth_times, truth_poses = read_tum(truth)
    partner = associate(times, truth_times, max_difference)
    paired = partner >= 0
    if not paired.any():
        raise DatasetError(
            f"{truth}: none of its {len(truth_times)} times is within {max_difference} s of a frame; "
            "is it the same sequence, in seconds?"
        )
    metrics: dict[str, Any] = {"frames": {"estimated": len(times), "compared": int(paired.sum())}}
    metrics.update(trajectory_metrics(poses[paired], truth_poses[partner[paired]]))
    if truth_mesh is not None:
        # What counts is decided at true poses, as in the run: a wrong trajectory must not choose what it is judged by.
        known = np.where(paired[:, None, None], truth_poses[partner], poses)
        mesh = folder.require(folder.mesh, "see metrics.json for why the run made none")
        sequence = as_configured(open_source(folder.read_source()), folder.read_config())
        indices = frame_indices(folder, len(times))
        results = evaluate_mesh(
            mesh, load_mesh(truth_mesh), sequence, indices, known, protocols=protocols, device=device
        )
        by_protocol = {name: reconstruction_metrics(result) for name, result in results.items()}
        metrics["reconstruction"] = by_protocol[protocols[0]]
        if len(by_protocol) > 1:
            metrics["reconstruction_by_protocol"] = by_protocol
    if rendered_views > 0:
        metrics["rendering"] = _rendering_metrics(folder, poses, rendered_views, device)
    return metrics


def _rendering_metrics(folder: RunFolder, poses: np.ndarray, count: int, device: str | None) -> dict[str, Any]:
    slam = load_slam(folder, device)
    sequence = as_configured(open_source(folder.read_source()), folder.read_config())
    indices = frame_indices(folder, len(poses))
    chosen = spread(len(poses), count)
    return rendering_metrics([render_panel(slam, sequence[indices[n]], poses[n]) for n in chosen])


def render_frame(folder: RunFolder, index: int, output: str | Path | None = None, device: str | None = None) -> Path:
    """Write a frame of the sequence beside what the final map renders at its estimated pose, as PNG.

    Args:
        folder: Run.
        index: Number of the frame in its sequence; the run must have used it.
        output: File to write; None for ``render_<index>.png`` in the run folder.
        device: Warp device.

    Raises:
        InputError: The run has no pose for the frame.
        DatasetError: The input or a file of the run is missing.
    """
    _, poses = read_tum(folder.require(folder.trajectory, "the run stopped before its first frame"))
    sequence = open_source(folder.read_source())
    if not 0 <= index < len(sequence):
        raise InputError(f"frame {index} is not in {sequence.name}, which has frames 0 to {len(sequence) - 1}")
    used = frame_indices(folder, len(poses))
    if index not in used:
        raise InputError(f"frame {index} was not used by the run {folder.path}, so it has no pose; choose another one")
    path = Path(output) if output is not None else folder.path / f"render_{index:06d}.png"
    slam = load_slam(folder, device)
    frame = as_configured(sequence, folder.read_config())[index]
    plot_panels(path, [render_panel(slam, frame, poses[used.index(index)])])
    return path


def extract_mesh(
    folder: RunFolder,
    voxel: float | None = None,
    output: str | Path | None = None,
    device: str | None = None,
    *,
    forecast: bool = False,
    refinement_rounds: int = 0,
    faces: int | None = None,
    points_only: bool = False,
    texture: int | None = None,
) -> tuple[trimesh.Trimesh, Path]:
    """Extract the mesh of the final map and write it. The map itself stays as the run left it.

    Args:
        folder: Run.
        voxel: Edge of a marching-cubes cell [m]; None for the setting of the run.
        output: File to write, .ply, .glb, .obj or .stl; None for mesh.ply in the run folder, or
            mesh_forecast.ply with a forecast.
        device: Warp device.
        forecast: Add what the coarse level suggests where nothing was seen, in cyan.
        refinement_rounds: Rounds of the global refinement before that.
        faces: Reduce the mesh to about so many; None for all.
        points_only: Write its vertices and their colours alone.
        texture: Width of a texture [px] in place of vertex colours; .glb and .obj have one.

    Raises:
        ConfigError: The method of the run has no refinement, or forecasts nothing.
        DatasetError: The run saved no map.
        InputError: The map can't be refined.
        MeshError: There is no surface, or the file can't be written.
        MissingDependencyError: Fewer faces need the package fast-simplification, a texture xatlas.
    """
    path = check_mesh_path(output if output is not None else folder.forecast_mesh if forecast else folder.mesh)
    slam = load_slam(folder, device)
    if refinement_rounds > 0:
        slam.refine(refinement_rounds)
    mesh = slam.mesh(voxel, forecast=forecast)
    if faces is not None:
        forecast_faces = mesh.metadata.get("forecast_faces")
        mesh = simplified(mesh, faces)
        mesh.metadata["forecast_faces"] = forecast_faces
    if texture is not None:
        scene = getattr(slam, "scene", None)
        if scene is None:
            raise ConfigError("the method of this run has no map to ask for the colours of a texture")
        mesh = textured(mesh, scene.query_color, texture)
        written = write_textured(mesh, path)
    else:
        written = write_points(point_cloud(mesh), path) if points_only else write_mesh(mesh, path)
    note_changed(folder, written)
    return mesh, written


def frame_indices(folder: RunFolder, count: int) -> list[int]:
    """Number in its sequence of each of the ``count`` frames in trajectory.tum."""
    timing = RunTiming.read(folder.require(folder.timing, "so it is unknown which frames it used"))
    indices = [frame.index for frame in timing.frames]
    if len(indices) != count:
        raise DatasetError(f"{folder.timing} has {len(indices)} frames and {folder.trajectory.name} {count}; run again")
    return indices
