"""One run, from a sequence to a folder: trajectory, map, mesh, figures and what they are worth."""

from __future__ import annotations

import csv
import dataclasses
import logging
import os
import platform
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpslam.checking import ERROR, OK, check_sequence
from warpslam.errors import ConfigError, DatasetError, InputError, MeshError, WarpSlamError
from warpslam.evaluation import (
    DEFAULT_PROTOCOL,
    AteResult,
    ReconstructionResult,
    associate,
    ate,
    evaluate_mesh,
    read_tum,
    reconstruction_metrics,
    rendering_metrics,
    trajectory_metrics,
    write_tum,
)
from warpslam.method import DEFAULT_METHOD, build_method, check_method, has_checkpoints, load_method
from warpslam.output import LogFile, kernel_cache_errors, output_error
from warpslam.resume import (
    RunProgress,
    RunRequest,
    SavedRun,
    frame_digest,
    remove_checkpoints,
    write_checkpoint,
)
from warpslam.run_folder import RunFolder, Source, read_json, write_json

if TYPE_CHECKING:
    import trimesh

    from warpslam.camera import Intrinsics
    from warpslam.compilation import ModuleProgress
    from warpslam.config import Config
    from warpslam.method import Method
    from warpslam.plots import Panel
    from warpslam.sequences.base import Frame, RgbdSequence
    from warpslam.slam import FrameResult, Slam
    from warpslam.trajectory import Trajectory

log = logging.getLogger(__name__)

PANEL_COUNT = 4
PANEL_WIDTH = 240  # [px], at most


@dataclass(frozen=True)
class Progress:
    """State of a run after a frame.

    done, total: Frames processed so far and selected.
    ate_rmse: ATE RMSE so far, aligned [m]; None without ground truth.
    fps: Frames a second so far, set-up left out.
    """

    done: int
    total: int
    result: FrameResult
    ate_rmse: float | None
    fps: float


@dataclass(frozen=True)
class RunResult:
    """What a run came to.

    status: "finished", "interrupted" (by ctrl-C; everything up to then is written) or "failed".
    metrics: Content of metrics.json.
    """

    folder: RunFolder
    status: str
    metrics: dict[str, Any]
    ate: AteResult | None
    reconstruction: ReconstructionResult | None


def run(
    sequence: RgbdSequence,
    config: Config,
    output: str | Path | None = None,
    *,
    frames: slice | None = None,
    device: str | None = None,
    seed: int = 0,
    source: Source | None = None,
    truth_mesh: trimesh.Trimesh | None = None,
    on_frame: Callable[[Progress], None] | None = None,
    on_module: Callable[[ModuleProgress], None] | None = None,
    method: str = DEFAULT_METHOD,
    poses: str | Path | None = None,
    checkpoint_every: int | None = None,
    map_path: str | Path | None = None,
    localize_only: bool = False,
    saved: SavedRun | None = None,
    check_input: bool = True,
) -> RunResult:
    """Run SLAM over a sequence and write a run folder.

    Args:
        sequence: Input.
        config: Settings.
        output: Folder to write; None for ``runs/<sequence>/<time>``.
        frames: Frames to use; None for all.
        device: Warp device, such as "cpu" or "cuda:0"; None for Warp's preferred one.
        seed: Seed of every random choice.
        source: How to open ``sequence`` again, for `warpslam render`.
        truth_mesh: True surface in the world frame of the sequence; adds the reconstruction metrics.
        on_frame: Called after each frame.
        on_module: Called before and after each module of kernels is loaded, or compiled if it never was.
        method: One of `warpslam.method.METHODS`.
        poses: Trajectory in the TUM format whose poses are given to the method in place of the sequence's own; frames
            without one are left out. Errors are against the sequence's own as ever.
        checkpoint_every: Frames between two checkpoints; None for none. The schedule has to be deterministic for a
            resumed run to give the same bytes.
        map_path: Map to start from, a file that `Slam.save` wrote; the first frame is looked for in it.
        localize_only: The map is left as it is.
        saved: Checkpoint of the run in ``output``, which goes on from there; all else must be as it was.
        check_input: Refuse an input that `warpslam.checking` finds can't work; its warnings are logged in any case.

    Raises:
        WarpSlamError: The input or a setting can't be used, or a result can't be written. metrics.json is written even
            so, where it can be.
    """
    selected = select_frames(sequence, frames)
    _check_checkpoint_settings(checkpoint_every, map_path, localize_only, method)
    request = RunRequest(
        sequence.name,
        len(sequence),
        dataclasses.asdict(sequence.intrinsics),
        (selected.start, selected.stop, selected.step),
        config.model_dump(),
        seed,
        _device_name(device),
        str(map_path) if map_path is not None else None,
        localize_only,
        dataclasses.asdict(source) if source is not None else None,
        str(poses) if poses is not None else None,
    )
    if saved is None:
        folder = RunFolder.create(output, sequence.name)
    else:
        assert output is not None
        saved.check(request, sequence)
        folder = RunFolder(output)
        folder.clear_results()
    with _log_file(folder.log, append=saved is not None):
        given = None if poses is None else GivenPoses.read(poses)
        run_ = _Run(
            sequence, config, folder, selected, device, seed, source, truth_mesh, on_frame, on_module, method, given
        )
        run_.request, run_.checkpoint_every, run_.check_input = request, checkpoint_every, check_input
        if saved is not None:
            run_.go_on_from(saved)
        return run_.execute()


class _Run:
    def __init__(
        self,
        sequence: RgbdSequence,
        config: Config,
        folder: RunFolder,
        selected: range,
        device: str | None,
        seed: int,
        source: Source | None,
        truth_mesh: trimesh.Trimesh | None,
        on_frame: Callable[[Progress], None] | None,
        on_module: Callable[[ModuleProgress], None] | None,
        method: str,
        given: GivenPoses | None,
    ) -> None:
        self.method, self.given = method, given
        self.sequence, self.config, self.folder, self.selected = sequence, config, folder, selected
        self.device, self.seed, self.source, self.truth_mesh, self.on_frame = device, seed, source, truth_mesh, on_frame
        self.on_module = on_module
        self.modules: list[ModuleProgress] = []
        self.slam: Method | None = None
        self.status = "finished"
        self.started = datetime.now().astimezone()
        self.frame_indices: list[int] = []
        self.truth_poses: list[np.ndarray] = []
        self.results: list[FrameResult] = []
        self.left_out: list[dict[str, Any]] = []
        self.check_input = True
        self.seconds: dict[str, float] = defaultdict(float)
        self.request: RunRequest | None = None
        self.checkpoint_every: int | None = None
        self.saved: SavedRun | None = None
        self.position = 0  # in the selection
        self.first_index = 0  # frames of the map that the run started from
        self.resumed_count = 0  # results that came from a checkpoint
        self.digests: dict[int, str] = {}
        self.start = self.frames_start = 0.0
        self.ate: AteResult | None = None
        self.reconstruction: ReconstructionResult | None = None
        self.metrics: dict[str, Any] = {}

    def go_on_from(self, saved: SavedRun) -> None:
        """Take up a run at its checkpoint."""
        progress, self.saved = saved.progress, saved
        self.position, self.first_index = progress.position, progress.first_index
        self.frame_indices, self.truth_poses = progress.frame_indices, progress.truth_poses
        self.results, self.left_out = progress.results, progress.left_out
        self.seconds.update(progress.seconds)
        self.digests = progress.digests
        self.resumed_count = len(progress.results)

    def execute(self) -> RunResult:
        self.start = time.perf_counter()
        try:
            try:
                self._write_input()
                self._check_input()
                self._build_slam()
                self._process_frames()
                self._finish_map()
            except KeyboardInterrupt:
                self.status = "interrupted"
                log.warning("interrupted: writing what there is; press ctrl-C again to leave it")
            if self.results:
                self._write_trajectory()
                self._write_frames()
                self._evaluate_trajectory()
                self._write_map()
                self._describe_map()
                self._write_mesh()
                self._evaluate_reconstruction()
                self._draw_plots()
            if self.status == "finished":
                remove_checkpoints(self.folder)
        except KeyboardInterrupt:
            self.status = "interrupted"
        except OSError as error:
            self._fail(error)
            raise output_error(error, self.folder.path) from error
        except Exception as error:
            self._fail(error)
            raise
        finally:
            self.seconds["total"] += time.perf_counter() - self.start
            self._write_figures()
        return RunResult(self.folder, self.status, self.metrics, self.ate, self.reconstruction)

    def _write_input(self) -> None:
        self.config.save(self.folder.config)
        if self.source is not None:
            self.folder.write_source(self.source)
        log.info("%s: %d of %d frames, %s", self.sequence.name, len(self.selected), len(self.sequence), self.selected)

    def _check_input(self) -> None:
        tracking = self.config.tracking
        if tracking.use_given_poses and self.sequence.ground_truth() is None and self._first_pose() is None:
            raise ConfigError(f"tracking.use_given_poses is on, but {self.sequence.name} has no poses; switch it off")
        with self._clock("checking"):
            findings = check_sequence(
                self.sequence,
                self.selected,
                max_depth=self.config.grid.max_depth,
                poses_matter=tracking.use_given_poses,
            )
        bad = [finding for finding in findings if finding.severity != OK]
        self.metrics["input_checks"] = [vars(finding) for finding in bad]
        for finding in bad:
            log.warning("%s", finding)
        errors = [str(finding) for finding in bad if finding.severity == ERROR]
        if errors and self.check_input:
            raise DatasetError(f"{self.sequence.name}: {'; '.join(errors)} (warpslam check tells more)")

    def _first_pose(self) -> np.ndarray | None:
        try:
            return self.sequence[self.selected[0]].T_world_camera
        except DatasetError:
            return None

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

    def _unusable_frames(self) -> list[dict[str, Any]]:
        """Frames that were left out or skipped, and why, in their order."""
        frames = [{"frame": f["index"], "status": "unreadable", "reason": f["message"]} for f in self.left_out]
        for index, result in zip(self.frame_indices, self.results, strict=False):
            if result.status == "SKIPPED":
                frames.append({"frame": index, "status": "SKIPPED", "reason": result.message})
        return sorted(frames, key=lambda frame: frame["frame"])

    def _write_figures(self) -> None:
        try:
            self._write_metrics()
            self._write_timing()
            self._write_frame_records()
            self._write_report()
        except OSError as error:
            if self.status != "failed":
                self.status = "failed"
                raise output_error(error, self.folder.path) from error
            log.error("%s", output_error(error, self.folder.path))

    def _build_slam(self) -> None:
        request = self.request
        with self._clock("setup"), kernel_cache_errors():
            with self._clock("kernel_compile"):
                self.modules = load_kernels(self.sequence, self.device, self.on_module)
            if self.saved is not None:
                self.slam = self.saved.slam(self.config)
                log.info("resumed from %s, after %d frames", self.saved.path, self.position)
            elif request is not None and request.map is not None:
                self.slam = open_map(
                    request.map, self.sequence.intrinsics, self.config, self.device, localize_only=request.localize_only
                )
                self.first_index = len(self.slam.trajectory.poses)
            else:
                build = build_slam if self.method == DEFAULT_METHOD else partial(build_baseline, self.method)
                self.slam = build(self.sequence.intrinsics, self.config, self.device, self.seed)
        self.seconds["kernel_compile"] += self.slam.compile_seconds

    def _process_frames(self) -> None:
        assert self.slam is not None
        with self._clock("frames"):
            start = self.frames_start = time.perf_counter()
            self._write_checkpoint()
            for frame in self._readable_frames():
                T_world_camera = frame.T_world_camera
                if T_world_camera is not None and not np.isfinite(T_world_camera).all():
                    T_world_camera = None
                self.frame_indices.append(frame.index)
                self.truth_poses.append(np.full((4, 4), np.nan) if T_world_camera is None else T_world_camera)
                if self.given is not None:
                    given = self.given.at(frame.timestamp)
                else:
                    # The world of a map that was loaded need not be that of the sequence's true poses.
                    given = T_world_camera if self._knows_poses() else None
                if given is None and self.config.tracking.use_given_poses:
                    given = self.truth_poses[-1]  # NaN: this frame will be skipped, and the run goes on
                result = self.slam.step(frame.rgb, frame.depth, timestamp=frame.timestamp, T_world_camera=given)
                self.results.append(result)
                level = logging.INFO if result.status == "OK" else logging.WARNING
                log.log(level, "frame %d: %s", frame.index, _describe(result))
                if self.on_frame is not None:
                    self.on_frame(self._progress(result, time.perf_counter() - start))
                self._after_frame(frame)
        if not self.results:
            raise DatasetError(f"{self.sequence.name}: none of the {len(self.selected)} selected frames can be read")
        if all(result.status == "SKIPPED" for result in self.results):
            reason = self.results[-1].message
            raise DatasetError(f"{self.sequence.name}: none of the {len(self.results)} frames can be used: {reason}")

    def _readable_frames(self) -> Iterator[Frame]:
        last = self.results[-1].timestamp if self.results else -np.inf
        for index in self.selected[self.position :]:
            self.position += 1
            try:
                with self._clock("reading"):
                    frame = self.sequence[index]
                # Against the frame before, whatever became of it: a single wrong time costs one frame, not the rest.
                before, last = last, frame.timestamp
                if last <= before:
                    raise DatasetError(f"its time {last:.6f} s is not after {before:.6f} s, that of the frame before")
            except DatasetError as error:
                self.left_out.append({"index": index, "message": str(error)})
                log.warning("frame %d left out: %s", index, error)
                continue
            if self.given is not None and self.given.at(frame.timestamp) is None:
                message = f"{self.given.path} has no pose for {frame.timestamp:.3f} s"
                self.left_out.append({"index": index, "message": message})
                log.warning("frame %d left out: %s", index, message)
                continue
            yield frame

    def _knows_poses(self) -> bool:
        return self.request is None or self.request.map is None or self.config.tracking.use_given_poses

    def _after_frame(self, frame: Frame) -> None:
        if self.checkpoint_every is None:
            return
        first = next(iter(self.digests), frame.index)
        self.digests = {index: digest for index, digest in self.digests.items() if index == first}
        due = self.position % self.checkpoint_every == 0 or self.position == len(self.selected)
        if due or not self.digests:
            self.digests[frame.index] = frame_digest(frame)
        if due:
            self._write_checkpoint()

    def _write_checkpoint(self) -> None:
        if self.checkpoint_every is None or (self.saved is not None and self.saved.progress.position == self.position):
            return
        assert self.slam is not None and self.request is not None
        now = time.perf_counter()
        seconds = dict(self.seconds)
        seconds["frames"] = seconds.get("frames", 0.0) + now - self.frames_start
        seconds["total"] = seconds.get("total", 0.0) + now - self.start
        progress = RunProgress(
            self.position,
            self.frame_indices,
            self.truth_poses,
            self.results,
            self.left_out,
            seconds,
            self.first_index,
            self.digests,
        )
        with self._clock("checkpoints"):
            size = write_checkpoint(self.folder, self.request, self.checkpoint_every, progress, self.slam)
        self.metrics["checkpoint"] = {"bytes": size, "every_frames": self.checkpoint_every}

    def _progress(self, result: FrameResult, elapsed: float) -> Progress:
        assert self.slam is not None
        truth = np.array(self.truth_poses)
        rmse = None
        if np.isfinite(truth).all(axis=(1, 2)).any():
            rmse = ate(self._trajectory()[0].poses[: len(truth)], truth).rmse
        done = len(self.results) + len(self.left_out)
        fps = (len(self.results) - self.resumed_count) / max(elapsed, 1e-9)
        return Progress(done, len(self.selected), result, rmse, fps)

    def _finish_map(self) -> None:
        assert self.slam is not None
        with self._clock("finish"):
            phases = self.slam.finish()
        for phase, seconds in phases.items():
            self.seconds[f"finish_{phase}"] += seconds

    def _trajectory(self) -> tuple[Trajectory, int]:
        """The trajectory, and how many of its poses belong to frames that were finished."""
        assert self.slam is not None
        trajectory, first = self.slam.trajectory, self.first_index
        if first:
            parts = (trajectory.timestamps[first:], trajectory.poses[first:], trajectory.status[first:])
            trajectory = dataclasses.replace(trajectory, timestamps=parts[0], poses=parts[1], status=parts[2])
        # After an interrupt the trajectory may hold the pose of a frame that never came back.
        return trajectory, len(self.results)

    def _write_trajectory(self) -> None:
        trajectory, count = self._trajectory()
        partial = self.folder.trajectory.with_name("trajectory.tum.partial")
        write_tum(partial, trajectory.timestamps[:count], trajectory.poses[:count])
        partial.replace(self.folder.trajectory)
        if self._has_truth():
            write_tum(self.folder.ground_truth, trajectory.timestamps[:count], np.array(self.truth_poses)[:count])

    def _write_frames(self) -> None:
        """A line a frame: what the TUM format has no place for."""
        with open(self.folder.frames, "w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(["frame", "timestamp", "status", "inliers", "depth_error_m", "message"])
            for index, result in zip(self.frame_indices, self.results, strict=False):
                figures = (f"{result.inliers:.4f}", f"{result.depth_error:.5f}")
                writer.writerow([index, f"{result.timestamp:.6f}", result.status, *figures, result.message])

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
        from warpslam.inventory import take_inventory
        from warpslam.slam import Slam

        if isinstance(self.slam, Slam):
            with self._clock("inventory"):
                self.metrics.update(take_inventory(self.slam))
                self.metrics["memory"] = self.slam.memory()

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
        from warpslam.plots import plot_error, plot_panels, plot_top_view, save_panels

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

    def _write_frame_records(self) -> None:
        frames = [
            {
                "index": index,
                "timestamp": result.timestamp,
                "status": result.status,
                "message": result.message,
                "inliers": result.inliers,
                "losses": result.losses,
            }
            for index, result in zip(self.frame_indices, self.results, strict=False)
        ]
        write_json(self.folder.frame_records, {"frames": frames, "left_out": self.left_out})

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

    def _write_metrics(self) -> None:
        from warpslam import __version__
        from warpslam.versions import package_versions

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
            "peak_memory_mib": _peak_memory_mib(),
            "started": self.started.isoformat(timespec="seconds"),
            "versions": {"warpslam": __version__, "python": platform.python_version(), **package_versions()},
            "platform": platform.platform(),
            "processors": os.cpu_count(),
            **self.metrics,
        }
        write_json(self.folder.metrics, self.metrics)

    @contextmanager
    def _clock(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[stage] += time.perf_counter() - start


def load_kernels(
    sequence: RgbdSequence, device: str | None, report: Callable[[ModuleProgress], None] | None = None
) -> list[ModuleProgress]:
    """Load all kernels that a run over ``sequence`` needs, compiling those that never were; see
    `warpslam.compilation.compile_kernels`.

    Raises:
        ConfigError: There is no such device.
    """
    import warp as wp

    from warpslam.compilation import compile_kernels

    check_device(device)
    return compile_kernels(wp.get_device(device), report, getattr(sequence, "warp_modules", ()))


@dataclass(frozen=True)
class GivenPoses:
    """Poses that a file gives to frames, by time.

    path: File. times: [s], shape (N,). poses: T_world_camera, shape (N, 4, 4).
    """

    path: Path
    times: np.ndarray
    poses: np.ndarray

    @classmethod
    def read(cls, path: str | Path) -> GivenPoses:
        """Read a trajectory in the TUM format, such as an earlier run's trajectory.tum.

        Raises:
            DatasetError: The file can't be read.
        """
        return cls(Path(path), *read_tum(path))

    def at(self, timestamp: float) -> np.ndarray | None:
        """The pose nearest in time, within 20 ms; None if there is none."""
        position = int(associate(np.array([timestamp]), self.times)[0])
        return None if position < 0 else self.poses[position]


def build_slam(intrinsics: Intrinsics, config: Config, device: str | None, seed: int) -> Method:
    """The SLAM object of a run.

    Raises:
        ConfigError: There is no such device.
        CheckpointError: The decoders can't be loaded.
    """
    return build_baseline(DEFAULT_METHOD, intrinsics, config, device, seed)


def build_baseline(method: str, intrinsics: Intrinsics, config: Config, device: str | None, seed: int) -> Method:
    """Any method of a run, by name; see `warpslam.method.build_method` for what it raises."""
    check_device(device)
    return build_method(method, intrinsics, config, device, seed)


def open_map(
    path: str | Path, intrinsics: Intrinsics, config: Config, device: str | None, *, localize_only: bool = False
) -> Slam:
    """The SLAM object of a run that starts from a map.

    Raises:
        ConfigError: There is no such device, or the settings do not fit the map.
        CheckpointError: The map can't be loaded.
        InputError: The map was made with another camera.
    """
    from warpslam.slam import Slam

    check_device(device)
    slam = Slam.load(path, device, config=config, localize_only=localize_only)
    if slam.intrinsics != intrinsics:
        raise InputError(f"{path} was made with another camera: {slam.intrinsics}, the sequence has {intrinsics}")
    slam.forget_pose()
    return slam


def load_slam(folder: RunFolder, device: str | None = None) -> Method:
    """The SLAM object (or the baseline) as a run left it.

    Raises:
        ConfigError: There is no such device.
        DatasetError: The run saved no map.
        CheckpointError: The map can't be loaded.
    """
    path = folder.require(folder.map, "the run stopped before it had a map")
    check_device(device)
    return load_method(read_json(folder.metrics).get("method", DEFAULT_METHOD), path, device)


def check_device(device: str | None) -> None:
    """Whether Warp has the device of that name; None is Warp's preferred one.

    Raises:
        ConfigError: It has not.
    """
    import warp as wp

    names = [str(known) for known in wp.get_devices()]
    if device is not None and device not in (*names, "cuda"):
        raise ConfigError(f"device {device!r} is not there; this machine has {', '.join(names)}")


def _device_name(device: str | None) -> str:
    """The device that a name, or none, leads to; a name that leads nowhere is told of when the run starts."""
    import warp as wp

    names = [str(known) for known in wp.get_devices()]
    return str(wp.get_device(device)) if device is None or device in (*names, "cuda") and names[1:] else str(device)


def _check_checkpoint_settings(
    every: int | None, map_path: str | Path | None, localize_only: bool, method: str
) -> None:
    check_method(method)
    if not has_checkpoints(method) and (every is not None or map_path is not None):
        raise ConfigError(f"method {method} has no checkpoints and takes no map: leave out checkpoint_every and map")
    if every is not None and every < 1:
        raise ConfigError(f"checkpoint_every = {every} must be at least 1 frame")
    if localize_only and map_path is None:
        raise ConfigError("localize_only needs a map: name one with map_path (--map)")


def render_panel(slam: Method, frame: Frame, T_world_camera: np.ndarray, stride: int = 1) -> Panel:
    """A frame beside what the map renders from ``T_world_camera`` (4, 4), every ``stride``-th pixel of both."""
    from warpslam.plots import Panel

    image = slam.render(T_world_camera, stride=stride)
    rgb, depth = frame.rgb[::stride, ::stride], frame.depth[::stride, ::stride]
    return Panel(frame.index, rgb, depth, np.asarray(image.rgb), np.asarray(image.depth))


def select_frames(sequence: RgbdSequence, frames: slice | None) -> range:
    """Numbers of the frames to use, all by default.

    Raises:
        ConfigError: The slice selects none, or goes backwards.
    """
    frames = slice(None) if frames is None else frames
    if frames.step is not None and frames.step < 1:
        raise ConfigError(f"frames: step {frames.step} must be at least 1; SLAM goes forward in time")
    selected = range(*frames.indices(len(sequence)))
    if len(selected) == 0:
        wanted = ":".join("" if part is None else str(part) for part in (frames.start, frames.stop, frames.step))
        raise ConfigError(f"frames {wanted} selects none of the {len(sequence)} frames of {sequence.name}")
    return selected


def _describe(result: FrameResult) -> str:
    losses = " ".join(f"{name}={value:.4g}" for name, value in result.losses.items())
    return f"{result.status} {losses} inliers={result.inliers:.2f} {result.message}".rstrip()


def _peak_memory_mib() -> float | None:
    try:
        import resource
    except ImportError:  # not on Windows
        return None
    unit = 2**20 if sys.platform == "darwin" else 2**10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


@contextmanager
def _log_file(path: Path, *, append: bool = False) -> Iterator[None]:
    """Send everything that warpslam logs, from INFO up, to a file as well."""
    logger = logging.getLogger("warpslam")
    handler = LogFile(path, logger, append=append)
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    level = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.setLevel(level)
        logger.removeHandler(handler)
        handler.close()
