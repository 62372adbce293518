"""When tracking and mapping run: one after the other, or side by side.

A schedule is handed the frames to map and hands back what came of them:

    start(task, keyframes)      map a frame; nothing else is under way
    is_busy                     a task was not taken over yet
    has_finished                it can be, without waiting
    finished(wait)              the outcome of the last task, once: from then on it is in the map that the tracker reads

`Strict` maps within `start`, so that a run repeats to the bit. `Overlapped` maps beside the frames that follow. Its
mapper has a map of its own, copied from the tracker's once; when a task is taken over, between two tracked frames, the
rows that the task changed are copied to the tracker's map, and the version of that map goes up by one. The mapper also
has its own images and its own copies of the keyframes, so that nothing is shared while both run. A task can't start
before the one before it was taken over: at most one is missing from the map that a frame is tracked against, and none
from that of a frame that is to be mapped, because the map would inherit the error of its pose. So a run that maps every
n-th frame has n - 1 frames to hide a task behind, and one that maps every frame gains nothing.
"""

from __future__ import annotations

import contextvars
import logging
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol

import numpy as np
import warp as wp

from warpslam.mapping.mapper import MappingResult
from warpslam.mapping.policy import MapOptimizer
from warpslam.mapping.remapping import Remapping
from warpslam.scene.image_pool import ImagePool
from warpslam.scene.keyframes import Keyframe
from warpslam.scene.scene_map import SceneMap

THREAD_NAME = "warpslam-mapping"

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class MappingTask:
    """A frame to map, whose image is in slot 0 of the pool."""

    kind: Literal["first", "frame", "refinement", "again"]
    """The first frame of a map, a later one, the final refinement of the map, or what a loop has moved."""
    frame: int
    """Its number."""
    pose: np.ndarray
    """Its T_world_camera (4, 4)."""
    extent: tuple[np.ndarray, np.ndarray] | None = None
    """Box to grow the map to, lower and upper corner [m]; None leaves the map's."""
    rounds: range = range(0)
    """Numbers of the rounds of a refinement."""
    remapping: Remapping | None = None
    """What is mapped again."""

    def start(self, mapper: MapOptimizer, images: ImagePool, keyframes: list[Keyframe]) -> Callable[[], MappingResult]:
        """Launch the work; the function that is returned waits for it and reads its outcome."""
        if self.extent is not None:
            mapper.scene.cover(*self.extent)
        if self.kind == "first":
            return mapper.start_first(images, self.frame, self.pose)
        if self.kind == "frame":
            return mapper.start_frame(images, self.frame, self.pose, keyframes)
        if self.remapping is not None:
            result = self.remapping.run(mapper, images, keyframes)
            return lambda: result
        # Its rounds build on one another: it is done when they are.
        result = mapper.refine(images, self.frame, self.pose, keyframes, self.rounds)
        return lambda: result


class Scheduler(Protocol):
    """What `warpslam.slam.Slam` asks of a schedule."""

    @property
    def is_busy(self) -> bool:
        """Whether there is a task whose outcome was not taken over."""

    @property
    def has_finished(self) -> bool:
        """Whether there is an outcome to take over without waiting; a failure is one."""

    def start(self, task: MappingTask, keyframes: list[Keyframe]) -> None:
        """Map a frame. ``keyframes`` is the list that later ones are appended to; refined poses are written into it."""

    def finished(self, *, wait: bool) -> tuple[int, MappingResult] | None:
        """Frame and outcome of the last task if it is done and was not handed out yet; ``wait`` until it is done.

        Raises:
            Exception: whatever the task raised, from where it was raised.
        """


def new_scheduler(schedule: str, mapper: MapOptimizer, images: ImagePool) -> Scheduler:
    """The schedule of `Config.schedule`; ``mapper`` works on the map that the tracker reads."""
    return Strict(mapper, images) if schedule == "strict" else Overlapped(mapper, images)


class Strict:
    """Tracking waits for mapping: the same input gives the same bytes."""

    def __init__(self, mapper: MapOptimizer, images: ImagePool) -> None:
        self.mapper, self.images = mapper, images
        self._finished: tuple[int, MappingResult] | None = None

    @property
    def is_busy(self) -> bool:
        """See `Scheduler`."""
        return self._finished is not None

    @property
    def has_finished(self) -> bool:
        """See `Scheduler`."""
        return self._finished is not None

    def start(self, task: MappingTask, keyframes: list[Keyframe]) -> None:
        """See `Scheduler`."""
        self._finished = task.frame, task.start(self.mapper, self.images, keyframes)()

    def finished(self, *, wait: bool) -> tuple[int, MappingResult] | None:
        """See `Scheduler`."""
        finished, self._finished = self._finished, None
        return finished


class Overlapped:
    """Mapping beside tracking, at most one task behind.

    scene: The map that the tracker reads.
    version: Tasks that are in it.
    """

    def __init__(self, mapper: MapOptimizer, images: ImagePool) -> None:
        self.mapper, self.images = mapper, images
        self.scene = mapper.scene
        self.version = 0
        self._beside = _Stream(mapper.device) if mapper.device.is_cuda else _Thread()
        self._working: tuple[SceneMap, ImagePool] | None = None
        self._under_way: _UnderWay | None = None

    @property
    def is_busy(self) -> bool:
        """See `Scheduler`."""
        return self._under_way is not None

    @property
    def has_finished(self) -> bool:
        """See `Scheduler`."""
        return self._under_way is not None and self._beside.is_done

    def start(self, task: MappingTask, keyframes: list[Keyframe]) -> None:
        """See `Scheduler`."""
        if self._under_way is not None:
            raise RuntimeError(f"frame {task.frame} can't be mapped before frame {self._under_way.task.frame} is done")
        if self._working is None:
            # Not before now: a saved map may have been loaded into the tracker's arrays.
            self._working = self.scene.copy(), self.images.fork()
        self.mapper.scene, images = self._working
        images.copy_current(self.images)
        copies = [replace(keyframe, pose=keyframe.pose.copy()) for keyframe in keyframes]
        self._under_way = _UnderWay(task, keyframes, copies)
        try:
            self._beside.start(lambda: task.start(self.mapper, images, copies))
        except Exception:
            self._give_up()
            raise

    def finished(self, *, wait: bool) -> tuple[int, MappingResult] | None:
        """See `Scheduler`. An interrupt while waiting leaves the task under way; a failure leaves the tracker's map as
        it was.
        """
        under_way = self._under_way
        if under_way is None or not (wait or self._beside.is_done):
            return None
        try:
            result = self._beside.result()
        except Exception:
            self._give_up()
            raise
        self._under_way = None
        self.scene.update_from(self.mapper.scene, self.mapper.changed_rows())
        self.version += 1
        under_way.write_back(result)
        _log.debug("frame %d is in version %d of the map", under_way.task.frame, self.version)
        return under_way.task.frame, result

    def _give_up(self) -> None:
        """Forget a task that failed, and with it the mapper's map, in which half of it is."""
        self._under_way = self._working = None


@dataclass(frozen=True)
class _UnderWay:
    """A task, the list of keyframes, and the copies that the mapper refines."""

    task: MappingTask
    keyframes: list[Keyframe]
    copies: list[Keyframe]

    def write_back(self, result: MappingResult) -> None:
        for keyframe, refined in zip(self.keyframes, self.copies, strict=False):
            keyframe.pose = refined.pose
        if result.adjusted:
            # The frame itself may have become a keyframe meanwhile.
            for keyframe in self.keyframes[len(self.copies) :]:
                if keyframe.index == self.task.frame:
                    keyframe.pose = result.pose.copy()


class _Thread:
    """Runs a task on a thread that ends with it."""

    def __init__(self) -> None:
        self._executor: ThreadPoolExecutor | None = None
        self._future: Future[MappingResult] = Future()

    @property
    def is_done(self) -> bool:
        return self._future.done()

    def start(self, work: Callable[[], Callable[[], MappingResult]]) -> None:
        self._executor = ThreadPoolExecutor(1, thread_name_prefix=THREAD_NAME)
        # The context tells a profile which phase the work belongs to.
        self._future = self._executor.submit(contextvars.copy_context().run, lambda: work()())

    def result(self) -> MappingResult:
        try:
            return self._future.result()
        finally:
            if self._executor is not None and self._future.done():
                self._executor.shutdown()


class _Stream:
    """Launches a task on a CUDA stream of its own and leaves it to the device, where it runs beside the current stream.

    Warp has one current stream a device for all threads; therefore it is the thread of the tracker that launches. This
    class has not run on a GPU yet.
    """

    def __init__(self, device: wp.Device) -> None:
        self._stream = wp.Stream(device)
        self._outcome: Callable[[], MappingResult] | None = None
        self._event: Any = None

    @property
    def is_done(self) -> bool:
        return bool(self._event.is_complete)

    def start(self, work: Callable[[], Callable[[], MappingResult]]) -> None:
        # Entering the scope makes the stream wait for what the tracker has launched: the image, and the last copy of
        # the map, whose source is about to change.
        with wp.ScopedStream(self._stream):
            self._outcome = work()
        self._event = self._stream.record_event()

    def result(self) -> MappingResult:
        assert self._outcome is not None
        with wp.ScopedStream(self._stream, sync_enter=False):
            result = self._outcome()
        # The tracker's stream reads the map only when it is whole.
        wp.wait_event(self._event)
        return result
