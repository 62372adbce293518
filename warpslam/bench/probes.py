"""What studies measure besides whole runs, on a few frames of a run's sequence and with its settings."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warpslam.batch.jobs import Job
from warpslam.errors import ConfigError, DatasetError
from warpslam.field.decoder_files import load_decoders
from warpslam.field.rendering import render_image
from warpslam.frames import FrameStatus, read_images
from warpslam.mapping.frustum import measured_extent, select_in_frustum
from warpslam.mapping.policy import new_mapper
from warpslam.pipeline.setup import as_configured, load_kernels, open_source, select_frames
from warpslam.poses import orthonormalized
from warpslam.runs.given_poses import GivenPoses
from warpslam.scene.feature_grid import FeatureGrid
from warpslam.scene.image_pool import ImagePool
from warpslam.scene.scene_map import SceneMap, new_grid
from warpslam.slam import Slam
from warpslam.storage.json_files import read_json, write_json

if TYPE_CHECKING:
    from warpslam.config import Config
    from warpslam.sequences.base import Frame, RgbdSequence

PROBE_FOLDER = "probes"
CURVE_POINTS = 25
MAPPING_CALLS = 3
"""Mapping calls, after the first one, that `outside_change` looks at."""


def measure(name: str, job: Job, output: Path) -> dict[str, Any]:
    """Measure with the settings of a job, or read what was measured before with the same.

    Returns:
        ``figures`` by key, and whatever else the probe has.

    Raises:
        WarpSlamError: The sequence or a setting can't be used.
    """
    path = output / PROBE_FOLDER / f"{job.name}.{name}.json"
    try:
        known = read_json(path)
        if known.get("settings") == job.settings_hash:
            return known
    except DatasetError:  # not there, or cut short
        pass
    result = {"settings": job.settings_hash, **PROBES[name](job)}
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, result)
    return result


def convergence(job: Job) -> dict[str, Any]:
    """Mapping of the first frame alone: mean |measured - rendered depth| over its iterations (Fig. 9).

    Returns:
        ``figures``: "view_depth" at the end [cm]. ``curve``: [iteration, depth L1 [cm]] of about 25 moments.
    """
    sequence, config, frames = _open(job)
    first = next(frames, None)
    if first is None:
        raise DatasetError(f"{sequence.name}: none of the selected frames has a pose")
    frame, T_world_camera = first
    camera, device = sequence.intrinsics, wp.get_device(job.request.device)
    rgb, depth = read_images(frame.rgb, frame.depth, camera, config.grid.max_depth, None)
    scene = SceneMap(load_decoders(config.decoders), config.grid, device, job.request.seed)
    scene.cover(*measured_extent(depth, T_world_camera, camera))
    images = ImagePool(camera, device)
    images.set(0, rgb, depth)
    mapping = config.mapping.model_copy(update={"coarse": False})
    mapper = new_mapper(scene, camera, config.model_copy(update={"mapping": mapping}), device, job.request.seed)
    stride = -(-camera.width // 160)
    measured = depth[::stride, ::stride]
    valid = measured > 0
    curve: list[list[float]] = []

    def note(stage: str | None, iteration: int, count: int) -> None:
        if stage is not None and iteration + 1 != count and (iteration + 1) % max(1, count // CURVE_POINTS):
            return
        image = render_image(
            scene.arrays(), camera, T_world_camera, config.sampling, device, depth=depth, stride=stride
        )
        error = 100 * float(np.abs(image.depth - measured)[valid].mean())
        curve.append([iteration + 1, error])

    note(None, -1, mapping.first_iterations)
    mapper.start_first(images, 0, orthonormalized(T_world_camera), note)()
    return {"figures": {"view_depth": curve[-1][1]}, "curve": curve}


def outside_change(job: Job) -> dict[str, Any]:
    """What mapping calls after the first one do to features outside the frustum of their frame (A.1, Fig. D).

    Poses are given and stay as they are.

    Returns:
        ``figures``: "outside", the largest change of a feature's component. ``levels``: The same by level, and the
        share of the vertices outside that changed.
    """
    sequence, config, frames = _open(job)
    config = config.updated(["tracking.use_given_poses=true"])
    camera, device = sequence.intrinsics, wp.get_device(job.request.device)
    slam = Slam(camera, config, job.request.device, job.request.seed, timing=sequence.timing)
    images = ImagePool(camera, device)
    levels = {level: {"largest": 0.0, "changed": 0, "outside": 0} for level in ("middle", "fine", "color")}
    every = config.mapping.every

    def snapshot(level: str) -> FeatureGrid:
        grid = slam.scene.grids[level]
        copy = new_grid(level, slam.config.grid, slam.seed, device, slam.scene.decoder_weights)
        copy.restore(grid.state())
        return copy

    for number, (frame, T_world_camera) in enumerate(islice(frames, 1 + MAPPING_CALLS * every)):
        before = {} if number == 0 else {level: snapshot(level) for level in levels}
        result = slam.step(
            frame.rgb, frame.depth, frame.timestamp, T_world_camera, depth_timestamp=frame.depth_timestamp
        )
        slam.wait()
        if number % every or number == 0 or result.status != FrameStatus.OK:
            continue
        # The depth as the mapper has it, rounded.
        images.set(0, *read_images(frame.rgb, frame.depth, camera, config.grid.max_depth, None))
        depth = images.metres()
        for level, old in before.items():
            grid = slam.scene.grids[level]
            old.update_from(grid, None)
            rows = grid.row_count
            inside = select_in_frustum(
                grid.lattice, rows, camera, result.T_world_camera, depth, config.mapping.frustum_margin
            )
            change = np.abs(grid.features.numpy()[:rows] - old.features.numpy()[:rows]).max(axis=1)[~inside]
            known = levels[level]
            known["largest"] = max(known["largest"], float(change.max(initial=0.0)))
            known["changed"] += int((change > 0).sum())
            known["outside"] += len(change)
    if not any(known["outside"] for known in levels.values()):
        raise DatasetError(f"{sequence.name}: no frame but the first was mapped, so nothing can have changed")
    return {"figures": {"outside": max(known["largest"] for known in levels.values())}, "levels": levels}


PROBES: dict[str, Callable[[Job], dict[str, Any]]] = {"convergence": convergence, "outside": outside_change}
"""Probes by the names that studies have for them."""


def _open(job: Job) -> tuple[RgbdSequence, Config, Iterator[tuple[Frame, np.ndarray]]]:
    """Sequence, settings, and those of the selected frames that have a pose, with it."""
    request = job.request
    if request.source is None:
        raise ConfigError(f"{job.name} names no sequence")
    sequence = open_source(request.source)
    # Poses are used here, not given to tracking: what the settings say of it stays as it is.
    config = replace(request, poses=None).settings(sequence.preset)
    sequence = as_configured(sequence, config)
    load_kernels(sequence, request.device, config=config)
    given = None if request.poses is None else GivenPoses.read(request.poses)

    def frames() -> Iterator[tuple[Frame, np.ndarray]]:
        for index in select_frames(sequence, slice(*request.frames)):
            frame = sequence[index]
            pose = frame.T_world_camera if given is None else given.of(frame)
            if pose is not None and np.isfinite(pose).all():
                yield frame, pose

    return sequence, config, frames()
