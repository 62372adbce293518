"""A sequence and a SLAM object that answer at once, for tests of everything around the core."""

from __future__ import annotations

import io
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import trimesh

from warpslam.camera import Intrinsics
from warpslam.config import Config
from warpslam.errors import DatasetError, MeshError
from warpslam.frames import FrameResult, FrameStatus
from warpslam.pipeline import run as pipeline
from warpslam.poses import pose_from_vector
from warpslam.runs.record import RunResult
from warpslam.runs.request import RunRequest
from warpslam.sequences.base import Frame, RgbdSequence

CAMERA = Intrinsics(20, 20, 15.5, 11.5, 32, 24)
COVARIANCE = (4e-6, 9e-6, 1e-6, 1e-4, 1e-5, 1e-6)
"""Variances of a pose, [m^2] and [rad^2]."""


class Terminal(io.StringIO):
    """Standard output that says it is a terminal."""

    def isatty(self) -> bool:
        return True


def true_pose(index: int) -> np.ndarray:
    """A camera walking on an arc."""
    a = 0.02 * index
    return pose_from_vector(np.array([np.cos(a), 0, np.sin(a), 0, 0.1 * index, 0.01 * index**2, 0.2]))


class FakeSequence(RgbdSequence):
    """A wall 2 m in front of the camera; chosen frames can't be read or have no truth."""

    name = "fake sequence"
    intrinsics = CAMERA
    preset = "default"

    def __init__(self, count: int = 8, *, unreadable: tuple[int, ...] = (), no_truth: tuple[int, ...] = ()) -> None:
        self.count, self.unreadable, self.no_truth = count, unreadable, no_truth

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> Frame:
        if index in self.unreadable:
            raise DatasetError(f"frame{index:06d}.jpg is truncated")
        rgb = np.full((CAMERA.height, CAMERA.width, 3), 40 + index, dtype=np.uint8)
        depth = np.full((CAMERA.height, CAMERA.width), 2.0, dtype=np.float32)
        depth[:2] = 0
        return Frame(index, index / 30, rgb, depth, None if index in self.no_truth else true_pose(index))


@dataclass
class FakeTrajectory:
    timestamps: np.ndarray
    poses: np.ndarray
    status: list[str]


@dataclass
class FakeImage:
    depth: np.ndarray
    rgb: np.ndarray
    variance: np.ndarray


class FakeSlam:
    """Returns the given pose 1 cm off in x in every other frame; what it should do wrong is set on the class."""

    interrupt_at: int | None = None
    fail_at: int | None = None
    lost_at: int | None = None
    timed_at: int | None = None
    mesh_fails = False
    compile_seconds = 0.25
    device = "cpu"
    map_bytes = 2_500_000
    flops_per_point = 102_598

    def __init__(self, intrinsics: Intrinsics, **settings: object) -> None:
        self.settings = settings
        self.results: list[FrameResult] = []
        self.given: list[np.ndarray | None] = []
        self.finished = False
        self.loops: SimpleNamespace | None = None

    def step(self, rgb, depth, timestamp=None, T_world_camera=None, *, depth_timestamp=None) -> FrameResult:
        index = len(self.results)
        if index == self.interrupt_at:
            raise KeyboardInterrupt
        if index == self.fail_at:
            raise RuntimeError("out of memory")
        assert rgb.dtype == np.uint8 and depth.dtype == np.float32
        self.given.append(T_world_camera)
        T = np.array(true_pose(round(timestamp * 30)))
        T[0, 3] += 0.01 * (index % 2)
        status = FrameStatus.LOST if index == self.lost_at else FrameStatus.OK
        timings = {"tracking": 0.25, "mapping": 0.5}
        result = FrameResult(index, timestamp, T, status, {"loss": 1.5}, 0.9, 0.02, 0.95, np.diag(COVARIANCE), timings)
        if index == self.timed_at:
            found = {"depth_delay": -0.0203, "depth_delay_sigma": 0.002, "readout": 0.0261, "readout_sigma": 0.003}
            result = replace(result, sensor_timing=found)
        self.results.append(result)
        return self.results[-1]

    def finish(self) -> dict[str, float]:
        self.finished = True
        return {"refinement": 0.5}

    @property
    def trajectory(self) -> FakeTrajectory:
        return FakeTrajectory(
            np.array([r.timestamp for r in self.results]),
            np.array([r.T_world_camera for r in self.results]).reshape(-1, 4, 4),
            [r.status for r in self.results],
        )

    def render(self, T_world_camera: np.ndarray, stride: int = 1) -> FakeImage:
        shape = (-(-CAMERA.height // stride), -(-CAMERA.width // stride))
        return FakeImage(np.full(shape, 2.03, np.float32), np.full((*shape, 3), 0.2, np.float32), np.zeros(shape))

    def refine(self, rounds: int) -> None:
        self.refined = rounds

    def mesh(self, voxel: float = 0.02, *, forecast: bool = False) -> trimesh.Trimesh:
        if self.mesh_fails:
            raise MeshError("the map has no surface")
        mesh = wall()
        mesh.metadata["forecast_faces"] = 1 if forecast else 0
        mesh.visual.vertex_colors = np.tile(np.uint8([10, 20, 30, 255]), (len(mesh.vertices), 1))
        return mesh

    def inventory(self) -> dict[str, object]:
        loops = {} if self.loops is None else {"loops": {"edges": self.loops.edges}}
        return {"memory": {"state_bytes": 8}, **loops}

    def save(self, path: Path) -> None:
        Path(path).write_bytes(b"fake map")

    @classmethod
    def load(cls, path: Path, device: str | None = None) -> FakeSlam:
        assert Path(path).read_bytes() == b"fake map"
        return cls(CAMERA)


def wall() -> trimesh.Trimesh:
    """The wall that the first camera sees."""
    corners = np.array([[-3, -3, 2.2], [3, -3, 2.2], [3, 3, 2.2], [-3, 3, 2.2]])
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)


def run_sequence(
    sequence: RgbdSequence, config: Config, output: Path, *, frames: tuple | None = None, **asked: Any
) -> RunResult:
    """A run over a sequence that is at hand: arguments of `warpslam.pipeline.run.run`, and fields of its request."""
    keywords = {name: asked.pop(name) for name in ("truth_mesh", "observer", "check_input") if name in asked}
    request = RunRequest(config=config, frames=frames or (None, None, None), **asked)
    return pipeline.run(request, output, sequence=sequence, **keywords)
