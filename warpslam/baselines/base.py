"""What the baselines share: frames in, trajectory out, under the interface of `warpslam.slam.Slam`."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar, NoReturn, Self

import numpy as np
import trimesh

from warpslam.camera import Intrinsics
from warpslam.config import Config
from warpslam.errors import ConfigError, FrameError
from warpslam.frames import FrameResult, read_images
from warpslam.poses import check_transform, pose_from_vector, vector_from_pose
from warpslam.storage.state_file import StateFields, StateFormat, read_state, write_state
from warpslam.trajectory import Trajectory

STATUSES = ("OK", "LOST", "SKIPPED")


class Baseline:
    """Keeps the record of all frames, and says what a baseline can't do."""

    name: ClassVar[str]
    """What ``--method`` calls it."""
    form: ClassVar[StateFormat]
    """Of its saved maps."""
    has_checkpoints: ClassVar[bool] = False
    device: Any
    """Device that it computes on, as text or Warp device."""
    compile_seconds: float = 0.0
    """Seconds spent on compiling kernels."""

    def __init__(
        self, intrinsics: Intrinsics, config: Config | None = None, device: str | None = None, seed: int = 0
    ) -> None:
        config = config if config is not None else Config()
        self.intrinsics, self.config, self.seed = intrinsics, config, seed
        self._vectors: list[np.ndarray] = []
        self._timestamps: list[float] = []
        self._status: list[str] = []

    @property
    def trajectory(self) -> Trajectory:
        """All poses so far."""
        poses = np.array([pose_from_vector(vector) for vector in self._vectors]).reshape(-1, 4, 4)
        return Trajectory(np.array(self._timestamps), poses, list(self._status))

    def step(
        self,
        rgb: Any,
        depth: Any,
        timestamp: float | None = None,
        T_world_camera: np.ndarray | None = None,
        *,
        depth_scale: float | None = None,
    ) -> FrameResult:
        """Take in one frame; arguments and errors are those of `Slam.step`."""
        index = len(self._vectors)
        timestamp = index / 30.0 if timestamp is None else float(timestamp)
        given = None if T_world_camera is None else check_transform(T_world_camera, unknown_is_nan=True)
        try:
            rgb, depth = read_images(rgb, depth, self.intrinsics, self.config.grid.max_depth, depth_scale)
            if given is not None and not np.isfinite(given).all():
                raise FrameError("its T_world_camera holds NaN or infinity")
        except FrameError as error:
            return self._skip(index, timestamp, str(error))
        return self._step(index, timestamp, rgb, depth, given)

    def _step(
        self, index: int, timestamp: float, rgb: np.ndarray, depth: np.ndarray, given: np.ndarray | None
    ) -> FrameResult:
        raise NotImplementedError

    def refine(self, rounds: int | None = None) -> NoReturn:
        """A baseline has nothing to refine once it is finished.

        Raises:
            ConfigError: Always.
        """
        raise ConfigError(f"method {self.name} has no refinement of a finished map: leave out --refine (rounds)")

    def mesh(self, voxel: float | None = None, *, forecast: bool = False) -> trimesh.Trimesh:
        """Coloured mesh of what was seen, in the world frame.

        Args:
            voxel: Edge of a cell [m]; by default that of the settings.
            forecast: Must be off: without a coarse level nothing is forecast.

        Raises:
            ConfigError: A forecast is asked for.
            InputError: The method has no mesh with this voxel.
            MeshError: Nothing was seen, or there is no surface.
        """
        if forecast:
            raise ConfigError(f"method {self.name} forecasts nothing where it saw nothing: leave out --forecast")
        return self._mesh(voxel)

    def _mesh(self, voxel: float | None) -> trimesh.Trimesh:
        raise NotImplementedError

    def inventory(self) -> dict[str, Any]:
        """Empty: there is nothing to tell beside the figures of every run."""
        return {}

    def save(self, path: str | Path) -> None:
        """Write map, trajectory and settings to one state file (plain arrays, no code).

        Raises:
            CheckpointError: The file can't be written.
        """
        header, arrays = self._state()
        header |= {
            "seed": self.seed,
            "config": self.config.model_dump(),
            "intrinsics": vars(self.intrinsics),
            "status": self._status,
        }
        arrays["timestamps"] = np.array(self._timestamps, np.float64)
        arrays["vectors"] = np.array(self._vectors, np.float64).reshape(-1, 7)
        write_state(Path(path), self.form, header, arrays)

    @classmethod
    def load(cls, path: str | Path, device: str | None = None) -> Self:
        """Read what `save` wrote, for views and meshes.

        Raises:
            CheckpointError: The file is missing, damaged, or no map of this method and version.
        """
        state = StateFields(str(path), *read_state(Path(path), cls.form))
        camera = state.parsed("intrinsics", lambda fields: Intrinsics(**fields))
        method = cls(camera, state.parsed("config", Config.from_dict), device, state.integer("seed"))
        method._vectors = list(state.array("vectors", np.float64, (None, 7)).copy())
        count = len(method._vectors)
        method._timestamps = state.array("timestamps", np.float64, (count,)).tolist()
        method._status = state.texts("status", count, STATUSES)
        method._restore(state)
        return method

    def _state(self) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """Header and arrays of the map itself."""
        raise NotImplementedError

    def _restore(self, state: StateFields) -> None:
        """Take over a map that `_state` described."""
        raise NotImplementedError

    def _append(self, vector: np.ndarray, timestamp: float, status: str) -> None:
        self._vectors.append(vector)
        self._timestamps.append(timestamp)
        self._status.append(status)

    def _skip(self, index: int, timestamp: float, message: str) -> FrameResult:
        vector = self._vectors[-1].copy() if self._vectors else vector_from_pose(np.eye(4))
        self._append(vector, timestamp, "SKIPPED")
        return FrameResult(index, timestamp, pose_from_vector(vector), "SKIPPED", inliers=0.0, message=message)
