"""What a run starts with: its sequence and frames, its settings, its device and kernels, and its method or a map."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import warp as wp

from warpslam.camera import ONE_MOMENT, Intrinsics, SensorTiming
from warpslam.config import Config
from warpslam.errors import CheckpointError, ConfigError, InputError
from warpslam.evaluation import load_mesh
from warpslam.pipeline.methods import build_method, check_method, has_checkpoints, load_method
from warpslam.runs.folder import RunFolder
from warpslam.runs.metrics import RunMetrics
from warpslam.runs.request import DEFAULT_METHOD, RunRequest, Source
from warpslam.runtime.compilation import ModuleProgress, compile_kernels
from warpslam.runtime.environment import named_device
from warpslam.runtime.kernel_cache import kernel_cache_errors
from warpslam.sequences import open_sequence
from warpslam.slam import Slam
from warpslam.slam_state import saved_config
from warpslam.synthetic import demo

if TYPE_CHECKING:
    import trimesh

    from warpslam.pipeline.methods import Method
    from warpslam.sequences.base import RgbdSequence


def open_source(source: Source) -> RgbdSequence:
    """Open the input of a run.

    Raises:
        DatasetError: The folder is not there, or can't be read.
    """
    if source.is_demo:
        return demo.demo_sequence()
    return open_sequence(source.path or "", dataset=source.dataset, camera=source.camera, topics=source.topics)


def as_configured(sequence: RgbdSequence, config: Config | None) -> RgbdSequence:
    """The sequence with frames of the kind that settings ask for."""
    return sequence.as_published() if config is not None and config.published_images else sequence


def true_surface(request: RunRequest, sequence: RgbdSequence) -> trimesh.Trimesh | None:
    """The surface that a reconstruction is compared with: that of the request, or the built-in sequence's own.

    Raises:
        MeshError: The file can't be read.
    """
    if request.truth_mesh is not None:
        return load_mesh(request.truth_mesh)
    is_demo = request.source is not None and request.source.is_demo
    return getattr(sequence, "mesh", None) if is_demo else None


def resolve(request: RunRequest, sequence: RgbdSequence) -> RunRequest:
    """The request with nothing left open: see `RunRequest.resolved`.

    Raises:
        ConfigError: Something asked for does not go together, or a setting is out of range.
        CheckpointError: The settings of a map can't be read.
    """
    check_checkpoint_settings(request.checkpoint_every, request.map, request.localize_only, request.method)
    if request.map is not None and request.config is None and request.preset is None:
        request = replace(request, config=saved_config(Path(request.map)))
    # The paper's code leaves frames out, and counts those that are left.
    frames = as_configured(sequence, request.settings(sequence.preset))
    selected = select_frames(frames, slice(*request.frames))
    return request.resolved(sequence.preset, selected, device_name(request.device))


def select_frames(sequence: RgbdSequence, frames: slice | None) -> range:
    """Numbers of the frames to use, all by default.

    Raises:
        ConfigError: The slice selects none, or goes backwards.
    """
    frames = slice(None) if frames is None else frames
    if frames.step is not None and frames.step < 1:
        raise ConfigError(f"frames: step {frames.step} must be at least 1; SLAM goes forward in time")
    selected = range(*frames.indices(len(sequence)))
    if len(selected) == 0:
        wanted = ":".join("" if part is None else str(part) for part in (frames.start, frames.stop, frames.step))
        raise ConfigError(f"frames {wanted} selects none of the {len(sequence)} frames of {sequence.name}")
    return selected


def check_checkpoint_settings(every: int | None, map_path: str | Path | None, localize_only: bool, method: str) -> None:
    """Refuse settings of checkpoints and maps that do not go together.

    Raises:
        ConfigError: Names them.
    """
    check_method(method)
    if not has_checkpoints(method) and (every is not None or map_path is not None):
        raise ConfigError(f"method {method} has no checkpoints and takes no map: leave out checkpoint_every and map")
    if every is not None and every < 1:
        raise ConfigError(f"checkpoint_every = {every} must be at least 1 frame")
    if localize_only and map_path is None:
        raise ConfigError("localize_only needs a map: name one with map_path (--map)")


def check_device(device: str | None) -> None:
    """Whether Warp has the device of that name; None is Warp's preferred one.

    Raises:
        ConfigError: It has not.
    """
    with kernel_cache_errors():
        named_device(device)


def check_map(path: str | Path | None) -> None:
    """Whether a map that a run is to start from is there; what is in it is looked at when it is loaded.

    Raises:
        CheckpointError: It is not.
    """
    if path is not None and not os.path.isfile(path):
        raise CheckpointError(f"{path}: no such file; name the map of a run, or its folder")


def device_name(device: str | None) -> str:
    """The device that a name, or none, leads to; a name that leads nowhere is told of when the run starts."""
    names = [str(known) for known in wp.get_devices()]
    return str(wp.get_device(device)) if device is None or device in (*names, "cuda") and names[1:] else str(device)


def load_kernels(
    sequence: RgbdSequence,
    device: str | None,
    report: Callable[[ModuleProgress], None] | None = None,
    config: Config | None = None,
) -> list[ModuleProgress]:
    """Load all kernels that a run over ``sequence`` needs, compiling those that never were; see
    `warpslam.runtime.compilation.compile_kernels`.

    Raises:
        ConfigError: There is no such device.
    """
    check_device(device)
    layout = (config or Config()).grid.layout
    return compile_kernels(wp.get_device(device), report, getattr(sequence, "warp_modules", ()), [layout])


def build_slam(
    intrinsics: Intrinsics,
    config: Config,
    device: str | None,
    seed: int,
    method: str = DEFAULT_METHOD,
    timing: SensorTiming = ONE_MOMENT,
) -> Method:
    """The method of a run; see `warpslam.pipeline.methods.build_method` for what else it raises.

    Raises:
        ConfigError: There is no such device.
    """
    check_device(device)
    return build_method(method, intrinsics, config, device, seed, timing)


def open_map(
    path: str | Path,
    intrinsics: Intrinsics,
    config: Config,
    device: str | None,
    *,
    timing: SensorTiming = ONE_MOMENT,
    localize_only: bool = False,
) -> Slam:
    """The SLAM object of a run that starts from a map; ``timing`` is that of the frames to come.

    Raises:
        ConfigError: There is no such device, or the settings do not fit the map.
        CheckpointError: The map can't be loaded.
        InputError: The map was made with another camera.
    """
    check_device(device)
    slam = Slam.load(path, device, config=config, localize_only=localize_only, timing=timing)
    if slam.intrinsics != intrinsics:
        raise InputError(f"{path} was made with another camera: {slam.intrinsics}, the sequence has {intrinsics}")
    slam.forget_pose()
    return slam


def load_slam(folder: RunFolder, device: str | None = None) -> Method:
    """The SLAM object (or the baseline) as a run left it.

    Raises:
        ConfigError: There is no such device.
        DatasetError: The run saved no map.
        CheckpointError: The map can't be loaded.
    """
    path = folder.require(folder.map, "the run stopped before it had a map")
    check_device(device)
    return load_method(RunMetrics.read(folder.metrics).method or DEFAULT_METHOD, path, device)
