"""What a loop has moved is mapped anew: the vertices that its views reached from where they were believed to be begin
again as new ones do, and are optimised from kept keyframes, those that moved most first.

All other vertices are held, to the byte, and so is the colour decoder; what moved and unmoved keyframes both see is
mapped from both. Of frames between keyframes no image is kept: what they alone saw is open until it is seen again.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import warp as wp

from warpslam.camera import Intrinsics
from warpslam.field.arrays import struct
from warpslam.kernels.grid import Lattice
from warpslam.mapping.frustum import mark_rows, measured_extent
from warpslam.mapping.mapper import MappingResult
from warpslam.poses import motion_between
from warpslam.scene.feature_grid import FeatureGrid
from warpslam.scene.image_pool import ImagePool
from warpslam.scene.keyframes import Keyframe, PlacedImage
from warpslam.scene.mapped_views import SEEN_STRIDE, SeenDepth
from warpslam.scene.scene_map import SceneMap

LEVELS = ("middle", "fine", "color")
"""Levels that are mapped anew; the coarse one only serves forecasts."""
MOVED = 0.5
"""Views that move what they see further than this, in fine voxels, are mapped anew."""
LEAST_SHARE = 0.02
"""Of what a keyframe measures that begins again, for it to be mapped although it did not move."""
FIRST_ROUND = 1 << 20
"""Number of the first remapping, as part of seeds: no refinement has as many rounds."""
_STRIDE = 16


@dataclass(frozen=True)
class MovedView:
    """What a mapped frame saw, and its T_world_camera (4, 4) when the map was made of it, and now."""

    index: int
    """Number of the frame."""
    depth: np.ndarray
    """Every 4th row and column [m], float32."""
    before: np.ndarray
    after: np.ndarray


class MadePoses:
    """Poses that the map was made with, by frame; of keyframes also where no image of theirs was mapped on its own."""

    def __init__(self) -> None:
        self._poses: dict[int, np.ndarray] = {}

    def note(self, index: int, pose: np.ndarray) -> None:
        """A frame is mapped from a pose (4, 4)."""
        self._poses[index] = pose.copy()

    def note_new(self, keyframes: Iterable[Keyframe]) -> None:
        """Keyframes that nothing is known of are where the map has them."""
        for keyframe in keyframes:
            if keyframe.index not in self._poses:
                self.note(keyframe.index, keyframe.pose)

    def before(self, index: int, now: np.ndarray) -> np.ndarray:
        """Pose of a frame in the map, ``now`` if it has none there."""
        return self._poses.get(index, now)

    def shift(self, index: int, now: np.ndarray, depth: float) -> float:
        """How far points move at a depth [m] that a frame sees [m]."""
        step, turn = motion_between(self.before(index, now), now)
        return float(step + np.radians(turn) * depth)

    def arrays(self) -> dict[str, np.ndarray]:
        """As plain arrays: "frames" int64 (n,), "poses" float64 (n, 4, 4)."""
        return {
            "frames": np.array(list(self._poses), np.int64),
            "poses": np.array(list(self._poses.values()), np.float64).reshape(-1, 4, 4),
        }

    def restore(self, frames: np.ndarray, poses: np.ndarray) -> None:
        """Put back what `arrays` gave."""
        self._poses = {index: pose.copy() for index, pose in zip(frames.tolist(), poses, strict=True)}


def moved_views(
    made: MadePoses, views: Sequence[SeenDepth], poses: Sequence[np.ndarray], least: float
) -> list[MovedView]:
    """Mapped frames that have moved what they see by more than ``least`` [m] since; ``poses`` (4, 4): theirs now."""
    found = []
    for view, pose in zip(views, poses, strict=True):
        depth = view.depth()
        known = depth[depth > 0]
        if len(known) and made.shift(view.index, pose, float(known.mean())) > least:
            found.append(MovedView(view.index, depth, made.before(view.index, pose), pose))
    return found


class RestrictedMapper(Protocol):
    """A mapper that can be told which rows may change."""

    scene: SceneMap

    def restrict(self, free: dict[str, np.ndarray] | None, renewed: dict[str, np.ndarray]) -> None:
        """From now on only rows that are true change, bool (rows,) by level, and no decoder; ``renewed``: rows, int
        (n,), whose features were begun again. None ends it.
        """

    def make_room(self, images: ImagePool, pose: np.ndarray, window: list[PlacedImage]) -> None:
        """Have rows wherever a call on the image in slot 0 and a window may need them."""

    def map_again(
        self, images: ImagePool, keyframe: Keyframe, keyframes: list[Keyframe], iterations: int, round_: int
    ) -> MappingResult:
        """Map a keyframe, whose image is in slot 0, together with others that see the same."""


@dataclass(frozen=True)
class Remapping:
    """What is to be mapped anew."""

    camera: Intrinsics
    """Of all frames."""
    moved: Sequence[MovedView]
    """Mapped frames that moved."""
    shifts: np.ndarray
    """How far each keyframe moved [m], float64 (keyframes,)."""
    least: float
    """Keyframes that moved less are only mapped if they see what begins again [m]."""
    iterations: int
    """As many as a mapped frame gets; keyframes get those of the frames that are mapped no more, too."""
    number: int
    """Of the remapping, the first is 0."""

    def run(self, mapper: RestrictedMapper, images: ImagePool, keyframes: list[Keyframe]) -> MappingResult:
        """Do it; slot 0 of the pool holds afterwards what it held before."""
        start, scene, small = time.perf_counter(), mapper.scene, self.camera.strided(SEEN_STRIDE)
        for view in self.moved:
            scene.cover(*measured_extent(view.depth, view.after, small, stride=1))
        old = _touched(scene, small, [(view.depth, view.before) for view in self.moved])
        new = _touched(scene, small, [(view.depth, view.after) for view in self.moved])
        current, motion = images.current(), images.motion
        result = MappingResult(np.eye(4), again=True)
        try:
            if scene.layout == "blocks":
                for keyframe in keyframes:
                    images.show(keyframe.image, keyframe.motion)
                    mapper.make_room(images, keyframe.pose, [])
            begun = {level: np.flatnonzero(scene.grids[level].rows_of(old[level])) for level in LEVELS}
            free = {level: scene.grids[level].rows_of(old[level] | new[level]) for level in LEVELS}
            seen_before = scene.grids["color"].seen.numpy()[: len(free["color"])].copy()
            for level in LEVELS:
                scene.grids[level].renew(begun[level])
            mapper.restrict(free, begun)
            order = self._order(images, keyframes, scene.grids["fine"], old["fine"])
            count = -(-self.iterations * max(len(self.moved), len(order)) // max(len(order), 1))
            for k in order:
                keyframe = keyframes[k]
                images.show(keyframe.image, keyframe.motion)
                others = [one for one in keyframes if one is not keyframe]
                one = mapper.map_again(images, keyframe, others, count, FIRST_ROUND + self.number)
                result.losses.update(one.losses)
                result.window.append(keyframe.index)
        finally:
            images.put_back(current, motion)
            mapper.restrict(None, {})
        seen_now = scene.grids["color"].seen[: len(seen_before)]
        seen_now.assign(np.where(free["color"], seen_now.numpy(), seen_before))
        result.seconds = time.perf_counter() - start
        return result

    def _order(self, images: ImagePool, keyframes: list[Keyframe], grid: FeatureGrid, begun: np.ndarray) -> list[int]:
        """Keyframes to map: those that moved most first, then those that see what begins again."""
        order = np.argsort(-self.shifts, kind="stable").tolist()
        return [
            k
            for k in order
            if self.shifts[k] > self.least or self._share(images, keyframes[k], grid, begun) > LEAST_SHARE
        ]

    def _share(self, images: ImagePool, keyframe: Keyframe, grid: FeatureGrid, begun: np.ndarray) -> float:
        """Share of what a keyframe measures that lies at vertices which begin again."""
        _, units, scale = images.kept(keyframe.image).unpack(self.camera)
        depth = units[::_STRIDE, ::_STRIDE].astype(np.float64) * scale
        v, u = np.nonzero(depth)
        points = self.camera.backproject(u * _STRIDE, v * _STRIDE, depth[v, u])
        points = points @ keyframe.pose[:3, :3].T + keyframe.pose[:3, 3]
        place = np.rint(points / grid.spacing).astype(np.int64) - grid.first
        inside = ((place >= 0) & (place < grid.shape)).all(axis=1)
        return float(begun.reshape(grid.shape)[tuple(place[inside].T)].sum() / max(len(points), 1))


def _touched(
    scene: SceneMap, camera: Intrinsics, views: Sequence[tuple[np.ndarray, np.ndarray]]
) -> dict[str, np.ndarray]:
    """Vertices of each level that mapping from some views may have changed, bool (vertices,) of the box: depth [m],
    (H, W), and T_world_camera of each.
    """
    return {level: touched_vertices(scene.grids[level], camera, views) for level in LEVELS}


def touched_vertices(
    grid: FeatureGrid, camera: Intrinsics, views: Sequence[tuple[np.ndarray, np.ndarray]]
) -> np.ndarray:
    """The same of one level: all corners of cells that have one in view, no further behind a surface than
    `warpslam.mapping.frustum.REACH`.
    """
    lattice = struct(Lattice, **{part: getattr(grid.lattice, part) for part in ("origin", "inverse_spacing", "shape")})
    count = int(np.prod(grid.shape))
    mask = wp.zeros(count, dtype=wp.uint8, device=grid.device)
    for depth, T_world_camera in views:
        image = wp.array(depth, dtype=float, device=grid.device)
        mark_rows(grid, lattice, count, camera, T_world_camera, image, mask)
    touched = mask.numpy().reshape(grid.shape) != 0
    for axis in range(3):
        near, far = np.roll(touched, 1, axis), np.roll(touched, -1, axis)
        edge: list[slice | int] = [slice(None)] * 3
        edge[axis] = 0
        near[tuple(edge)] = False
        edge[axis] = -1
        far[tuple(edge)] = False
        touched = touched | near | far
    return touched.reshape(-1)
