"""Saved state of a `Slam`: all that the next frame depends on, as plain arrays and one JSON header."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpslam.camera import Intrinsics
from warpslam.config import Config
from warpslam.errors import ConfigError, InputError
from warpslam.field.decoders import LEVELS, Decoders, DecoderWeights, expected_shapes
from warpslam.runtime.cores import slice_count
from warpslam.scene.image_pool import CompactImage
from warpslam.scene.keyframes import Keyframe
from warpslam.scene.mapped_views import SEEN_STRIDE, SeenDepth
from warpslam.storage.state_file import StateFields, StateFormat, read_state, write_state

if TYPE_CHECKING:
    from warpslam.slam import Slam

MAP_FORMAT = StateFormat("warpslam-map", 4, "the map of a run with --method nice-slam")
STATUSES = ("OK", "LOST", "SKIPPED")


def save_slam(slam: Slam, path: Path) -> None:
    """Write the state to a file; what was there is replaced only when all is on the disk.

    Raises:
        CheckpointError: the file can't be written.
    """
    write_state(path, MAP_FORMAT, *slam_state(slam))


def load_slam(
    path: Path, device: str | None = None, *, config: Config | None = None, localize_only: bool = False
) -> Slam:
    """See `warpslam.slam.Slam.load`."""
    header, arrays = read_state(path, MAP_FORMAT)
    slam = slam_from_state(str(path), header, arrays, device, config=config, localize_only=localize_only)
    if localize_only:
        slam.forget_pose()
    return slam


def saved_config(path: Path) -> Config:
    """Settings of a saved map.

    Raises:
        CheckpointError: the file is missing, damaged, or of another version.
    """
    header, arrays = read_state(path, MAP_FORMAT)
    return _config(StateFields(str(path), header, arrays))


def slam_state(slam: Slam) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Header and arrays; on the CPU the large ones are views of the map, not copies."""
    slam.wait()
    header = {
        "seed": slam.seed,
        "device": "cuda" if slam.device.is_cuda else "cpu",
        "slices": slice_count(slam.device),
        "config": slam.config.model_dump(),
        "intrinsics": vars(slam.intrinsics),
        "current": slam._current,
        "mapped": slam._mapped,
        "first": slam._first,
        "keyframes": [keyframe.index for keyframe in slam.keyframes],
        "seen": [seen.index for seen in slam._seen],
    }
    rgb, depth, scale = slam._images.current()
    images = [slam._images.images[keyframe.image] for keyframe in slam.keyframes]
    arrays: dict[str, np.ndarray] = {
        "timestamps": np.array(slam._timestamps, np.float64),
        "vectors": np.array(slam._vectors, np.float64).reshape(-1, 7),
        "status": np.array([STATUSES.index(status) for status in slam._status], np.uint8),
        "depth_errors": np.array(slam._depth_errors, np.float64),
        "motion": slam._motion,
        "bounds": np.stack(slam.scene.bounds),
        "keyframe_poses": np.array([keyframe.pose for keyframe in slam.keyframes], np.float64).reshape(-1, 7),
        "seen": np.array([s.millimetres for s in slam._seen], np.uint16).reshape(-1, *_seen_size(slam.intrinsics)),
        "current_rgb": rgb,
        "current_depth": depth,
        "image_scales": np.array([scale, *(image.scale for image in images)], np.float64),
    }
    for n, image in enumerate(images):
        arrays[f"image_{n}_rgb"] = np.frombuffer(image.rgb, np.uint8)
        arrays[f"image_{n}_depth"] = np.frombuffer(image.depth, np.uint8)
    for level, grid in slam.scene.grids.items():
        arrays[f"grid_{level}_first"] = grid.first
        arrays[f"grid_{level}_shape"] = np.array(grid.shape, np.int64)
        arrays[f"grid_{level}"] = grid.features.numpy()[: grid.row_count]
        arrays[f"grid_{level}_seen"] = grid.seen.numpy()[: grid.row_count]
    for level in LEVELS:
        weights = getattr(slam.scene.decoder_weights, level)
        if level == "color":
            weights = slam.scene.decoders["color"].unpack()
        for name, tensor in weights.tensors.items():
            arrays[f"decoder_{level}:{name}"] = tensor
    return header, arrays


def slam_from_state(
    source: str,
    header: dict[str, Any],
    arrays: dict[str, np.ndarray],
    device: str | None = None,
    *,
    config: Config | None = None,
    localize_only: bool = False,
) -> Slam:
    """The `Slam` that `slam_state` was taken from.

    Args:
        source: What to call the file in an error.

    Raises:
        CheckpointError: a field is missing or does not fit the others.
        ConfigError: ``config`` does not fit the map.
    """
    from warpslam.slam import Slam

    state = StateFields(source, header, arrays)
    saved = _config(state)
    if config is not None:
        _check_same_map(source, saved, config)
    # A copy, because the caller's settings are not ours to change.
    config = (config or saved).model_copy(deep=True)
    if localize_only:
        config.mapping.enabled = False
    try:
        camera = Intrinsics(**state.mapping("intrinsics"))
    except (TypeError, ConfigError) as error:
        raise state.damaged("intrinsics", error) from None
    decoders = Decoders(*(_decoder(state, level) for level in LEVELS))
    try:
        slam = Slam(camera, config, device, state.integer("seed"), decoders=decoders)
    except InputError as error:
        raise state.damaged("intrinsics", error) from None

    slam._vectors = list(state.array("vectors", np.float64, (None, 7)).copy())
    count = len(slam._vectors)
    slam._timestamps = state.array("timestamps", np.float64, (count,)).tolist()
    slam._depth_errors = state.array("depth_errors", np.float64, (count,)).tolist()
    codes = state.array("status", np.uint8, (count,))
    if (codes >= len(STATUSES)).any():
        raise state.damaged("status", f"codes beyond {len(STATUSES) - 1}")
    slam._status = [STATUSES[code] for code in codes]
    slam._current, slam._mapped = (state.frame(name, count) for name in ("current", "mapped"))
    slam._motion = state.array("motion", np.float64, (4, 4)).copy()
    slam._first = state.integer("first")

    slam.scene.restore_bounds(*state.array("bounds", np.float64, (2, 3)).copy())
    for level, grid in slam.scene.grids.items():
        nx, ny, nz = state.array(f"grid_{level}_shape", np.int64, (3,)).tolist()
        first = state.array(f"grid_{level}_first", np.int64, (3,))
        features = state.array(f"grid_{level}", np.float32, (nx * ny * nz, 32))
        seen = state.array(f"grid_{level}_seen", np.uint8, (nx * ny * nz,))
        grid.restore(first.copy(), (nx, ny, nz), features, seen)

    size = (camera.height, camera.width)
    frames = state.frames("keyframes", count)
    scales = state.array("image_scales", np.float64, (len(frames) + 1,)).tolist()
    images = [
        CompactImage(
            state.array(f"image_{n}_rgb", np.uint8, (None,)).tobytes(),
            state.array(f"image_{n}_depth", np.uint8, (None,)).tobytes(),
            scales[n + 1],
        )
        for n in range(len(frames))
    ]
    for n, image in enumerate(images):
        try:
            image.unpack(camera)
        except (ValueError, zlib.error) as error:
            raise state.damaged(f"image_{n}", error) from None
    rgb, depth = state.array("current_rgb", np.uint8, (*size, 3)), state.array("current_depth", np.uint16, size)
    slam._images.restore((rgb, depth, scales[0]), images)
    poses = state.array("keyframe_poses", np.float64, (len(frames), 7)).copy()
    slam.keyframes = [Keyframe(index, n, pose) for n, (index, pose) in enumerate(zip(frames, poses, strict=True))]
    seen = state.frames("seen", count)
    depths = state.array("seen", np.uint16, (len(seen), *_seen_size(camera)))
    slam._seen = [SeenDepth(index, image) for index, image in zip(seen, depths, strict=True)]
    return slam


def _config(state: StateFields) -> Config:
    try:
        return Config.from_dict(state.mapping("config"))
    except ConfigError as error:
        raise state.damaged("config", error) from None


def _seen_size(camera: Intrinsics) -> tuple[int, int]:
    strided = camera.strided(SEEN_STRIDE)
    return strided.height, strided.width


def _decoder(state: StateFields, level: str) -> DecoderWeights:
    hidden = state.array(f"decoder_{level}:output_linear.weight", np.float32, (None, None)).shape[1]
    if not 1 <= hidden <= 32:
        raise state.damaged(f"decoder_{level}:output_linear.weight", f"{hidden} is no width of a decoder")
    shapes = expected_shapes(level, hidden)
    tensors = {name: state.array(f"decoder_{level}:{name}", np.float32, shape) for name, shape in shapes.items()}
    return DecoderWeights(level, hidden, tensors)


def _check_same_map(source: str, saved: Config, config: Config) -> None:
    for level in ("coarse", "middle", "fine", "color"):
        name = f"{level}_spacing"
        ours, theirs = getattr(config.grid, name), getattr(saved.grid, name)
        if ours != theirs:
            raise ConfigError(f"grid.{name} = {ours} does not fit the map {source}, which has {theirs}")
