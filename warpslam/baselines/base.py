"""What the baselines share: frames in, trajectory out, under the interface of `warpslam.slam.Slam`."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar, NoReturn, Self

import numpy as np
import trimesh

from warpslam.camera import Intrinsics
from warpslam.config import Config
from warpslam.errors import ConfigError
from warpslam.frames import AdmittedFrame, FrameResult, admit, skipped
from warpslam.storage.state_file import StateFields, StateFormat, read_state, write_state
from warpslam.trajectory import FrameHistory, HistoryState, Trajectory


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
        self.history = FrameHistory()

    @property
    def trajectory(self) -> Trajectory:
        """All poses so far."""
        return self.history.trajectory

    def step(
        self,
        rgb: Any,
        depth: Any,
        timestamp: float | None = None,
        T_world_camera: np.ndarray | None = None,
        *,
        depth_scale: float | None = None,
        depth_timestamp: float | None = None,
    ) -> FrameResult:
        """Take in one frame; arguments and errors are those of `Slam.step`. To a baseline all is seen at once."""
        frame = admit(
            len(self.history),
            rgb,
            depth,
            timestamp,
            T_world_camera,
            depth_scale=depth_scale,
            last_timestamp=self.history.last_timestamp,
            intrinsics=self.intrinsics,
            config=self.config,
            depth_timestamp=depth_timestamp,
        )
        return self._skip(frame) if frame.fault else self._step(frame)

    def _step(self, frame: AdmittedFrame) -> FrameResult:
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
        history = self.history.state()
        header |= {
            "seed": self.seed,
            "config": self.config.model_dump(),
            "intrinsics": vars(self.intrinsics),
            "first": history.first,
        }
        write_state(Path(path), self.form, header, {**arrays, **history.arrays()})

    @classmethod
    def load(cls, path: str | Path, device: str | None = None) -> Self:
        """Read what `save` wrote, for views and meshes.

        Raises:
            CheckpointError: The file is missing, damaged, or no map of this method and version.
        """
        state = StateFields(str(path), *read_state(Path(path), cls.form))
        camera = state.parsed("intrinsics", lambda fields: Intrinsics(**fields))
        method = cls(camera, state.parsed("config", Config.from_dict), device, state.integer("seed"))
        method.history = FrameHistory.restored(HistoryState.read(state))
        method._restore(state)
        return method

    def _state(self) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """Header and arrays of the map itself."""
        raise NotImplementedError

    def _restore(self, state: StateFields) -> None:
        """Take over a map that `_state` described."""
        raise NotImplementedError

    def _skip(self, frame: AdmittedFrame) -> FrameResult:
        self.history.skip(frame.timestamp)
        return skipped(frame, self.history.last_pose)
