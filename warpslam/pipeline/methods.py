"""What a run asks of a method, and the methods by name."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from warpslam.errors import ConfigError
from warpslam.runs.request import DEFAULT_METHOD as DEFAULT_METHOD

if TYPE_CHECKING:
    import trimesh

    from warpslam.camera import Intrinsics
    from warpslam.config import Config
    from warpslam.field.rendering import RenderedImage
    from warpslam.frames import FrameResult
    from warpslam.trajectory import Trajectory

METHODS = (DEFAULT_METHOD, "imap", "tsdf")
"""What ``warpslam run --method`` takes."""


class Method(Protocol):
    """A camera that moves through a scene, and the map it makes: `warpslam.slam.Slam` or a baseline.

    device: Device that it computes on.
    compile_seconds: Seconds spent on compiling kernels.
    """

    device: Any
    compile_seconds: float

    def step(
        self, rgb: Any, depth: Any, timestamp: float | None = None, T_world_camera: np.ndarray | None = None
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

    def mesh(self, voxel: float | None = None) -> trimesh.Trimesh:
        """Coloured mesh in the world frame."""
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


def build_method(name: str, intrinsics: Intrinsics, config: Config, device: str | None, seed: int) -> Method:
    """A new method.

    Raises:
        ConfigError: there is no method of this name.
        CheckpointError: the decoders can't be loaded.
        MissingDependencyError: the method needs an optional package that can't be loaded.
    """
    return _class_of(name)(intrinsics, config=config, device=device, seed=seed)


def load_method(name: str, path: Path, device: str | None) -> Method:
    """The method as ``save`` left it in a file.

    Raises:
        ConfigError: there is no method of this name.
        CheckpointError: the file can't be read.
        MissingDependencyError: the method needs an optional package that can't be loaded.
    """
    return _class_of(name).load(path, device=device)


def check_method(name: str) -> None:
    """Whether there is a method of this name.

    Raises:
        ConfigError: there is none.
    """
    if name not in METHODS:
        raise ConfigError(f"method {name!r} is unknown; choose one of {', '.join(METHODS)}")


def has_checkpoints(name: str) -> bool:
    """Whether a run of this method can be resumed from a checkpoint; one that can't starts again."""
    return name == DEFAULT_METHOD


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
