"""One run, from a sequence to a folder: trajectory, map, mesh, figures and what they are worth."""

from __future__ import annotations

import dataclasses
import logging
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from warpslam.errors import ConfigError, DatasetError
from warpslam.evaluation import ate
from warpslam.pipeline.checkpoints import SavedRun, find_checkpoint, frame_digest, remove_checkpoints, write_checkpoint
from warpslam.pipeline.log import log_file
from warpslam.pipeline.methods import DEFAULT_METHOD, has_checkpoints
from warpslam.pipeline.results import RunResults
from warpslam.pipeline.setup import (
    build_baseline,
    build_slam,
    check_checkpoint_settings,
    device_name,
    load_kernels,
    open_map,
    select_frames,
)
from warpslam.runs.folder import RunFolder
from warpslam.runs.given_poses import GivenPoses
from warpslam.runs.record import Progress, RunProgress, RunResult
from warpslam.runs.request import RunRequest, Source
from warpslam.runtime.kernel_cache import kernel_cache_errors
from warpslam.sequences.checking import ERROR, OK, check_sequence
from warpslam.storage.writing import output_error

if TYPE_CHECKING:
    import trimesh

    from warpslam.config import Config
    from warpslam.frames import FrameResult
    from warpslam.runtime.compilation import ModuleProgress
    from warpslam.sequences.base import Frame, RgbdSequence

log = logging.getLogger(__name__)


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
    go_on: bool = False,
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
        method: One of `warpslam.pipeline.methods.METHODS`.
        poses: Trajectory in the TUM format whose poses are given to the method in place of the sequence's own; frames
            without one are left out. Errors are against the sequence's own as ever.
        checkpoint_every: Frames between two checkpoints; None for none. With the schedule strict a resumed run gives
            the same bytes as one that was never stopped; with overlapped it gives a result as good as any other run's.
        map_path: Map to start from, a file that `Slam.save` wrote; the first frame is looked for in it.
        localize_only: The map is left as it is.
        saved: Checkpoint of the run in ``output``, which goes on from there; all else must be as it was.
        go_on: Go on from the last checkpoint in ``output``, where there is one of this very run; where it is of no use,
            a warning says why, and the run starts from the beginning.
        check_input: Refuse an input that `warpslam.sequences.checking` finds can't work; its warnings
            are logged in any case.

    Raises:
        WarpSlamError: The input or a setting can't be used, or a result can't be written. metrics.json is written even
            so, where it can be.
    """
    selected = select_frames(sequence, frames)
    check_checkpoint_settings(checkpoint_every, map_path, localize_only, method)
    request = RunRequest(
        sequence.name,
        len(sequence),
        dataclasses.asdict(sequence.intrinsics),
        (selected.start, selected.stop, selected.step),
        config.model_dump(),
        seed,
        device_name(device),
        str(map_path) if map_path is not None else None,
        localize_only,
        dataclasses.asdict(source) if source is not None else None,
        str(poses) if poses is not None else None,
    )
    why_anew = ""
    if go_on and has_checkpoints(method) and saved is None and output is not None:
        saved, why_anew = find_checkpoint(RunFolder(output), request, sequence)
    elif saved is not None:
        saved.check(request, sequence)
    if saved is None:
        folder = RunFolder.create(output, sequence.name)
    else:
        assert output is not None
        folder = RunFolder(output)
        folder.clear_results()
    with log_file(folder.log, append=saved is not None):
        given = None if poses is None else GivenPoses.read(poses)
        run_ = _Run(
            sequence, config, folder, selected, device, seed, source, truth_mesh, method, given, on_frame=on_frame,
            on_module=on_module, check_input=check_input, request=request, checkpoint_every=checkpoint_every,
        )  # fmt: skip
        if saved is not None:
            run_.go_on_from(saved)
        elif why_anew:
            run_.metrics["started_anew"] = why_anew
            log.warning("starting from the beginning: %s", why_anew)
        return run_.execute()


@dataclass(eq=False)
class _Run(RunResults):
    """A run under way: the loop over the frames, and its checkpoints."""

    on_frame: Callable[[Progress], None] | None = None
    on_module: Callable[[ModuleProgress], None] | None = None
    check_input: bool = True
    request: RunRequest | None = None
    checkpoint_every: int | None = None
    saved: SavedRun | None = None
    position: int = 0  # in the selection
    resumed_count: int = 0  # results that came from a checkpoint
    digests: dict[int, str] = field(default_factory=dict)
    start: float = 0.0
    frames_start: float = 0.0

    def go_on_from(self, saved: SavedRun) -> None:
        """Take up a run at its checkpoint."""
        progress, self.saved = saved.progress, saved
        self.position, self.first_index = progress.position, progress.first_index
        self.frame_indices, self.truth_poses = progress.frame_indices, progress.truth_poses
        self.results, self.left_out = progress.results, progress.left_out
        self.seconds.update(progress.seconds)
        self.digests = progress.digests
        self.resumed_count = len(progress.results)
        self.metrics["resumed_after"] = progress.position

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
                self._write_results()
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


def _describe(result: FrameResult) -> str:
    losses = " ".join(f"{name}={value:.4g}" for name, value in result.losses.items())
    return f"{result.status} {losses} inliers={result.inliers:.2f} {result.message}".rstrip()
