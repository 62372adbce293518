"""A finished run in the browser, with a slider over its frames."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from warpslam.camera import Intrinsics
from warpslam.errors import DatasetError, WarpSlamError
from warpslam.evaluation import load_mesh
from warpslam.pipeline.finished import frame_indices
from warpslam.pipeline.setup import as_configured, load_slam, open_source
from warpslam.report import RunData
from warpslam.runs.folder import RunFolder
from warpslam.viewer.loops import loop_lines
from warpslam.viewer.page import Address, Page

log = logging.getLogger(__name__)

_RATE = 15.0  # [1/s] of frames that are played
_RENDERED_WIDTH = 160  # [px]
_REST = 0.3  # [s] that the slider rests before the map is rendered
_NO_CAMERA = Intrinsics(300, 300, 159.5, 119.5, 320, 240)  # where the input is gone: for a frustum


@dataclass(frozen=True)
class _Surface:
    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray


class FinishedView:
    """The page of a run that is over.

    Args:
        folder: Run.
        address: Where the page is served.
        device: Of the map, which is rendered where the slider rests; its images are left out where it can't be loaded.

    Raises:
        DatasetError: The run has no trajectory, or a file of it is damaged.
        MissingDependencyError: viser is not installed.
    """

    def __init__(self, folder: RunFolder, address: Address, device: str | None = None) -> None:
        folder.require(folder.trajectory, "the run stopped before its first frame")
        self._data = RunData.gather(folder)
        self._indices = self._frame_indices()
        self._sequence = self._attempt("its input can't be shown", self._open_sequence)
        self._slam = self._attempt("its map can't be rendered", lambda: load_slam(folder, device))
        camera = _NO_CAMERA if self._sequence is None else self._sequence.intrinsics
        self.page = Page(self._data.name, camera, address)
        self._stride = max(1, camera.width // _RENDERED_WIDTH)
        self._lock = threading.Lock()
        self._wanted = self._rendered = -1
        poses = self._data.poses
        self.page.place_camera(poses[0], self._data.statuses[0])
        self._mapped = self._all_poses()
        keyframes = [frame for frame in self._data.metrics.keyframes.frames or () if frame < len(self._mapped)]
        self.page.show_keyframes(self._mapped[keyframes])
        if folder.mesh.is_file():
            mesh = load_mesh(folder.mesh)
            self.page.show_surface("whole", _Surface(mesh.vertices, mesh.faces, mesh.visual.vertex_colors))
        self._move = self.page.add_slider(len(poses), self.show)
        self.show(len(poses) - 1)
        self._move(len(poses) - 1)

    def show(self, position: int) -> None:
        """Show the frame at a position of the trajectory, the path up to it, and the loops of that."""
        data = self._data
        position = int(np.clip(position, 0, len(data.poses) - 1))
        with self._lock:
            self._wanted, self._wanted_at = position, time.perf_counter()
            self.page.place_camera(data.poses[position], data.statuses[position])
            self.page.show_path(data.poses[: position + 1, :3, 3])
            known = len(self._mapped) - len(data.poses) + position + 1
            self.page.show_loops(loop_lines(data.metrics.loops.edges, self._mapped[:known, :3, 3]))
            seconds = data.timestamps[position] - data.timestamps[0]
            self.page.say(
                f"**{data.name}**  \nframe {self._indices[position]} ({position + 1} of {len(data.poses)}) · "
                f"{seconds:.2f} s · **{data.statuses[position]}**{self._error(position)}"
            )
            self._show_input(position)

    def serve(self, keep_on: Callable[[], bool] = lambda: True) -> None:
        """Play, and render the frame where the slider rests, as long as ``keep_on`` says so, or until ctrl-C."""
        try:
            while keep_on():
                time.sleep(1 / _RATE)
                if self.page.is_playing:
                    self._move((self._wanted + 1) % len(self._data.poses))
                elif self._wanted != self._rendered and time.perf_counter() - self._wanted_at > _REST:
                    self._show_rendering(self._wanted)
        except KeyboardInterrupt:
            pass
        finally:
            self.page.close()

    def _show_input(self, position: int) -> None:
        if self._sequence is None:
            return
        try:
            self.page.show_input(self._sequence[self._indices[position]].rgb)
        except DatasetError as error:
            log.warning("%s", error)

    def _show_rendering(self, position: int) -> None:
        self._rendered = position
        if self._slam is None or not self.page.is_watched:
            return
        try:
            image = self._slam.render(self._data.poses[position], stride=self._stride)
        except WarpSlamError as error:
            log.warning("frame %d can't be rendered: %s", self._indices[position], error)
            return
        self.page.show_rendering(np.rint(255 * np.clip(image.rgb, 0, 1)).astype(np.uint8))

    def _error(self, position: int) -> str:
        ate = self._data.ate
        if ate is None or position not in ate.frame_indices:
            return ""
        return f" · error {100 * ate.errors[list(ate.frame_indices).index(position)]:.2f} cm"

    def _all_poses(self) -> np.ndarray:
        """Poses (N, 4, 4) of all frames that the map has seen: in a run that went on with a map, its frames come first,
        and figures of keyframes count from them.
        """
        poses = self._data.poses
        if self._slam is None or len(self._slam.trajectory.poses) < len(poses):
            return poses
        return np.asarray(self._slam.trajectory.poses)

    def _frame_indices(self) -> list[int]:
        try:
            return frame_indices(self._data.folder, len(self._data.poses))
        except DatasetError:
            return self._data.frame_indices

    def _open_sequence(self) -> Any:
        folder = self._data.folder
        return as_configured(open_source(folder.read_source()), folder.read_config())

    def _attempt(self, without: str, open_: Callable[[], Any]) -> Any:
        try:
            return open_()
        except WarpSlamError as error:
            log.warning("%s: %s", without, error)
            return None
