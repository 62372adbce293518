"""Poses of a camera out of ROS: transforms from frame to frame, odometry and poses by time."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from warpslam.poses import inverse, pose_from_vector, vector_from_pose
from warpslam.sequences.bag_messages import transform_of
from warpslam.storage.tum import nearest

MAX_GAP = 0.1
"""A pose counts for an image within this time [s]."""


@dataclass
class Transforms:
    """The tree of frames: every frame in its parent, for all time or by time."""

    parents: dict[str, str] = field(default_factory=dict)
    fixed: dict[str, np.ndarray] = field(default_factory=dict)
    """T_parent_child (4, 4) by child."""
    moving: dict[str, list[tuple[float, np.ndarray]]] = field(default_factory=lambda: defaultdict(list))
    """Time [s] and T_parent_child by child."""

    def add(self, message: Any, is_static: bool) -> None:
        """The transforms of a TFMessage."""
        for item in message.transforms:
            child, parent = item.child_frame_id.strip("/"), item.header.frame_id.strip("/")
            self.parents[child] = parent
            if is_static:
                self.fixed[child] = transform_of(item.transform)
            else:
                stamp = item.header.stamp
                time = stamp.sec + 1e-9 * stamp.nanosec
                self.moving[child].append((time, transform_of(item.transform)))

    def between(self, target: str, source: str) -> np.ndarray | None:
        """T_target_source (4, 4) of two frames that are fixed to each other; None where nothing is known of it."""
        up_source, up_target = self._ancestors(source), self._ancestors(target)
        common = next((name for name in up_source if name in up_target), None)
        if common is None:
            return None
        a, b = self._fixed_chain(source, common), self._fixed_chain(target, common)
        return None if a is None or b is None else inverse(b) @ a

    def path_of(self, frame: str, times: np.ndarray) -> tuple[np.ndarray | None, str]:
        """T_root_frame (N, 4, 4) at the times [s], NaN where a moving part is not known then, and the root's name; None
        where nothing moves.
        """
        chain = self._ancestors(frame)
        if not any(name in self.moving and name not in self.fixed for name in chain):
            return None, ""
        poses = np.tile(np.eye(4), (len(times), 1, 1))
        for name in chain[:-1]:
            step = self.fixed[name][None] if name in self.fixed else at_times(self.moving[name], times)
            poses = step @ poses
        return poses, chain[-1]

    def _ancestors(self, frame: str) -> list[str]:
        names = [frame.strip("/")]
        while names[-1] in self.parents and self.parents[names[-1]] not in names:
            names.append(self.parents[names[-1]])
        return names

    def _fixed_chain(self, frame: str, ancestor: str) -> np.ndarray | None:
        T, name = np.eye(4), frame.strip("/")
        while name != ancestor:
            if name not in self.fixed:
                return None
            T, name = self.fixed[name] @ T, self.parents[name]
        return T


def at_times(track: list[tuple[float, np.ndarray]], times: np.ndarray) -> np.ndarray:
    """Poses (N, 4, 4) at the times [s], between the two that are nearest; NaN where none is within `MAX_GAP`."""
    track = sorted(track, key=lambda item: item[0])
    stamps = np.array([time for time, _ in track])
    _, gap = nearest(times, stamps)
    after = np.clip(np.searchsorted(stamps, times), 1, max(len(stamps) - 1, 1))
    poses = np.full((len(times), 4, 4), np.nan)
    for i, (time, right) in enumerate(zip(times, after, strict=True)):
        if gap[i] >= MAX_GAP:
            continue
        if len(stamps) == 1 or not stamps[right - 1] <= time <= stamps[right]:
            poses[i] = track[int(nearest(times[i : i + 1], stamps)[0][0])][1]
            continue
        share = (time - stamps[right - 1]) / max(stamps[right] - stamps[right - 1], 1e-9)
        poses[i] = _between(track[right - 1][1], track[right][1], share)
    return poses


def _between(a: np.ndarray, b: np.ndarray, share: float) -> np.ndarray:
    """A pose between two that are near each other, share 0 to 1."""
    p, q = vector_from_pose(a), vector_from_pose(b)
    q[:4] *= np.sign(p[:4] @ q[:4]) or 1.0
    return pose_from_vector((1 - share) * p + share * q)
