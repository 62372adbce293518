"""What a run has come to, and how it gets into the run folder: trajectory, map, mesh, figures, plots and report."""

from __future__ import annotations

import csv
import logging
import os
import platform
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpslam.errors import DatasetError, InputError, MeshError, WarpSlamError
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
from warpslam.runs.folder import RunFolder
from warpslam.runs.request import Source
from warpslam.runtime.environment import peak_memory_mib
from warpslam.storage.json_files import write_json
from warpslam.storage.tum import write_tum
from warpslam.storage.writing import output_error

if TYPE_CHECKING:
    import trimesh

    from warpslam.config import Config
    from warpslam.frames import FrameResult
    from warpslam.pipeline.methods import Method
    from warpslam.runs.given_poses import GivenPoses
    from warpslam.runs.panels import Panel
    from warpslam.runtime.compilation import ModuleProgress
    from warpslam.sequences.base import Frame, RgbdSequence
    from warpslam.trajectory import Trajectory

log = logging.getLogger(__name__)
PANEL_COUNT = 4
PANEL_WIDTH = 240  # [px], at most


@dataclass(eq=False)
class RunResults:
    """State of a run that `warpslam.pipeline` fills while it goes through the frames, and the files made of it.

    frame_indices, truth_poses (4, 4; NaN where unknown), results: Of each processed frame. left_out: Index and message
    of each unreadable one. first_index: Frames of the map that the run started from. metrics: What goes into
    metrics.json beside the figures of every run. seconds: By stage.
    """

    sequence: RgbdSequence
    config: Config
    folder: RunFolder
    selected: range
    device: str | None
    seed: int
    source: Source | None
    truth_mesh: trimesh.Trimesh | None
    method: str
    given: GivenPoses | None
    modules: list[ModuleProgress] = field(default_factory=list)
    slam: Method | None = None
    status: str = "finished"
    started: datetime = field(default_factory=lambda: datetime.now().astimezone())
    frame_indices: list[int] = field(default_factory=list)
    truth_poses: list[np.ndarray] = field(default_factory=list)
    results: list[FrameResult] = field(default_factory=list)
    left_out: list[dict[str, Any]] = field(default_factory=list)
    first_index: int = 0
    seconds: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    ate: AteResult | None = None
    reconstruction: ReconstructionResult | None = None
    metrics: dict[str, Any] = field(default_factory=dict)

    def _write_input(self) -> None:
        self.config.resolved().save(self.folder.config)
        if self.source is not None:
            self.folder.write_source(self.source)
        log.info("%s: %d of %d frames, %s", self.sequence.name, len(self.selected), len(self.sequence), self.selected)

    def _write_results(self) -> None:
        """All that needs the map."""
        self._write_trajectory()
        self._evaluate_trajectory()
        self._write_map()
        self._describe_map()
        self._write_mesh()
        self._evaluate_reconstruction()
        self._draw_plots()

    def _trajectory(self) -> tuple[Trajectory, int]:
        """The trajectory, and how many of its poses belong to frames that were finished."""
        assert self.slam is not None
        trajectory = self.slam.trajectory.after(self.first_index)
        # After an interrupt the trajectory may hold the pose of a frame that never came back.
        return trajectory, len(self.results)

    def _write_trajectory(self) -> None:
        trajectory, count = self._trajectory()
        partial = self.folder.trajectory.with_name("trajectory.tum.partial")
        write_tum(partial, trajectory.timestamps[:count], trajectory.poses[:count])
        partial.replace(self.folder.trajectory)
        if self._has_truth():
            write_tum(self.folder.ground_truth, trajectory.timestamps[:count], np.array(self.truth_poses)[:count])

    def _has_truth(self) -> bool:
        return any(np.isfinite(T).all() for T in self.truth_poses)

    def _evaluate_trajectory(self) -> None:
        trajectory, count = self._trajectory()
        truth = np.array(self.truth_poses)[:count]
        try:
            self.ate = ate(trajectory.poses[:count], truth)
        except InputError as error:
            log.info("no trajectory error: %s", error)
            return
        self.metrics.update(trajectory_metrics(trajectory.poses[:count], truth))

    def _write_map(self) -> None:
        assert self.slam is not None
        with self._clock("saving"):
            self.slam.save(self.folder.map)
        self.metrics["map"] = {"bytes": self.slam.map_bytes, "flops_per_point": self.slam.flops_per_point}

    def _describe_map(self) -> None:
        assert self.slam is not None
        with self._clock("inventory"):
            self.metrics.update(self.slam.inventory())

    def _write_mesh(self) -> None:
        assert self.slam is not None
        from warpslam.meshing import write_mesh

        try:
            with self._clock("meshing"):
                mesh = self.slam.mesh()
                write_mesh(mesh, self.folder.mesh)
        except MeshError as error:
            log.error("no mesh: %s", error)
            self.metrics["mesh"] = {"error": str(error)}
            return
        self.metrics["mesh"] = {"vertices": len(mesh.vertices), "faces": len(mesh.faces), "area_m2": float(mesh.area)}

    def _evaluate_reconstruction(self) -> None:
        if self.truth_mesh is None or not self.folder.mesh.is_file():
            return
        trajectory, count = self._trajectory()
        truth = np.array(self.truth_poses)[:count]
        known = np.isfinite(truth).all(axis=(1, 2))
        poses = np.where(known[:, None, None], truth, trajectory.poses[:count])
        used = [p for p, result in enumerate(self.results[:count]) if result.status != "SKIPPED"]
        indices = [self.frame_indices[p] for p in used]
        try:
            with self._clock("evaluation"):
                results = evaluate_mesh(
                    self.folder.mesh, self.truth_mesh, self.sequence, indices, poses[used], device=self.device
                )
        except (MeshError, DatasetError) as error:
            log.error("no reconstruction metrics: %s", error)
            self.metrics["reconstruction"] = {"error": str(error)}
            return
        self.reconstruction = results[DEFAULT_PROTOCOL]
        self.metrics["reconstruction"] = reconstruction_metrics(self.reconstruction)

    def _draw_plots(self) -> None:
        from warpslam.report.plots import plot_error, plot_panels, plot_top_view
        from warpslam.runs.panels import save_panels

        trajectory, count = self._trajectory()
        poses, status = trajectory.poses[:count], trajectory.status[:count]
        with self._clock("plotting"):
            if self.ate is not None:
                aligned = np.einsum("ij,njk->nik", self.ate.T_truth_estimate, poses)
                plot_top_view(self.folder.top_view, aligned, np.array(self.truth_poses)[:count], status)
            else:
                plot_top_view(self.folder.top_view, poses, None, status)
            plot_error(self.folder.error_plot, trajectory.timestamps[:count], self.ate, self._losses(count), status)
        panels = self._render_panels(poses)
        if not panels:
            return
        with self._clock("plotting"):
            plot_panels(self.folder.panels, panels)
            save_panels(self.folder.panel_images, panels)
        self.metrics["rendering"] = rendering_metrics(panels)

    def _losses(self, count: int) -> dict[str, np.ndarray]:
        names = sorted({name for result in self.results for name in result.losses})
        losses = {name: np.full(count, np.nan) for name in names}
        for position, result in enumerate(self.results[:count]):
            for name, value in result.losses.items():
                losses[name][position] = value
        return losses

    def _render_panels(self, poses: np.ndarray) -> list[Panel]:
        assert self.slam is not None
        usable = [p for p, result in enumerate(self.results[: len(poses)]) if result.status != "SKIPPED"]
        positions = [usable[i] for i in np.unique(np.linspace(0, len(usable) - 1, PANEL_COUNT).round().astype(int))]
        # Small images tell as much in the figure, and rendering is slow without a GPU.
        stride = -(-self.sequence.intrinsics.width // PANEL_WIDTH)
        try:
            frames = [self.sequence[self.frame_indices[p]] for p in positions]
        except DatasetError as error:
            log.error("no panels: %s", error)
            return []
        with self._clock("rendering"):
            pairs = zip(frames, positions, strict=True)
            return [render_panel(self.slam, frame, poses[p], stride) for frame, p in pairs]

    def _write_figures(self) -> None:
        try:
            self._write_metrics()
            self._write_timing()
            self._write_frames()
            self._write_report()
        except OSError as error:
            if self.status != "failed":
                self.status = "failed"
                raise output_error(error, self.folder.path) from error
            log.error("%s", output_error(error, self.folder.path))

    def _write_metrics(self) -> None:
        from warpslam import __version__
        from warpslam.runtime.environment import package_versions

        statuses = Counter(result.status for result in self.results)
        frame_seconds = self.seconds["frames"]
        self.metrics = {
            "warpslam": __version__,
            "sequence": self.sequence.name,
            "method": self.method,
            "poses": None if self.given is None else self.given.path,
            "status": self.status,
            "device": str(self.slam.device) if self.slam is not None else self.device,
            "seed": self.seed,
            "frames": {
                "selected": len(self.selected),
                "processed": len(self.results),
                "unreadable": len(self.left_out),
                **{status: statuses.get(status, 0) for status in ("OK", "LOST", "SKIPPED")},
            },
            "unusable_frames": self._unusable_frames(),
            "seconds": {
                "total": self.seconds["total"],
                "kernel_compile": self.seconds["kernel_compile"],
                "run": self.seconds["total"] - self.seconds["kernel_compile"],
                "frames": frame_seconds,
            },
            "compiled_kernels": sorted(module.name for module in self.modules if module.compiled),
            "fps": len(self.results) / frame_seconds if frame_seconds > 0 else None,
            "peak_memory_mib": peak_memory_mib(),
            "started": self.started.isoformat(timespec="seconds"),
            "versions": {"warpslam": __version__, "python": platform.python_version(), **package_versions()},
            "platform": platform.platform(),
            "processors": os.cpu_count(),
            **self.metrics,
        }
        write_json(self.folder.metrics, self.metrics)

    def _unusable_frames(self) -> list[dict[str, Any]]:
        """Frames that were left out or skipped, and why, in their order."""
        frames = [{"frame": f["index"], "status": "unreadable", "reason": f["message"]} for f in self.left_out]
        for index, result in zip(self.frame_indices, self.results, strict=False):
            if result.status == "SKIPPED":
                frames.append({"frame": index, "status": "SKIPPED", "reason": result.message})
        return sorted(frames, key=lambda frame: frame["frame"])

    def _write_timing(self) -> None:
        phases: dict[str, list[float]] = defaultdict(list)
        for result in self.results:
            for phase, seconds in result.timings.items():
                phases[phase].append(seconds)
        write_json(
            self.folder.timing,
            {
                "phases": {
                    phase: {"seconds": sum(times), "calls": len(times), "mean_seconds": sum(times) / len(times)}
                    for phase, times in phases.items()
                },
                "stages_seconds": dict(self.seconds),
                "kernel_modules": {
                    module.name: {"seconds": module.seconds, "compiled": module.compiled} for module in self.modules
                },
                "frames": [
                    {"index": index, **result.timings}
                    for index, result in zip(self.frame_indices, self.results, strict=False)
                ],
            },
        )

    def _write_frames(self) -> None:
        """What became of each frame: all of it for the report, and a table of it."""
        frames = [
            {
                "index": index,
                "timestamp": result.timestamp,
                "status": result.status,
                "message": result.message,
                "inliers": result.inliers,
                "depth_error": result.depth_error,
                "losses": result.losses,
            }
            for index, result in zip(self.frame_indices, self.results, strict=False)
        ]
        write_json(self.folder.frame_records, {"frames": frames, "left_out": self.left_out})
        with open(self.folder.frames, "w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(["frame", "timestamp", "status", "inliers", "depth_error_m", "message"])
            for frame in frames:
                figures = (f"{frame['inliers']:.4f}", f"{frame['depth_error']:.5f}")
                time_text = f"{frame['timestamp']:.6f}"
                writer.writerow([frame["index"], time_text, frame["status"], *figures, frame["message"]])

    def _write_report(self) -> None:
        from warpslam.report import write_report

        try:
            write_report(self.folder)
        except WarpSlamError as error:
            # The run is done and its figures are written; what stands in the way is in the log and on the terminal.
            log.error("no report: %s", error)
        except Exception:
            # Must not take the place of the error that ended the run.
            if self.status != "failed":
                raise
            log.exception("no report")

    def _fail(self, error: Exception) -> None:
        """Note the failure, and save the trajectory if that has not happened yet."""
        self.status = "failed"
        self.metrics["error"] = f"{type(error).__name__}: {error}"
        log.exception("the run failed")
        for leftover in self.folder.path.glob("*.part*"):
            # Half a map may be what filled the disk.
            leftover.unlink(missing_ok=True)
        if self.results and not self.folder.trajectory.exists():
            try:
                self._write_trajectory()
            except OSError:
                rescued = Path(tempfile.mkdtemp(prefix=f"warpslam_{self.folder.path.name}_")) / "trajectory.tum"
                trajectory, count = self._trajectory()
                write_tum(rescued, trajectory.timestamps[:count], trajectory.poses[:count])
                log.error("%s can't be written: the trajectory so far is in %s", self.folder.trajectory, rescued)

    @contextmanager
    def _clock(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[stage] += time.perf_counter() - start


def render_panel(slam: Method, frame: Frame, T_world_camera: np.ndarray, stride: int = 1) -> Panel:
    """A frame beside what the map renders from ``T_world_camera`` (4, 4), every ``stride``-th pixel of both."""
    from warpslam.runs.panels import Panel

    image = slam.render(T_world_camera, stride=stride)
    rgb, depth = frame.rgb[::stride, ::stride], frame.depth[::stride, ::stride]
    return Panel(frame.index, rgb, depth, np.asarray(image.rgb), np.asarray(image.depth))
