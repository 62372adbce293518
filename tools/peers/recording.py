"""What a peer gets and what it leaves: frames of a folder, poses, lost frames, times, and a mesh by TSDF fusion."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from warpslam.cli.common import parse_frames
from warpslam.sequences import Frame, open_sequence
from warpslam.storage.tum import write_tum

DEPTH_RANGE = {"tum_rgbd": 4.0, "seven_scenes": 4.0, "scannet": 4.0, "icl": 6.0}
"""Depth [m] up to which peers use it, by a sequence's preset: what its sensor can measure well."""
FARTHEST = 8.0  # [m], of all others
STORED_SCALE = 5000.0
"""Units a metre of depth images for programs that want integers."""


class Recording:
    """Frames as a peer sees them: undistorted and cropped by our reader, as warpslam itself gets them.

    indices: Numbers of the frames in the folder.
    times: [s], shape (N,).
    truth: True poses, shape (N, 4, 4), NaN where unknown, or None.
    depth_range: Depth beyond is not used [m].
    """

    def __init__(self, folder: str | Path, frames: str | None = None, depth_range: float | None = None) -> None:
        self.sequence = open_sequence(folder)
        part = slice(None) if frames is None else parse_frames(frames)
        self.indices = list(range(len(self.sequence)))[part]
        self.intrinsics = self.sequence.intrinsics
        self.depth_range = depth_range or DEPTH_RANGE.get(self.sequence.preset, FARTHEST)
        truth = self.sequence.ground_truth()
        self.truth = None if truth is None else truth[self.indices]
        known = getattr(self.sequence, "timestamps", np.arange(len(self.sequence)) / 30.0)
        self.times = np.asarray(known, dtype=np.float64)[self.indices]

    def __len__(self) -> int:
        return len(self.indices)

    def __getitem__(self, number: int) -> Frame:
        return self.sequence[self.indices[number]]

    def points(self, number: int, stride: int = 1) -> np.ndarray:
        """Points of the depth image in camera axes, float64, shape (N, 3) [m], of every ``stride``-th pixel."""
        z = self[number].depth[::stride, ::stride].astype(np.float64)
        k = self.intrinsics
        v, u = np.mgrid[0 : k.height : stride, 0 : k.width : stride]
        points = k.backproject(u, v, z).reshape(-1, 3)
        return np.ascontiguousarray(points[(points[:, 2] > 0.1) & (points[:, 2] < self.depth_range)])


def stored_depth(depth: np.ndarray) -> np.ndarray:
    """Depth [m] as uint16 in units of 0.2 mm, 0 beyond 13.1 m."""
    units = np.round(depth.astype(np.float64) * STORED_SCALE)
    return np.where(units <= np.iinfo(np.uint16).max, units, 0).astype(np.uint16)


class Account:
    """Poses and times of a run, for ``run.json`` and ``trajectory.tum``.

    Peers start at the identity; what is written is moved so that the first frame has its true pose, if that is known.
    """

    def __init__(self, recording: Recording, out: Path) -> None:
        self.recording, self.out = recording, out
        self.poses: list[np.ndarray] = []
        """T_first_camera of each frame so far, (4, 4); NaN where there is none."""
        self.lost: list[int] = []
        """Frames that the peer calls lost."""
        self.remarks: list[str] = []
        """What should be known beside the figures."""
        self.cpu_seconds: dict[str, float] = {}
        """Process time by stage: "tracking", "mesh", and "setup", which is not counted against a program."""

    def add(self, pose: np.ndarray, ok: bool = True) -> None:
        """The pose of the next frame."""
        if not ok:
            self.lost.append(len(self.poses))
        self.poses.append(np.array(pose, dtype=np.float64))

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Add the process time of a block to a stage."""
        start = time.process_time()
        try:
            yield
        finally:
            self.cpu_seconds[stage] = self.cpu_seconds.get(stage, 0.0) + time.process_time() - start

    def world_poses(self) -> np.ndarray:
        """Poses in the frame of the truth, shape (N, 4, 4)."""
        poses = np.array(self.poses)
        truth = self.recording.truth
        first = np.eye(4) if truth is None or not np.isfinite(truth[0]).all() else truth[0]
        known = np.flatnonzero(np.isfinite(poses).all(axis=(1, 2)))
        return poses if not len(known) else first @ np.linalg.inv(poses[known[0]]) @ poses

    def write(self) -> None:
        """Put ``trajectory.tum`` and ``run.json`` into the folder."""
        write_tum(self.out / "trajectory.tum", self.recording.times, self.world_poses())
        record: dict[str, Any] = {"lost": self.lost, "remarks": self.remarks, "cpu_seconds": self.cpu_seconds}
        (self.out / "run.json").write_text(json.dumps(record, indent=1) + "\n")


def fuse(recording: Recording, poses: np.ndarray, path: Path, *, voxel: float = 0.01, truncation: float = 8.0) -> None:
    """Mesh of all depth images at given camera-to-world poses, by Open3D's voxel block grid.

    Args:
        recording: Where the images come from.
        poses: Shape (N, 4, 4); frames whose pose is not finite are left out.
        path: File to write.
        voxel: Size of a voxel [m].
        truncation: Truncation distance in voxels.
    """
    import open3d as o3d

    core, image = o3d.core, o3d.t.geometry.Image
    grid = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight", "color"), (core.float32, core.uint16, core.uint16), ((1,), (1,), (3,)), voxel, 16, 10000,
        core.Device("CPU:0"),
    )  # fmt: skip
    K = core.Tensor(recording.intrinsics.matrix)
    for number, pose in enumerate(poses):
        if not np.isfinite(pose).all():
            continue
        frame = recording[number]
        depth = image(core.Tensor(frame.depth))
        color = image(core.Tensor(frame.rgb.astype(np.float32) / 255.0))
        extrinsic = core.Tensor(np.linalg.inv(pose))
        blocks = grid.compute_unique_block_coordinates(depth, K, extrinsic, 1.0, recording.depth_range, truncation)
        grid.integrate(blocks, depth, color, K, K, extrinsic, 1.0, recording.depth_range, truncation)
    write_mesh(grid.extract_triangle_mesh(3.0), path)


def write_mesh(mesh: Any, path: Path) -> None:
    """An Open3D tensor mesh as PLY."""
    import open3d as o3d

    o3d.io.write_triangle_mesh(str(path), mesh.cpu().to_legacy())


Runner = Callable[[Recording, Account, bool], None]
"""Runs a peer on a recording into an account; the flag says whether a mesh is wanted, as ``mesh.ply`` in its folder."""
