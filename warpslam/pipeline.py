"""One run, from a sequence to a folder: trajectory, map, mesh, figures and what they are worth."""

from __future__ import annotations

import logging
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpslam.checking import ERROR, OK, check_sequence
from warpslam.errors import ConfigError, DatasetError, InputError, MeshError
from warpslam.evaluation import (
    AteResult,
    ReconstructionResult,
    Statistics,
    ate,
    cull_mesh,
    depth_l1,
    evaluate_reconstruction,
    rpe,
    write_tum,
)
from warpslam.output import LogFile, kernel_cache_errors, output_error
from warpslam.run_folder import RunFolder, Source, write_json

if TYPE_CHECKING:
    import trimesh

    from warpslam.camera import Intrinsics
    from warpslam.config import Config
    from warpslam.plots import Panel
    from warpslam.sequences.base import Frame, RgbdSequence
    from warpslam.slam import FrameResult, Slam, Trajectory

log = logging.getLogger(__name__)

PANEL_COUNT = 4
PANEL_WIDTH = 240  # [px], at most
CULLING_VIEW_COUNT = 60
MAX_EDGE = 0.05  # [m], larger faces are split before the unseen part of a mesh is cut off


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
        check_input: Refuse an input that `warpslam.checking` finds can't work; its warnings are logged in any case.

    Raises:
        WarpSlamError: The input or a setting can't be used, or a result can't be written. metrics.json is written even
            so, where it can be.
    """
    selected = _select(sequence, frames)
    folder = RunFolder.create(output, sequence.name)
    with _log_file(folder.log):
        run_ = _Run(sequence, config, folder, selected, device, seed, source, truth_mesh, on_frame)
        run_.check_input = check_input
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
    ) -> None:
        self.sequence, self.config, self.folder, self.selected = sequence, config, folder, selected
        self.device, self.seed, self.source, self.truth_mesh, self.on_frame = device, seed, source, truth_mesh, on_frame
        self.slam: Slam | None = None
        self.status = "finished"
        self.frame_indices: list[int] = []
        self.truth_poses: list[np.ndarray] = []
        self.results: list[FrameResult] = []
        self.unreadable_count = 0
        self.unusable: list[dict[str, Any]] = []  # frames that were left out or skipped, and why
        self.check_input = True
        self.seconds: dict[str, float] = defaultdict(float)
        self.ate: AteResult | None = None
        self.reconstruction: ReconstructionResult | None = None
        self.metrics: dict[str, Any] = {}

    def execute(self) -> RunResult:
        start = time.perf_counter()
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
                self._evaluate_trajectory()
                self._write_map()
                self._write_mesh()
                self._evaluate_reconstruction()
                self._draw_plots()
        except KeyboardInterrupt:
            self.status = "interrupted"
        except OSError as error:
            self._fail(error)
            raise output_error(error, self.folder.path) from error
        except Exception as error:
            self._fail(error)
            raise
        finally:
            self.seconds["total"] = time.perf_counter() - start
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

    def _write_figures(self) -> None:
        try:
            self._write_metrics()
            self._write_timing()
        except OSError as error:
            if self.status != "failed":
                self.status = "failed"
                raise output_error(error, self.folder.path) from error
            log.error("%s", output_error(error, self.folder.path))

    def _build_slam(self) -> None:
        with self._clock("setup"), kernel_cache_errors():
            self.slam = build_slam(self.sequence.intrinsics, self.config, self.device, self.seed)
        self.seconds["kernel_compile"] = self.slam.compile_seconds

    def _process_frames(self) -> None:
        assert self.slam is not None
        with self._clock("frames"):
            start = time.perf_counter()
            for frame in self._readable_frames():
                T_world_camera = frame.T_world_camera
                if T_world_camera is not None and not np.isfinite(T_world_camera).all():
                    T_world_camera = None
                self.frame_indices.append(frame.index)
                self.truth_poses.append(np.full((4, 4), np.nan) if T_world_camera is None else T_world_camera)
                if T_world_camera is None and self.config.tracking.use_given_poses:
                    T_world_camera = self.truth_poses[-1]  # NaN: this frame will be skipped, and the run goes on
                result = self.slam.step(
                    frame.rgb, frame.depth, timestamp=frame.timestamp, T_world_camera=T_world_camera
                )
                self.results.append(result)
                level = logging.INFO if result.status == "OK" else logging.WARNING
                log.log(level, "frame %d: %s", frame.index, _describe(result))
                if result.status == "SKIPPED":
                    self.unusable.append({"frame": frame.index, "status": "SKIPPED", "reason": result.message})
                if self.on_frame is not None:
                    self.on_frame(self._progress(result, time.perf_counter() - start))
        if not self.results:
            raise DatasetError(f"{self.sequence.name}: none of the {len(self.selected)} selected frames can be read")
        if all(result.status == "SKIPPED" for result in self.results):
            reason = self.unusable[-1]["reason"]
            raise DatasetError(f"{self.sequence.name}: none of the {len(self.results)} frames can be used: {reason}")

    def _readable_frames(self) -> Iterator[Frame]:
        last = self.results[-1].timestamp if self.results else -np.inf
        for index in self.selected:
            try:
                with self._clock("reading"):
                    frame = self.sequence[index]
                # Against the frame before, whatever became of it: a single wrong time costs one frame, not the rest.
                before, last = last, frame.timestamp
                if last <= before:
                    raise DatasetError(f"its time {last:.6f} s is not after {before:.6f} s, that of the frame before")
            except DatasetError as error:
                self.unreadable_count += 1
                self.unusable.append({"frame": index, "status": "unreadable", "reason": str(error)})
                log.warning("frame %d left out: %s", index, error)
                continue
            yield frame

    def _progress(self, result: FrameResult, elapsed: float) -> Progress:
        assert self.slam is not None
        truth = np.array(self.truth_poses)
        rmse = None
        if np.isfinite(truth).all(axis=(1, 2)).any():
            rmse = ate(self.slam.trajectory.poses, truth).rmse
        done = len(self.results) + self.unreadable_count
        return Progress(done, len(self.selected), result, rmse, len(self.results) / max(elapsed, 1e-9))

    def _finish_map(self) -> None:
        assert self.slam is not None
        with self._clock("finish"):
            phases = self.slam.finish()
        for phase, seconds in phases.items():
            self.seconds[f"finish_{phase}"] += seconds

    def _trajectory(self) -> tuple[Trajectory, int]:
        """The trajectory, and how many of its poses belong to frames that were finished."""
        assert self.slam is not None
        # After an interrupt the trajectory may hold the pose of a frame that never came back.
        return self.slam.trajectory, len(self.results)

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

    def _write_mesh(self) -> None:
        assert self.slam is not None
        from warpslam.meshing import write_ply

        try:
            with self._clock("meshing"):
                mesh = self.slam.mesh()
                write_ply(mesh, self.folder.mesh)
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
                self.reconstruction = evaluate_mesh(
                    self.folder.mesh, self.truth_mesh, self.sequence, indices, poses[used], seed=self.seed
                )
        except (MeshError, DatasetError) as error:
            log.error("no reconstruction metrics: %s", error)
            self.metrics["reconstruction"] = {"error": str(error)}
            return
        self.metrics["reconstruction"] = reconstruction_metrics(self.reconstruction)

    def _draw_plots(self) -> None:
        from warpslam.plots import plot_error, plot_panels, plot_top_view

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
        self.metrics["rendering"] = {
            "frames": [panel.index for panel in panels],
            "depth_l1_m": float(np.mean([depth_l1(panel.rendered_depth, panel.depth) for panel in panels])),
            "psnr_db": float(np.mean([psnr(panel.rendered_rgb, panel.rgb) for panel in panels])),
        }

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
                "frames": [
                    {"index": index, **result.timings}
                    for index, result in zip(self.frame_indices, self.results, strict=False)
                ],
            },
        )

    def _write_metrics(self) -> None:
        from warpslam import __version__

        statuses = Counter(result.status for result in self.results)
        frame_seconds = self.seconds["frames"]
        self.metrics = {
            "warpslam": __version__,
            "sequence": self.sequence.name,
            "status": self.status,
            "device": str(self.slam.device) if self.slam is not None else self.device,
            "seed": self.seed,
            "frames": {
                "selected": len(self.selected),
                "processed": len(self.results),
                "unreadable": self.unreadable_count,
                **{status: statuses.get(status, 0) for status in ("OK", "LOST", "SKIPPED")},
            },
            "unusable_frames": self.unusable,
            "seconds": {
                "total": self.seconds["total"],
                "kernel_compile": self.seconds["kernel_compile"],
                "run": self.seconds["total"] - self.seconds["kernel_compile"],
                "frames": frame_seconds,
            },
            "fps": len(self.results) / frame_seconds if frame_seconds > 0 else None,
            "peak_memory_mib": _peak_memory_mib(),
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


def build_slam(intrinsics: Intrinsics, config: Config, device: str | None, seed: int) -> Slam:
    """The SLAM object of a run.

    Raises:
        ConfigError: There is no such device.
        CheckpointError: The decoders can't be loaded.
    """
    from warpslam.slam import Slam

    check_device(device)
    return Slam(intrinsics, config=config, device=device, seed=seed)


def load_slam(folder: RunFolder, device: str | None = None) -> Slam:
    """The SLAM object as a run left it.

    Raises:
        ConfigError: There is no such device.
        DatasetError: The run saved no map.
        CheckpointError: The map can't be loaded.
    """
    from warpslam.slam import Slam

    path = folder.require(folder.map, "the run stopped before it had a map")
    check_device(device)
    return Slam.load(path, device=device)


def check_device(device: str | None) -> None:
    """Raise `ConfigError` if there is no such Warp device."""
    import warp as wp

    names = [str(known) for known in wp.get_devices()]
    if device is not None and device not in (*names, "cuda"):
        raise ConfigError(f"device {device!r} is not there; this machine has {', '.join(names)}")


def render_panel(slam: Slam, frame: Frame, T_world_camera: np.ndarray, stride: int = 1) -> Panel:
    """A frame beside what the map renders from ``T_world_camera`` (4, 4), every ``stride``-th pixel of both."""
    from warpslam.plots import Panel

    image = slam.render(T_world_camera, stride=stride)
    rgb, depth = frame.rgb[::stride, ::stride], frame.depth[::stride, ::stride]
    return Panel(frame.index, rgb, depth, np.asarray(image.rgb), np.asarray(image.depth))


def evaluate_mesh(
    mesh_path: Path,
    truth_mesh: trimesh.Trimesh,
    sequence: RgbdSequence,
    frame_indices: list[int],
    poses: np.ndarray,
    *,
    seed: int = 0,
) -> ReconstructionResult:
    """Reconstruction metrics of a mesh over the part of the true surface that the sequence shows.

    Completion is taken over what some frame saw, occlusion included. Accuracy is taken against all of the true surface,
    over what lies in some frame's image, so that surface invented behind a wall counts against the reconstruction.

    Args:
        mesh_path: Mesh to judge.
        truth_mesh: True surface [m], same world frame.
        sequence: Where the depth images for the occlusion test come from.
        frame_indices: Frames that were used, N of them.
        poses: Their camera-to-world transforms, shape (N, 4, 4).
        seed: Seed of the drawn points.

    Raises:
        MeshError: A mesh can't be read or has no surface in view.
    """
    chosen = np.unique(np.linspace(0, len(frame_indices) - 1, CULLING_VIEW_COUNT).round().astype(int))
    views, depths = poses[chosen], [sequence[frame_indices[position]].depth for position in chosen]
    seen_truth = cull_mesh(truth_mesh, views, sequence.intrinsics, depths, max_edge=MAX_EDGE)
    mesh = cull_mesh(load_mesh(mesh_path), views, sequence.intrinsics, max_edge=MAX_EDGE)
    return evaluate_reconstruction(mesh, truth_mesh, seen_truth=seen_truth, seed=seed)


def load_mesh(path: str | Path) -> trimesh.Trimesh:
    """Read a triangle mesh.

    Raises:
        MeshError: The file can't be read or holds no triangles.
    """
    import trimesh

    try:
        mesh = trimesh.load(str(path), force="mesh", process=False)
    except Exception as error:  # trimesh lets its parsers' own exceptions through
        raise MeshError(f"{path}: can't be read as a mesh ({error})") from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise MeshError(f"{path}: holds no triangles")
    return mesh


def trajectory_metrics(poses: np.ndarray, truth: np.ndarray) -> dict[str, Any]:
    """ATE with and without alignment, and RPE from frame to frame, of poses (N, 4, 4) against truth (N, 4, 4)."""
    aligned = ate(poses, truth)
    metrics: dict[str, Any] = {
        "ate_m": {
            "aligned": _statistics(aligned),
            "unaligned": _statistics(ate(poses, truth, align=False)),
            "frames_without_truth": aligned.skipped_count,
        }
    }
    try:
        relative = rpe(poses, truth)
    except InputError as error:  # no two neighbours with known truth
        log.info("no relative error: %s", error)
    else:
        metrics["rpe"] = {
            "delta_frames": relative.delta,
            "translation_m": _statistics(relative.translation),
            "rotation_deg": _statistics(relative.rotation),
        }
    return metrics


def _statistics(error: Statistics) -> dict[str, float]:
    return {name: getattr(error, name) for name in ("rmse", "mean", "median", "std", "min", "max")}


def reconstruction_metrics(result: ReconstructionResult) -> dict[str, Any]:
    """The figures of a reconstruction, named with their units."""
    return {
        "accuracy_m": result.accuracy,
        "completion_m": result.completion,
        "completion_ratio_5cm": result.completion_ratio,
        "samples": result.sample_count,
        "T_truth_mesh": result.T_truth_mesh,
    }


def psnr(rendered: np.ndarray, rgb: np.ndarray) -> float:
    """Peak signal-to-noise ratio [dB] of a rendering (H, W, 3), 0..1, against a uint8 image (H, W, 3)."""
    mean_square = float(np.mean((np.clip(rendered, 0, 1) - rgb / 255.0) ** 2))
    return float(-10 * np.log10(max(mean_square, 1e-12)))


def _select(sequence: RgbdSequence, frames: slice | None) -> range:
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
def _log_file(path: Path) -> Iterator[None]:
    """Send everything that warpslam logs, from INFO up, to a file as well."""
    logger = logging.getLogger("warpslam")
    handler = LogFile(path, logger)
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
