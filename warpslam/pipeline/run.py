"""One run, from what is asked to a folder: trajectory, map, mesh, figures and what they are worth."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

from warpslam.errors import (
    CheckpointError,
    ConfigError,
    DatasetError,
    MapSizeError,
    MeshError,
    OutputError,
    WarpSlamError,
)
from warpslam.pipeline.checkpoints import Checkpoints, SavedRun, find_checkpoint
from warpslam.pipeline.forecast import Forecast
from warpslam.pipeline.log import log_file
from warpslam.pipeline.loop import FrameLoop
from warpslam.pipeline.methods import has_checkpoints
from warpslam.pipeline.metrics_files import figures_of_every_run, found_timing, write_frames, write_timing
from warpslam.pipeline.observer import Observer
from warpslam.pipeline.results import (
    draw_panels,
    draw_plots,
    evaluate_reconstruction,
    evaluate_trajectory,
    extract_and_write_mesh,
    remove_leftovers,
    rescue_trajectory,
    trajectory_of,
    write_map,
    write_trajectory,
)
from warpslam.pipeline.setup import (
    as_configured,
    build_slam,
    check_device,
    check_map,
    load_kernels,
    open_map,
    open_source,
    resolve,
    true_surface,
)
from warpslam.report import write_report
from warpslam.runs.folder import RunFolder
from warpslam.runs.given_poses import GivenPoses
from warpslam.runs.manifest import write_manifest
from warpslam.runs.metrics import RunMetrics
from warpslam.runs.record import FAILED, FINISHED, INTERRUPTED, UNFINISHED, RunRecord, RunResult
from warpslam.runs.request import RunRequest, SequenceFacts
from warpslam.runtime.kernel_cache import kernel_cache_errors
from warpslam.runtime.stopping import Deferral
from warpslam.sequences.checking import ERROR, OK, check_sequence
from warpslam.storage.atomic import sync_folder
from warpslam.storage.locked_folder import locked
from warpslam.storage.writing import output_error

if TYPE_CHECKING:
    import numpy as np
    import trimesh

    from warpslam.config import Config
    from warpslam.evaluation import AteResult, ReconstructionResult
    from warpslam.pipeline.methods import Method
    from warpslam.runtime.compilation import ModuleProgress
    from warpslam.sequences.base import RgbdSequence

log = logging.getLogger(__name__)


def run(
    request: RunRequest,
    output: str | Path | None = None,
    *,
    sequence: RgbdSequence | None = None,
    truth_mesh: trimesh.Trimesh | None = None,
    observer: Observer | None = None,
    saved: SavedRun | None = None,
    go_on: bool = False,
    check_input: bool = True,
    overwrite: bool = False,
    discard: bool = False,
) -> RunResult:
    """Run SLAM over a sequence and write a run folder.

    Args:
        request: What is asked for.
        output: Folder to write; None for ``runs/<sequence>/<time>``. Nobody else may write into it meanwhile.
        sequence: Input; None to open that of the request.
        truth_mesh: True surface in the world frame of the sequence; None for that of the request.
        observer: Told of every frame, and of every module of kernels.
        saved: Checkpoint of the run in ``output``, which goes on from there; all else must be as it was.
        go_on: Go on from the last checkpoint in ``output``, where there is one of this very run; where it is of no use,
            a warning says why, and the run starts from the beginning.
        check_input: Refuse an input that `warpslam.sequences.checking` finds can't work; its warnings
            are logged in any case.
        overwrite: ``output`` may hold a run: the new one is written beside it (``next_run`` in its folder) and takes
            its place when it is finished. With ``go_on`` it always may.
        discard: With ``overwrite``, a run that was stopped while it grew there is given up.

    Raises:
        WarpSlamError: The input or a setting can't be used, or a result can't be written. metrics.json is written even
            so, where it can be.
    """
    observer = observer or Observer()
    if sequence is None:
        if request.source is None:
            raise ConfigError("the request has no source: name one, or hand over a sequence")
        sequence = open_source(request.source)
    # Whatever can be wrong with what is asked for is found before anything is written.
    check_device(request.device)
    request = resolve(request, sequence)
    sequence = as_configured(sequence, request.config)
    truth_mesh = true_surface(request, sequence) if truth_mesh is None else truth_mesh
    given = None if request.poses is None else GivenPoses.read(request.poses)
    check_map(request.map)
    observer.begin(sequence.name)
    why_anew = ""
    folder = None if output is None else RunFolder(output)
    if saved is not None:
        saved.check(request, sequence)
    elif go_on and folder is not None and has_checkpoints(request.method):
        for candidate in (folder, folder.successor):
            folder = candidate
            saved, why = find_checkpoint(folder, request, sequence)
            why_anew = why_anew or why
            if saved is not None:
                why_anew = ""
                break
    if saved is None:
        folder = RunFolder.create(output, sequence.name, overwrite=overwrite or go_on, discard=discard or go_on)
    assert folder is not None
    with locked(folder.path), log_file(folder.log, append=saved is not None):
        under_way = Run(request, sequence, folder, truth_mesh, given, observer, saved, check_input)
        if why_anew:
            under_way.metrics.started_anew = why_anew
            log.warning("starting from the beginning: %s", why_anew)
        result = under_way.execute()
    if result.status == FINISHED:
        try:
            result = replace(result, folder=folder.take_place())
        except OSError as error:
            raise output_error(error, folder.path) from error
    observer.done(result)
    return result


@dataclass(eq=False)
class Run:
    """A run under way."""

    request: RunRequest
    """What is asked for, resolved."""

    sequence: RgbdSequence
    """Input."""

    folder: RunFolder
    """Where everything is written."""

    truth_mesh: trimesh.Trimesh | None
    """True surface, where it is known."""

    given: GivenPoses | None
    """Poses that take the place of the sequence's own."""

    observer: Observer
    saved: SavedRun | None
    """Checkpoint that the run goes on from."""

    must_pass_checks: bool
    """An input that can't work is refused."""

    metrics: RunMetrics = field(default_factory=RunMetrics)
    """Figures so far."""

    record: RunRecord = field(default_factory=RunRecord)
    """What has become of it so far."""

    started: datetime = field(default_factory=lambda: datetime.now().astimezone())
    status: str = FINISHED
    modules: list[ModuleProgress] = field(default_factory=list)
    """Modules of kernels that were loaded."""

    _marks: dict[str, tuple[int, int]] = field(default_factory=dict)
    _unwritten: Exception | None = None
    _stopping: Deferral = field(default_factory=Deferral)
    slam: Method | None = None
    ate: AteResult | None = None
    reconstruction: ReconstructionResult | None = None

    def __post_init__(self) -> None:
        self.selected = range(*(part or 0 for part in self.request.frames))
        facts = SequenceFacts.of(self.sequence)
        self.checkpoints = Checkpoints(self.folder, self.request, facts, len(self.selected))
        if self.saved is not None:
            self.record = self.saved.record
            self.checkpoints.position = self.record.position
            self.metrics.resumed_after = self.record.position

    def execute(self) -> RunResult:
        """All steps, one after the other. Whatever ends them, what there is by then is written; checkpoints go last.

        A request to stop ends the frames, or what is done to the map after them; one that comes while the results are
        written waits for them; a second one ends that as well.
        """
        self._marks = self.folder.marks()
        with self._stopping:
            try:
                with self.record.clock("total"):
                    with self._interruptible():
                        self._admit_input()
                        self._check_input()
                        self._build()
                        self._process_frames()
                        self._finish_map()
                        self._stopping.defer()
                    if self.record.results:
                        self._write_results()
                    if self._stopping.has_come:
                        self.status = INTERRUPTED
                        log.warning("interrupted while the results were written: they are whole")
            except KeyboardInterrupt:
                self.status = INTERRUPTED
            except OSError as error:
                self._fail(error)
                raise output_error(error, self.folder.path) from error
            except Exception as error:
                self._fail(error)
                raise
            finally:
                self._write_account()
            if self.status == FINISHED:
                self._close()
        return RunResult(self.folder, self.status, self.metrics, self.ate, self.reconstruction)

    def _close(self) -> None:
        """Everything is there: what is not of this run goes, and what the run could go on from at the very last."""
        try:
            self.folder.remove_stale(self._marks)
            write_manifest(self.folder)
            sync_folder(self.folder.path)
            self.folder.remove_checkpoints()
        except OSError as error:
            raise output_error(error, self.folder.path) from error

    @property
    def config(self) -> Config:
        """All settings, in a copy: what the method does to its own is no matter of the request."""
        assert self.request.config is not None, "resolved"
        return self.request.config.model_copy(deep=True)

    @contextmanager
    def _interruptible(self) -> Iterator[None]:
        try:
            yield
        except KeyboardInterrupt:
            self.status = INTERRUPTED
            log.warning("interrupted: writing what there is; press ctrl-C again to leave it")

    def _admit_input(self) -> None:
        self.config.save(self.folder.config)
        if self.request.source is not None:
            self.folder.write_source(self.request.source)
        log.info("%s: %d of %d frames, %s", self.sequence.name, len(self.selected), len(self.sequence), self.selected)

    def _check_input(self) -> None:
        if self.sequence.is_live:
            return
        # Poses of a file take the place of the sequence's own, which then matter for the errors alone.
        poses_matter = self.config.tracking.use_given_poses and self.given is None
        if poses_matter and self.sequence.ground_truth() is None and self._first_pose() is None:
            raise ConfigError(
                f"tracking.use_given_poses is on, but {self.sequence.name} has no poses; give them with --poses FILE, "
                "or leave that setting out"
            )
        with self.record.clock("checking"):
            given = None
            if self.given is not None:
                self.given = self.given.fitted_to(self.sequence, self.selected)
                given = self.given.of_frames(self.sequence, self.selected)
            findings = check_sequence(
                self.sequence,
                self.selected,
                max_depth=self.config.grid.max_depth,
                poses_matter=poses_matter,
                given_poses=given,
                given_path=None if self.given is None else self.given.path,
            )
        bad = [finding for finding in findings if finding.severity != OK]
        self.metrics.fill({"input_checks": [vars(finding) for finding in bad]})
        for finding in bad:
            log.warning("%s", finding)
        errors = [str(finding) for finding in bad if finding.severity == ERROR]
        if errors and self.must_pass_checks:
            raise DatasetError(f"{self.sequence.name}: {'; '.join(errors)} (warpslam check tells more)")

    def _first_pose(self) -> np.ndarray | None:
        try:
            return self.sequence[self.selected[0]].T_world_camera
        except DatasetError:
            return None

    def _build(self) -> None:
        request, camera, timing = self.request, self.sequence.intrinsics, self.sequence.timing
        with self.record.clock("setup"), kernel_cache_errors():
            with self.record.clock("kernel_compile"):
                self.modules = load_kernels(self.sequence, request.device, self.observer.module, self.config)
            if self.saved is not None:
                self.slam = self.saved.slam(self.config)
                log.info("resumed from %s, after %d frames", self.saved.path, self.record.position)
            elif request.map is not None:
                localize = request.localize_only
                slam = open_map(request.map, camera, self.config, request.device, timing=timing, localize_only=localize)
                self.record.first_index = len(slam.trajectory.poses)
                self.slam = slam
            else:
                self.slam = build_slam(camera, self.config, request.device, request.seed, request.method, timing)
        self.record.seconds["kernel_compile"] += self.slam.compile_seconds
        self.observer.ready(self.slam, self.sequence)

    def _process_frames(self) -> None:
        assert self.slam is not None
        loop = FrameLoop(
            self.sequence,
            self.selected,
            self.slam,
            self.record,
            self.given,
            poses_are_wanted=self.config.tracking.use_given_poses,
            world_is_known=self.request.map is None,
            checkpoints=self.checkpoints,
            observer=self.observer,
            forecast=self._forecast(),
        )
        try:
            with self.record.clock("frames"):
                loop.run()
        finally:
            if self.sequence.is_live:
                self.selected = range(self.record.position)

    def _forecast(self) -> Forecast:
        assert self.slam is not None
        count, evaluates = len(self.selected), self.truth_mesh is not None
        return Forecast(self.config, self.sequence, self.slam, count, evaluates=evaluates)

    def _finish_map(self) -> None:
        assert self.slam is not None
        self.observer.stage("refining the map")
        with self.record.clock("finish"):
            phases = self.slam.finish()
        for phase, seconds in phases.items():
            self.record.seconds[f"finish_{phase}"] += seconds

    def _write_results(self) -> None:
        """All that needs the map: what is small first, and nothing waits for what does not fit on the disk."""
        assert self.slam is not None
        folder, slam, record, metrics = self.folder, self.slam, self.record, self.metrics
        trajectory = trajectory_of(slam, record)
        stage = self.observer.stage
        stage("saving")
        self._attempt(lambda: write_trajectory(folder, trajectory, record))
        self.ate = evaluate_trajectory(trajectory, record, metrics)
        self._attempt(lambda: self._write_figures(UNFINISHED))  # `warpslam report` goes by them if the rest never comes
        self._attempt(lambda: write_map(folder, slam, record, metrics))
        if not self._makes_map:
            log.info("mapping.enabled is off: there is a trajectory, and no map to make a mesh of")
            metrics.fill({"mesh": {"error": "mapping.enabled is off"}})
            self._attempt(lambda: draw_plots(folder, trajectory, self.ate, record))
        else:
            stage("extracting the mesh")
            self._attempt(lambda: extract_and_write_mesh(folder, slam, record, metrics))
            if self.truth_mesh is not None:
                stage("comparing the mesh with the true surface")
            self.reconstruction = evaluate_reconstruction(
                folder, self.truth_mesh, self.sequence, trajectory, record, metrics, self.request.device
            )
            self._attempt(lambda: draw_plots(folder, trajectory, self.ate, record))
            stage("rendering pictures")
            self._attempt(lambda: draw_panels(folder, slam, self.sequence, trajectory, record, metrics))
        if self._unwritten is not None:
            raise self._unwritten

    def _attempt(self, write: Callable[[], None]) -> None:
        """Write something; the first error that its place on the disk is to blame for is raised when all was tried."""
        try:
            write()
        except (OSError, OutputError, CheckpointError) as error:
            remove_leftovers(self.folder)
            log.error("%s", output_error(error, self.folder.path) if isinstance(error, OSError) else error)
            self._unwritten = self._unwritten or error
        except MeshError as error:
            if not isinstance(error.__cause__, OSError):
                raise
            self._unwritten = self._unwritten or error

    @property
    def _makes_map(self) -> bool:
        """Whether there is a map in the end."""
        config = self.request.config
        return self.request.map is not None or config is None or config.mapping.enabled

    def _write_account(self) -> None:
        """All that is written however the run ended: figures, what became of each frame, and the report."""
        try:
            self._write_figures()
            self.observer.stage("writing the report")
            self._write_report()
        except OSError as error:
            if self.status != FAILED:
                self.status = FAILED
                raise output_error(error, self.folder.path) from error
            log.error("%s", output_error(error, self.folder.path))

    def _write_figures(self, status: str | None = None) -> None:
        request, checkpoints = self.request, self.checkpoints
        self.metrics.fill(
            {
                "sequence": self.sequence.name,
                "method": request.method,
                "poses": None if self.given is None else self.given.path,
                "status": status or self.status,
                "device": request.device if self.slam is None else str(self.slam.device),
                "seed": request.seed,
                "started": self.started.isoformat(timespec="seconds"),
                **figures_of_every_run(self.record, len(self.selected), self.modules),
            }
        )
        if checkpoints.size is not None:
            self.metrics.fill({"checkpoint": {"bytes": checkpoints.size, "every_frames": request.checkpoint_every}})
        found = found_timing(self.record, self.sequence)
        if found is not None:
            self.metrics.fill({"found_timing": found})
        self.metrics.write(self.folder.metrics)
        write_timing(self.folder, self.record, self.modules)
        write_frames(self.folder, self.record)

    def _write_report(self) -> None:
        try:
            write_report(self.folder)
        except WarpSlamError as error:
            # The run is done and its figures are written; what stands in the way is in the log and on the terminal.
            log.error("no report: %s", error)
        except Exception:
            # Must not take the place of the error that ended the run.
            if self.status != FAILED:
                raise
            log.exception("no report")

    def _fail(self, error: Exception) -> None:
        """Note the failure, and save what is worth it and was not saved yet: the map where it only must not grow."""
        self._stopping.defer()
        self.status = FAILED
        self.metrics.error = f"{type(error).__name__}: {error}"
        log.exception("the run failed")
        remove_leftovers(self.folder)
        if not self.record.results or self.slam is None:
            return
        if isinstance(error, MapSizeError) and self._makes_map:
            try:
                self._write_results()
            except Exception as second:
                log.error("what there is can't be written: %s", second)
        elif self.folder.marks().get("trajectory.tum") == self._marks.get("trajectory.tum"):
            rescue_trajectory(self.folder, trajectory_of(self.slam, self.record), self.record)
