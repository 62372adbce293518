"""What a run asks of a method, and the methods by name."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import numpy as np

from warpslam.errors import ConfigError
from warpslam.runs.request import DEFAULT_METHOD as DEFAULT_METHOD

if TYPE_CHECKING:
    import trimesh

    from warpslam.camera import Intrinsics, SensorTiming
    from warpslam.config import Config
    from warpslam.field.rendering import RenderedImage
    from warpslam.frames import FrameResult
    from warpslam.trajectory import Trajectory

METHODS = (DEFAULT_METHOD, "imap", "tsdf")
"""What ``warpslam run --method`` takes."""


class Method(Protocol):
    """A camera that moves through a scene, and the map it makes: `warpslam.slam.Slam` or a baseline.

    What a method can't do it refuses with a `ConfigError` that says so; see `warpslam.baselines.base.Baseline`.
    """

    has_checkpoints: ClassVar[bool]
    """Whether a run can be resumed from a checkpoint, and start from a map; one that can't starts again."""
    device: Any
    """Device that it computes on."""
    compile_seconds: float
    """Seconds spent on compiling kernels."""

    def step(
        self,
        rgb: Any,
        depth: Any,
        timestamp: float | None = None,
        T_world_camera: np.ndarray | None = None,
        *,
        depth_timestamp: float | None = None,
    ) -> FrameResult:
        """Take in one frame, with its pose where that is known."""
        ...

    def finish(self) -> dict[str, float]:
        """After the last frame; returns the seconds by phase."""
        ...

    @property
    def trajectory(self) -> Trajectory:
        """All poses so far."""
        ...

    def render(self, T_world_camera: np.ndarray, *, depth: np.ndarray | None = None, stride: int = 1) -> RenderedImage:
        """View of the map from a pose."""
        ...

    def refine(self, rounds: int | None = None) -> None:
        """More rounds of global refinement after `finish`.

        Raises:
            ConfigError: The method has none.
        """
        ...

    def mesh(self, voxel: float | None = None, *, forecast: bool = False) -> trimesh.Trimesh:
        """Coloured mesh in the world frame, with what the map suggests where nothing was seen if that is asked for.

        Raises:
            ConfigError: The method forecasts nothing.
        """
        ...

    def inventory(self) -> dict[str, Any]:
        """What the map holds, as further entries of metrics.json; empty where there is nothing to tell."""
        ...

    def save(self, path: str | Path) -> None:
        """Write the map, for views and meshes later."""
        ...

    @property
    def map_bytes(self) -> int:
        """Memory of the map itself, without optimiser state and images."""
        ...

    @property
    def flops_per_point(self) -> int | None:
        """Operations of one forward evaluation at a point; None for a map that is looked up."""
        ...


def build_method(
    name: str, intrinsics: Intrinsics, config: Config, device: str | None, seed: int, timing: SensorTiming
) -> Method:
    """A new method.

    Raises:
        ConfigError: There is no method of this name.
        CheckpointError: The decoders can't be loaded.
        MissingDependencyError: The method needs an optional package that can't be loaded.
    """
    # Baselines take all pixels of a frame as seen at once.
    more = {"timing": timing} if name == DEFAULT_METHOD else {}
    return _class_of(name)(intrinsics, config=config, device=device, seed=seed, **more)


def load_method(name: str, path: Path, device: str | None) -> Method:
    """The method as ``save`` left it in a file.

    Raises:
        ConfigError: There is no method of this name.
        CheckpointError: The file can't be read.
        MissingDependencyError: The method needs an optional package that can't be loaded.
    """
    return _class_of(name).load(path, device=device)


def check_method(name: str) -> None:
    """Whether there is a method of this name.

    Raises:
        ConfigError: There is none.
    """
    if name not in METHODS:
        raise ConfigError(f"method {name!r} is unknown; choose one of {', '.join(METHODS)}")


def has_checkpoints(name: str) -> bool:
    """Whether a run of this method can be resumed from a checkpoint, and start from a map.

    Raises:
        ConfigError: There is no method of this name.
    """
    return _class_of(name).has_checkpoints


def _class_of(name: str) -> Any:
    check_method(name)
    if name == DEFAULT_METHOD:
        from warpslam.slam import Slam

        return Slam
    if name == "imap":
        from warpslam.baselines.imap import Imap

        return Imap
    from warpslam.baselines.tsdf import Tsdf

    return Tsdf
