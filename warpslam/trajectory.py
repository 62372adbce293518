"""The camera's trajectory: what came out of it, and the record of frames that it is taken from.

A pose is ``T_world_camera``, float64 (4, 4), lengths in metres.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from warpslam.camera import Intrinsics
from warpslam.frames import FrameStatus
from warpslam.poses import are_rigid, inverse, motion_between, twist_of
from warpslam.storage.state_file import StateFields
from warpslam.storage.trajectory_files import Views, write_trajectory

RECENT_FRAMES = 20
TWIST_STEPS = 2
"""Over one frame step an error of a pose would feed back into the next frame by tau over the frame time."""
STEP_FACTOR = 5.0  # a step beyond this multiple of the recent ones is a jump


@dataclass(frozen=True)
class Trajectory:
    """Poses of all frames so far."""

    timestamps: np.ndarray
    """[s], float64 (N,)."""
    poses: np.ndarray
    """T_world_camera, float64 (N, 4, 4)."""
    status: list[FrameStatus]
    """Of each frame."""

    def save(
        self, path: str | Path, kind: str = "tum", camera: Intrinsics | None = None, images: Sequence[str] = ()
    ) -> Path:
        """Write the poses of all frames that are OK, in one of the formats that other tools read.

        Args:
            path: File; a folder for colmap.
            kind: "tum", "kitti" (all frames, a line each), "euroc", "transforms" (nerfstudio) or "colmap".
            camera: Camera of the images; the last two formats need it.
            images: Paths of the images, for the same; one a frame.

        Raises:
            ConfigError: There is no such format, or it needs a camera.
            OSError: The file can't be written.
        """
        poses = self.poses.copy()
        if kind != "kitti":
            poses[[status is not FrameStatus.OK for status in self.status]] = np.nan
        return write_trajectory(path, Views(self.timestamps, poses, camera, images), kind)

    def after(self, first: int) -> Trajectory:
        """The frames from number ``first`` on."""
        return Trajectory(self.timestamps[first:], self.poses[first:], self.status[first:])


@dataclass(frozen=True)
class Located:
    """Where the camera of a frame is, and how far that can be believed."""

    T_world_camera: np.ndarray
    """Pose (4, 4); of a frame that is lost, the best that was found."""
    why_lost: str = ""
    """Why the pose can't be trusted; empty if it can."""
    after_loss: bool = False
    """Whether the camera was lost before, so that poses before this one say nothing of where it may go."""
    inliers: float = np.nan
    """As in `FrameResult`."""
    depth_error: float = np.nan
    """As in `FrameResult` [m]."""
    loss: float | None = None
    """Mean tracking loss per inlier; None for a pose that was given."""
    correlation: float | None = None
    """As in `FrameResult`."""
    covariance: np.ndarray | None = None
    """As in `FrameResult`."""
    reference: int | None = None
    """As in `FrameResult`."""

    @property
    def status(self) -> FrameStatus:
        """OK or LOST."""
        return FrameStatus.LOST if self.why_lost else FrameStatus.OK


@dataclass(frozen=True)
class HistoryState:
    """A `FrameHistory` as plain arrays, for N frames."""

    timestamps: np.ndarray
    """[s], float64 (N,)."""
    poses: np.ndarray
    """float64 (N, 4, 4)."""
    status: np.ndarray
    """Positions in `FrameStatus`, uint8 (N,)."""
    depth_errors: np.ndarray
    """[m], float64 (N,)."""
    motion: np.ndarray
    """float64 (4, 4)."""
    first: int
    """Frame from which the camera has moved without a break."""

    def arrays(self) -> dict[str, np.ndarray]:
        """All but ``first``, by name."""
        return {name: value for name, value in vars(self).items() if name != "first"}

    @classmethod
    def read(cls, fields: StateFields) -> HistoryState:
        """From a saved state whose arrays are `arrays`, and whose header has ``first``.

        Raises:
            CheckpointError: A field is missing or damaged.
        """
        poses = fields.poses("poses", None)
        count = len(poses)
        status = fields.array("status", np.uint8, (count,))
        if (status >= len(FrameStatus)).any():
            raise fields.damaged("status", f"codes beyond {len(FrameStatus) - 1}")
        motion = fields.array("motion", np.float64, (4, 4))
        if not are_rigid(motion[None]):
            raise fields.damaged("motion", "it is no rigid transform of a camera")
        first = fields.integer("first")
        if first > count:
            raise fields.damaged("first", f"{first} is beyond the {count} frames")
        return cls(
            timestamps=fields.array("timestamps", np.float64, (count,)),
            poses=poses,
            status=status,
            depth_errors=fields.array("depth_errors", np.float64, (count,)),
            motion=motion,
            first=first,
        )


class FrameHistory:
    """Time, pose, status and depth error of every frame, and the motion of the camera.

    A frame that is not OK has the pose of the frame before it.
    """

    def __init__(self) -> None:
        self._timestamps: list[float] = []
        self._poses: list[np.ndarray] = []
        self._status: list[FrameStatus] = []
        self._depth_errors: list[float] = []
        # Of the last frame against the one before, as it was tracked. The poses may say something else since: bundle
        # adjustment has moved one of them, and that is no motion of the camera.
        self._motion = np.eye(4)
        # From here on the camera has moved without a break; poses before say nothing of where it is.
        self._first = 0

    def __len__(self) -> int:
        return len(self._poses)

    # -- told ----------------------------------------------------------------------------------------------------

    def add(self, timestamp: float, located: Located) -> None:
        """The next frame, whose camera was looked for."""
        if located.after_loss:
            self._first = len(self)
        if located.status is not FrameStatus.OK:
            self._append(timestamp, self.last_pose, FrameStatus.LOST)
            return
        # Over a gap that was bridged the speed before it is believed.
        if self._poses and (self._status[-1] is FrameStatus.OK or located.after_loss):
            self._motion = np.linalg.inv(self.last_pose) @ located.T_world_camera
        measured = 0.0 if np.isnan(located.depth_error) else located.depth_error  # 0: of no use as a limit
        self._append(timestamp, located.T_world_camera, FrameStatus.OK, measured)

    def skip(self, timestamp: float) -> None:
        """The next frame, in which there is nothing usable."""
        self._append(timestamp, self.last_pose, FrameStatus.SKIPPED)

    def correct(self, index: int, T_world_camera: np.ndarray) -> None:
        """Bundle adjustment found a better pose of a frame."""
        self._poses[index] = T_world_camera.copy()

    def break_off(self) -> None:
        """The camera may be anywhere when the next frame comes."""
        self._first = len(self)

    def _append(self, timestamp: float, pose: np.ndarray, status: FrameStatus, depth_error: float = 0.0) -> None:
        self._timestamps.append(timestamp)
        self._poses.append(pose.copy())
        self._status.append(status)
        self._depth_errors.append(depth_error)

    # -- asked ---------------------------------------------------------------------------------------------------

    @property
    def trajectory(self) -> Trajectory:
        """All frames so far."""
        poses = np.array(self._poses, np.float64).reshape(-1, 4, 4)
        return Trajectory(np.array(self._timestamps), poses, list(self._status))

    def pose(self, index: int) -> np.ndarray:
        """Pose of a frame (4, 4)."""
        return self._poses[index].copy()

    def status(self, index: int) -> FrameStatus:
        """Status of a frame."""
        return self._status[index]

    def timestamp(self, index: int) -> float:
        """Time of a frame [s]."""
        return self._timestamps[index]

    @property
    def last_pose(self) -> np.ndarray:
        """Pose of the last frame (4, 4), the identity before there is one."""
        return self._poses[-1] if self._poses else np.eye(4)

    @property
    def last_timestamp(self) -> float:
        """Time of the last frame [s], 0 before there is one."""
        return self._timestamps[-1] if self._timestamps else 0.0

    @property
    def last_known(self) -> int | None:
        """The last frame whose pose is known and says something of where the camera is now, if there is one."""
        return next(self._known(), None)

    @property
    def lost_since_break(self) -> int:
        """Frames that were lost since the camera may be anywhere, if none was OK; 0 otherwise."""
        status = self._status[self._first :]
        return 0 if FrameStatus.OK in status else status.count(FrameStatus.LOST)

    @property
    def was_known(self) -> bool:
        """Whether the pose of the very last frame is known."""
        return self.last_known is not None and self.last_known == len(self) - 1

    def starts(self, constant_speed: bool, bridge: int = 0) -> list[np.ndarray]:
        """Where the camera may be now, most likely first: constant speed (if on and known), and the last known pose.

        bridge: Frames without a pose over which constant speed is still believed.
        """
        last = self.last_known
        if last is None:
            return []
        T, gap = self._poses[last], len(self) - 1 - last
        is_moving = last > self._first if bridge else self.follows(last)
        if constant_speed and gap <= bridge and is_moving:
            return [T @ np.linalg.matrix_power(self._motion, 1 + gap) if gap else T @ self._motion, T]
        return [T]

    def twist(self, steps: int = TWIST_STEPS) -> np.ndarray:
        """Mean twist (v, w) of the camera [m/s, rad/s] over the last ``steps`` frames, in its axes, (6,); 0 where it is
        not known.
        """
        last, first = len(self) - 1, self.earlier(steps)
        if first is None:
            return np.zeros(6)
        seconds = self._timestamps[last] - self._timestamps[first]
        if first == last or seconds <= 0.0:
            return np.zeros(6)
        return twist_of(inverse(self._poses[first]) @ self._poses[last]) / seconds

    def earlier(self, steps: int) -> int | None:
        """The frame ``steps`` before the last, or as many as the camera has moved without a break since; None if the
        pose of the last frame is not known.
        """
        last = self.last_known
        if last is None or last != len(self) - 1:
            return None
        first = last
        while first > last - steps and self.follows(first):
            first -= 1
        return first

    def is_jump(self, T_world_camera: np.ndarray, max_step: float, max_turn: float) -> bool:
        """Whether the camera can't well have come to a pose: a step beyond ``max_step`` [m] or ``max_turn`` [degrees] a
        frame, and far beyond the recent ones.
        """
        last = self.last_known
        if last is None:
            return False
        recent = [n for n in self._recent() if self.follows(n)]
        # Before any step is known the camera may be a fast one.
        usual = np.array([max_step, max_turn])
        if recent:
            before, after = (np.array([self._poses[n + shift] for n in recent]) for shift in (-1, 0))
            usual = np.median(motion_between(before, after), axis=0)
        elapsed = len(self) - last
        step = motion_between(self._poses[last], T_world_camera)
        return bool((step > elapsed * np.maximum(STEP_FACTOR * usual, [max_step, max_turn])).any())

    def depth_error(self) -> float:
        """Median depth error of the recent frames [m], 0 if there are none."""
        errors = [self._depth_errors[n] for n in self._recent() if self._depth_errors[n] > 0]
        return float(np.median(errors)) if errors else 0.0

    def _known(self) -> Iterator[int]:
        return (n for n in range(len(self) - 1, self._first - 1, -1) if self._status[n] is FrameStatus.OK)

    def _recent(self) -> list[int]:
        return list(islice(self._known(), RECENT_FRAMES))

    def follows(self, index: int) -> bool:
        """Whether the frame before one is known, too, without a break between."""
        return index > self._first and self._status[index - 1] is FrameStatus.OK

    # -- saved ---------------------------------------------------------------------------------------------------

    def state(self) -> HistoryState:
        """All of it as arrays."""
        order = list(FrameStatus)
        return HistoryState(
            timestamps=np.array(self._timestamps, np.float64),
            poses=np.array(self._poses, np.float64).reshape(-1, 4, 4),
            status=np.array([order.index(status) for status in self._status], np.uint8),
            depth_errors=np.array(self._depth_errors, np.float64),
            motion=self._motion,
            first=self._first,
        )

    @classmethod
    def restored(cls, state: HistoryState) -> FrameHistory:
        """What `state` was taken from."""
        order, history = list(FrameStatus), cls()
        history._timestamps = state.timestamps.tolist()
        history._poses = list(state.poses.copy())
        history._status = [order[code] for code in state.status]
        history._depth_errors = state.depth_errors.tolist()
        history._motion, history._first = state.motion.copy(), state.first
        return history
