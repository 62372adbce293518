"""A run that is watched while it goes on, for at most a twentieth of its time."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from warpslam.errors import MeshError, WarpSlamError
from warpslam.frames import FrameStatus
from warpslam.meshing.growing import GrowingMesh
from warpslam.pipeline.observer import Observer
from warpslam.viewer.loops import loop_lines, loops_of
from warpslam.viewer.page import Address, Page

if TYPE_CHECKING:
    from warpslam.pipeline.methods import Method
    from warpslam.runs.record import Progress, RunResult
    from warpslam.sequences.base import RgbdSequence

log = logging.getLogger(__name__)

SHARE = 0.04
"""Part of the engine's time that showing may take: half of it the camera and its images, half of it the map."""
_MIN_INTERVAL, _MAX_INTERVAL = 0.1, 2.0  # [s] between two states of the camera
_RENDERED_WIDTH = 64  # [px]
_RENDER_INTERVAL = 2.0  # [s], at least
_BLOCK_SECONDS = 0.05  # a helping of meshing
_BLOCKS = 24  # cells along the edge of a block
_COARSER = 2.0  # the mesh that is looked at has cells so many times as large as the one that is written


class Budget:
    """What may be spent on showing: a share of the time that passes.

    Args:
        share: The share.
        clock: Tells the time [s].
    """

    def __init__(self, share: float = SHARE, clock: Callable[[], float] = time.perf_counter) -> None:
        self._share, self._clock = share, clock
        self._begin = clock()
        self.spent = 0.0

    @property
    def left(self) -> float:
        """Seconds that may be spent now."""
        return self._share * (self._clock() - self._begin) - self.spent

    def spend(self, work: Callable[[], None]) -> float:
        """Do something; returns the seconds it took."""
        start = self._clock()
        try:
            work()
        finally:
            seconds = self._clock() - start
            self.spent += seconds
        return seconds


class LiveView(Observer):
    """Shows a run in the browser: camera, path, keyframes, images, and the mesh block by block.

    The camera is shown up to ten times a second; what the map renders, and blocks of the mesh, come as their budget
    allows, and only while a page is open. Nothing of it changes the run.

    Args:
        address: Where the page is served.
        announce: Told where the page is, once it is served.
    """

    def __init__(self, address: Address, announce: Callable[[str], None] = log.info) -> None:
        self._address, self._announce = address, announce
        self._name = ""
        self.page: Page | None = None
        self.budgets = Budget(SHARE / 2), Budget(SHARE / 2)
        self._mesh: GrowingMesh | None = None
        self._method: Any = None
        self._shown_at = self._rendered_at = -np.inf
        self._render_cost = self._mesh_cost = 0.0
        self._positions: list[np.ndarray] = []
        self._is_done = False

    def begin(self, name: str) -> None:
        """The name stands above the page."""
        self._name = name

    def ready(self, method: Method, sequence: RgbdSequence) -> None:
        """Open the page."""
        self.page = Page(self._name, sequence.intrinsics, self._address)
        self._announce(self.page.url)
        self._method = method
        if hasattr(method, "scene") and hasattr(method, "views"):  # baselines keep their map otherwise
            meshing = self._method.config.meshing
            self._mesh = GrowingMesh(
                _COARSER * meshing.voxel, meshing.level_set, block_cells=_BLOCKS, device=str(method.device)
            )
        self._stride = max(1, sequence.intrinsics.width // _RENDERED_WIDTH)
        self.budgets = Budget(SHARE / 2), Budget(SHARE / 2)

    def frame(self, progress: Progress) -> None:
        """Show what the budget allows."""
        now = time.perf_counter()
        camera, map_ = self.budgets
        since = now - self._shown_at
        is_wanted = progress.done == progress.total or not self._positions
        if is_wanted or since >= _MAX_INTERVAL or (since >= _MIN_INTERVAL and camera.left >= 0):
            self._shown_at = now
            camera.spend(lambda: self._show_camera(progress))
        assert self.page is not None
        if not self.page.is_watched:
            return
        if now - self._rendered_at >= _RENDER_INTERVAL and map_.left >= self._render_cost:
            self._rendered_at = now
            self._render_cost = map_.spend(lambda: self._show_rendering(progress))
        if map_.left >= self._mesh_cost:
            self._mesh_cost = map_.spend(lambda: self._show_blocks(_BLOCK_SECONDS))

    def done(self, result: RunResult) -> None:
        """Show the mesh in full."""
        if self.page is not None and self.page.is_watched:
            self._show_blocks(np.inf)
            self.page.say(f"**{self._name}**  \n{result.status}, {result.metrics.frames.processed} frames")
            self._is_done = True

    def close(self) -> None:
        """After a run that came to its end: wait until nobody looks any more."""
        page = self.page
        if page is None:
            return
        try:
            if self._is_done and page.is_watched:
                self._announce(f"{page.url} stays until its page is closed, or ctrl-C")
                page.wait_while_watched()
        except KeyboardInterrupt:
            pass  # the run is written; only the looking ends
        finally:
            page.close()

    def _show_camera(self, progress: Progress) -> None:
        page, result = self.page, progress.result
        assert page is not None
        page.place_camera(result.T_world_camera, result.status)
        if not page.is_watched and self._positions:
            return
        trajectory = self._method.trajectory
        known = [status == FrameStatus.OK for status in trajectory.status]
        self._positions = list(trajectory.poses[:, :3, 3][known]) if any(known) else [result.T_world_camera[:3, 3]]
        page.show_path(np.array(self._positions))
        keyframes = [keyframe.index for keyframe in getattr(self._method, "keyframes", [])]
        page.show_keyframes(trajectory.poses[keyframes])
        page.show_loops(loop_lines(loops_of(self._method), trajectory.poses[:, :3, 3]))
        if progress.frame is not None:
            page.show_input(progress.frame.rgb)
        page.say(_figures(self._name, progress))

    def _show_rendering(self, progress: Progress) -> None:
        if self.page is None or progress.result.status != FrameStatus.OK:
            return
        try:
            image = self._method.render(progress.result.T_world_camera, stride=self._stride)
        except WarpSlamError as error:  # no map yet
            log.debug("no rendering: %s", error)
            return
        self.page.show_rendering(np.rint(255 * np.clip(image.rgb, 0, 1)).astype(np.uint8))

    def _show_blocks(self, seconds: float) -> None:
        mesh, page = self._mesh, self.page
        if mesh is None or page is None or self._method.scene.is_empty:
            return
        try:
            for key, block in mesh.update(self._method.scene, self._method.views, seconds):
                page.show_surface("_".join(map(str, key)), block)
        except MeshError as error:  # nothing was mapped yet
            log.debug("no mesh: %s", error)


def _figures(name: str, progress: Progress) -> str:
    total = f" of {progress.total}" if progress.total > progress.done else ""
    rows = [
        f"**{name}**",
        f"frame {progress.done}{total} · **{progress.result.status}** · {progress.fps:.1f} frames/s",
    ]
    if progress.ate_rmse is not None:
        rows.append(f"ATE {100 * progress.ate_rmse:.2f} cm")
    if progress.result.message:
        rows.append(progress.result.message)
    return "  \n".join(rows)
