"""Saved state of a `Slam`: all that the next frame depends on, as plain arrays and one JSON header."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import warp as wp
from pydantic import Field

from warpslam.camera import FrameMotion, Intrinsics, SensorTiming
from warpslam.config import Config, GridConfig
from warpslam.errors import ConfigError, InputError
from warpslam.field.decoders import LEVELS, Decoders, DecoderWeights, expected_shapes
from warpslam.frames import check_settings
from warpslam.kernels.decoder.layout import COLOR_WEIGHT_ROWS
from warpslam.kernels.grid import BLOCK, BLOCK_ROWS
from warpslam.loops.closer import LoopFigures, LoopState
from warpslam.poses import MAX_DISTANCE, are_rigid
from warpslam.runtime.cores import slice_count
from warpslam.scene.feature_grid import GridState
from warpslam.scene.image_pool import CompactImage
from warpslam.scene.keyframes import Keyframe
from warpslam.scene.mapped_views import SEEN_STRIDE, SeenDepth
from warpslam.scene.scene_map import SceneState, is_in_blocks
from warpslam.scene.touched_rows import TouchedRowsState
from warpslam.storage.json_files import Finite, Index
from warpslam.storage.state_file import StateFields, StateFormat, read_state, write_state
from warpslam.tracking.direct.timing import TimingState
from warpslam.tracking.direct.tracker import DirectState
from warpslam.trajectory import HistoryState

MAP_FORMAT = StateFormat("warpslam-map", 8, "the map of a run with --method nice-slam")


@dataclass(frozen=True)
class SlamState:
    """All parts of a `Slam`, each as it states itself."""

    config: Config
    """Settings."""
    intrinsics: Intrinsics
    """Camera."""
    timing: SensorTiming
    """When its pixels are taken."""
    seed: int
    """Of every random choice."""
    device: wp.Device
    """Where it computed; a state that was read is on the CPU."""
    history: HistoryState
    """What became of every frame."""
    scene: SceneState
    """The map."""
    current_image: tuple[np.ndarray, np.ndarray, float]
    """Colour, uint16 depth and its scale of the current frame, as it was taken."""
    current_motion: FrameMotion
    """What it is rectified by."""
    keyframes: Sequence[tuple[Keyframe, CompactImage]]
    """In their order."""
    seen: Sequence[SeenDepth]
    """What the mapped frames saw."""
    current: int | None
    """The current frame, if there is one."""
    mapped: int | None
    """The last frame that was mapped, if there is one."""
    direct: DirectState | None = None
    """What direct tracking goes on from."""
    digest: int | None = None
    """By which the images of the last frame are known again."""
    timing_state: TimingState | None = None
    """What the estimate of the camera's timing goes on from."""
    loops: LoopState | None = None
    """What the search for loops goes on from."""
    optimizer: dict[str, TouchedRowsState] = field(default_factory=dict)
    """What mapping keeps of rows that were updated, by level."""


def write_slam(path: Path, state: SlamState) -> None:
    """Write a state to a file; what was there is replaced only when all is on the disk.

    Raises:
        CheckpointError: The file can't be written.
    """
    write_state(path, MAP_FORMAT, *state_arrays(state))


def read_slam(path: Path, config: Config | None = None) -> SlamState:
    """Read what `write_slam` wrote.

    Args:
        path: File.
        config: Settings from now on, those saved by default; the grids' spacings are the map's.

    Raises:
        CheckpointError: The file is missing, damaged, or of another version.
        ConfigError: ``config`` does not fit the map.
    """
    return state_from_arrays(str(path), *read_state(path, MAP_FORMAT), config=config)


def saved_config(path: Path) -> Config:
    """Settings of a saved map.

    Raises:
        CheckpointError: The file is missing, damaged, or of another version.
    """
    header, arrays = read_state(path, MAP_FORMAT)
    return _config(StateFields(str(path), header, arrays))


def state_arrays(state: SlamState) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Header and arrays of a state."""
    header = {
        "seed": state.seed,
        "device": "cuda" if state.device.is_cuda else "cpu",
        "slices": slice_count(state.device),
        "config": state.config.model_dump(),
        "intrinsics": vars(state.intrinsics),
        "timing": vars(state.timing),
        "current": state.current,
        "mapped": state.mapped,
        "digest": state.digest,
        "first": state.history.first,
        "keyframes": [keyframe.index for keyframe, _ in state.keyframes],
        "seen": [seen.index for seen in state.seen],
        "direct": None if state.direct is None else _direct_header(state.direct),
        "timing_estimate": None if state.timing_state is None else _timing_header(state.timing_state),
        "optimizer": list(state.optimizer),
    }
    if state.loops is not None:
        header["loops"] = {"seen": state.loops.seen, "figures": state.loops.figures}
    rgb, depth, scale = state.current_image
    images = [image for _, image in state.keyframes]
    keyframe_poses = [keyframe.pose for keyframe, _ in state.keyframes]
    motions = [state.current_motion, *(keyframe.motion for keyframe, _ in state.keyframes)]
    seen = [one.millimetres for one in state.seen]
    arrays: dict[str, np.ndarray] = {
        **state.history.arrays(),
        "bounds": np.stack([state.scene.low, state.scene.high]),
        "motions": np.array([one.to_array() for one in motions], np.float64),
        "keyframe_poses": np.array(keyframe_poses, np.float64).reshape(-1, 4, 4),
        "seen": np.array(seen, np.uint16).reshape(-1, *_seen_size(state.intrinsics)),
        "current_rgb": rgb,
        "current_depth": depth,
        "image_scales": np.array([scale, *(image.scale for image in images)], np.float64),
    }
    if state.direct is not None:
        arrays |= {f"direct_{name}": array for name, array in state.direct.arrays().items()}
    if state.timing_state is not None:
        arrays["timing_blocks"] = state.timing_state.blocks
    if state.loops is not None:
        arrays |= {f"loops_{name}": array for name, array in state.loops.arrays.items()}
    for n, image in enumerate(images):
        arrays[f"image_{n}_rgb"] = np.frombuffer(image.rgb, np.uint8)
        arrays[f"image_{n}_depth"] = np.frombuffer(image.depth, np.uint8)
    for level, grid in state.scene.grids.items():
        arrays[f"grid_{level}_first"] = grid.first
        arrays[f"grid_{level}_shape"] = np.array(grid.shape, np.int64)
        arrays[f"grid_{level}"] = grid.features
        arrays[f"grid_{level}_seen"] = grid.seen
        if grid.blocks is not None:
            arrays[f"grid_{level}_blocks"] = grid.blocks
    for level, rows in state.optimizer.items():
        arrays[f"optimizer_{level}_rows"] = rows.rows
        arrays[f"optimizer_{level}_updates"] = rows.updates
        arrays[f"optimizer_{level}_moments"] = rows.moments
    for weights in state.scene.decoders:
        for name, tensor in weights.tensors.items():
            arrays[f"decoder_{weights.level}:{name}"] = tensor
    return header, arrays


def state_from_arrays(
    source: str, header: dict[str, Any], arrays: dict[str, np.ndarray], *, config: Config | None = None
) -> SlamState:
    """The state that `state_arrays` was given.

    Args:
        source: What to call the file in an error.
        header: As `state_arrays` returned it.
        arrays: As `state_arrays` returned them.
        config: Settings from now on, those saved by default.

    Raises:
        CheckpointError: A field is missing or does not fit the others.
        ConfigError: ``config`` does not fit the map.
    """
    fields = StateFields(source, header, arrays)
    saved = _config(fields)
    if config is not None:
        _check_same_map(source, saved, config)
    config = config or saved
    try:
        camera = Intrinsics(**fields.mapping("intrinsics"))
        check_settings(camera, config)
    except (TypeError, ConfigError, InputError) as error:
        raise fields.damaged("intrinsics", error) from None
    timing = fields.parsed("timing", lambda values: SensorTiming(**values))
    history = HistoryState.read(fields)
    count = len(history.poses)
    size = (camera.height, camera.width)
    # Of the size that the camera says, before anything else is unpacked to that size.
    rgb, depth = fields.array("current_rgb", np.uint8, (*size, 3)), fields.array("current_depth", np.uint16, size)
    frames = fields.frames("keyframes", count)
    scales = _within(fields, "image_scales", (len(frames) + 1,), 0.0, 1.0).tolist()
    images = [_image(fields, n, scales[n + 1], camera) for n in range(len(frames))]
    poses = fields.poses("keyframe_poses", len(frames)).copy()
    motions = [_motion(fields, "motions", one) for one in fields.array("motions", np.float64, (len(frames) + 1, 8))]
    keyframes = [Keyframe(index, n, poses[n], motions[n + 1]) for n, index in enumerate(frames)]
    seen = fields.frames("seen", count)
    depths = fields.array("seen", np.uint16, (len(seen), *_seen_size(camera)))
    low, high = _within(fields, "bounds", (2, 3), -2 * MAX_DISTANCE, 2 * MAX_DISTANCE).copy()
    grids = {level: _grid(fields, level, saved.grid, low, high) for level in LEVELS}
    if len({0 in grid.shape for grid in grids.values()}) > 1:
        raise fields.damaged("grid_middle_shape", "some levels are empty, and some are not")
    decoders = Decoders(*(_decoder(fields, level) for level in LEVELS))
    digest = fields.header.get("digest")
    if digest is not None:
        digest = fields.integer("digest")
    return SlamState(
        config=config,
        intrinsics=camera,
        timing=timing,
        seed=fields.integer("seed"),
        device=wp.get_device("cpu"),
        history=history,
        scene=SceneState(decoders, low, high, grids),
        current_image=(rgb, depth, scales[0]),
        current_motion=motions[0],
        keyframes=list(zip(keyframes, images, strict=True)),
        seen=[SeenDepth(index, image) for index, image in zip(seen, depths, strict=True)],
        current=fields.frame("current", count),
        mapped=fields.frame("mapped", count),
        direct=_direct(fields, count, len(frames)),
        digest=digest,
        timing_state=_timing_state(fields, count),
        loops=_loops(fields, count, len(frames)),
        optimizer=_optimizer(fields, grids),
    )


def _config(fields: StateFields) -> Config:
    try:
        return Config.from_dict(fields.mapping("config"))
    except ConfigError as error:
        raise fields.damaged("config", error) from None


def _within(fields: StateFields, name: str, shape: tuple[int, ...], least: float, most: float) -> np.ndarray:
    array = fields.array(name, np.float64, shape)
    if ((array < least) | (array > most)).any():
        raise fields.damaged(name, f"it holds {array.min():g} to {array.max():g}, expected {least:g} to {most:g}")
    return array


def _motion(fields: StateFields, name: str, values: np.ndarray) -> FrameMotion:
    motion = FrameMotion.from_array(values)
    if not motion.is_possible:
        raise fields.damaged(name, f"no camera moves so: {motion}")
    return motion


def _grid(fields: StateFields, level: str, config: GridConfig, low: np.ndarray, high: np.ndarray) -> GridState:
    spacing = getattr(config, f"{level}_spacing")
    shape = fields.array(f"grid_{level}_shape", np.int64, (3,))
    first = fields.array(f"grid_{level}_first", np.int64, (3,)).copy()
    nx, ny, nz = shape.tolist()
    if (nx, ny, nz) != (0, 0, 0):
        # A cell has two vertices along each axis, and what the map covers lies in its cells.
        ends = first.astype(float) * spacing, (first.astype(float) + shape - 1) * spacing
        beyond = max(float((ends[0] - low).max()), float((high - ends[1]).max()))
        if min(nx, ny, nz) < 2 or beyond > 1e-3 * spacing or np.abs(ends).max() > 3 * MAX_DISTANCE:
            raise fields.damaged(f"grid_{level}_shape", f"{nx} x {ny} x {nz} from {first.tolist()} on does not fit")
    rows, blocks = nx * ny * nz, None
    if is_in_blocks(level, config):
        blocks = _blocks(fields, level, first, shape)
        rows = BLOCK_ROWS * len(blocks)
    return GridState(
        first,
        (nx, ny, nz),
        fields.array(f"grid_{level}", np.float32, (rows, 32)),
        fields.array(f"grid_{level}_seen", np.uint8, (rows,)),
        blocks,
    )


def _blocks(fields: StateFields, level: str, first: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """Those of a grid's box that were made, each once."""
    name = f"grid_{level}_blocks"
    blocks = fields.array(name, np.int64, (None, 3)).copy()
    low, high = first // BLOCK, (first + shape - 1) // BLOCK
    if len(blocks) and (not shape.all() or (blocks < low).any() or (blocks > high).any()):
        raise fields.damaged(name, f"not all lie in the grid, {low.tolist()} to {high.tolist()}")
    if len(np.unique(blocks, axis=0)) != len(blocks):
        raise fields.damaged(name, "a block is there twice")
    return blocks


def _optimizer(fields: StateFields, grids: dict[str, GridState]) -> dict[str, TouchedRowsState]:
    levels = fields.names("optimizer", (*LEVELS, "decoder"))
    result = {}
    for level in levels:
        is_grid = level != "decoder"
        total = COLOR_WEIGHT_ROWS
        if is_grid:
            grid = grids[level]
            total = len(grid.seen) + (0 if grid.blocks is None else BLOCK_ROWS)
        rows = fields.array(f"optimizer_{level}_rows", np.int32, (None if is_grid else total,))
        if len(rows) and (rows[0] < 0 or rows[-1] >= total or (np.diff(rows) <= 0).any()):
            raise fields.damaged(f"optimizer_{level}_rows", f"not ascending rows below {total}")
        result[level] = TouchedRowsState(
            rows,
            fields.array(f"optimizer_{level}_updates", np.int32, (len(rows),)),
            fields.array(f"optimizer_{level}_moments", np.float32, (len(rows), 2, 32)),
        )
    return result


def _image(fields: StateFields, n: int, scale: float, camera: Intrinsics) -> CompactImage:
    rgb, depth = (fields.array(f"image_{n}_{part}", np.uint8, (None,)).tobytes() for part in ("rgb", "depth"))
    image = CompactImage(rgb, depth, scale)
    try:
        image.unpack(camera)
    except (ValueError, zlib.error) as error:
        raise fields.damaged(f"image_{n}", error) from None
    return image


def _direct_header(state: DirectState) -> dict[str, Any]:
    # JSON knows no infinity.
    scale, cost = (value if np.isfinite(value) else None for value in state.typical)
    return {
        "reference": state.reference,
        "before": state.before,
        "confirmed": state.confirmed,
        "depth_sigma": state.depth_sigma,
        "scale": scale,
        "cost": cost,
    }


def _direct(fields: StateFields, frames: int, keyframes: int) -> DirectState | None:
    if fields.header.get("direct") is None:
        return None
    header = fields.checked("direct", _DirectHeader)
    anchors = fields.array("direct_anchors", np.int64, (None,))
    count = len(anchors)
    if count > frames or (anchors >= keyframes).any():
        raise fields.damaged("direct_anchors", f"{count} frames of {frames}, keyframes up to {anchors.max(initial=-1)}")
    reference, before, confirmed, depth_sigma = header.reference, header.before, header.confirmed, header.depth_sigma
    scale, cost = (np.inf if value is None else value for value in (header.scale, header.cost))
    relative = fields.array("direct_relative", np.float64, (count, 4, 4)).copy()
    found = fields.array("direct_found", np.float64, (2, 4, 4)).copy()
    if not are_rigid(relative[anchors >= 0]) or (confirmed > 0 and not are_rigid(found)):
        raise fields.damaged("direct_relative or direct_found", "they are no rigid transforms of a camera")
    motion = fields.array("direct_motion", np.float64, (8,)).copy()
    _motion(fields, "direct_motion", motion)
    if not (0 <= reference < max(keyframes, 1) and -1 <= before < frames):
        raise fields.damaged("direct", f"reference {reference} of {keyframes}, frame {before} of {frames}")
    return DirectState(
        anchors=anchors.copy(),
        relative=relative,
        overlap=fields.array("direct_overlap", np.float64, (keyframes,)).copy(),
        reference=reference,
        before=before,
        found=found,
        confirmed=confirmed,
        motion=motion,
        depth_sigma=depth_sigma,
        typical=(scale, cost),
    )


@dataclass(frozen=True)
class _DirectHeader:
    reference: Index
    before: Annotated[int, Field(ge=-1)]
    confirmed: Index
    depth_sigma: Annotated[Finite, Field(ge=0.0)]
    scale: Annotated[Finite, Field(ge=0.0)] | None
    cost: Annotated[Finite, Field(ge=0.0)] | None


@dataclass(frozen=True)
class _TimingHeader:
    first: Index
    since: Index
    stamped: bool
    stage: Index
    is_done: bool


@dataclass(frozen=True)
class _LoopsHeader:
    seen: Index
    figures: dict[str, Finite]


def _timing_header(state: TimingState) -> dict[str, Any]:
    return {name: value for name, value in vars(state).items() if name != "blocks"}


def _timing_state(fields: StateFields, frames: int) -> TimingState | None:
    if fields.header.get("timing_estimate") is None:
        return None
    blocks = fields.array("timing_blocks", np.float64, (None, 6)).copy()
    state = TimingState(blocks=blocks, **vars(fields.checked("timing_estimate", _TimingHeader)))
    if not (0 <= state.first <= state.since and np.isfinite(blocks).all()):
        raise fields.damaged("timing_estimate", f"frames from {state.first}, those that count from {state.since}")
    return state


def _loops(fields: StateFields, count: int, keyframes: int) -> LoopState | None:
    if fields.header.get("loops") is None:
        return None
    header = fields.checked("loops", _LoopsHeader)
    arrays = {}
    for kind in ("tracked", "loop", "bridge"):
        pairs = fields.array(f"loops_{kind}_pairs", np.int64, (None, 2)).copy()
        if len(pairs) and (pairs.min() < 0 or pairs.max() >= keyframes or (pairs[:, 0] >= pairs[:, 1]).any()):
            raise fields.damaged(f"loops_{kind}_pairs", f"pairs of keyframes up to {pairs.max()}, of {keyframes}")
        arrays[f"{kind}_pairs"] = pairs
        arrays[f"{kind}_transforms"] = fields.poses(f"loops_{kind}_transforms", len(pairs)).copy()
        arrays[f"{kind}_covariances"] = fields.covariances(f"loops_{kind}_covariances", len(pairs)).copy()
    made = arrays["made_frames"] = fields.array("loops_made_frames", np.int64, (None,)).copy()
    if len(made) and (made.min() < 0 or made.max() >= count or len(np.unique(made)) < len(made)):
        raise fields.damaged("loops_made_frames", f"frames up to {made.max()}, of {count}")
    arrays["made_poses"] = fields.poses("loops_made_poses", len(made)).copy()
    try:
        LoopFigures.of(header.figures)
    except KeyError as error:
        raise fields.damaged("loops.figures", f"{error} is missing") from None
    if header.seen > keyframes:
        raise fields.damaged("loops", f"{header.seen} keyframes of {keyframes} were looked at")
    return LoopState(arrays, header.seen, header.figures)


def _seen_size(camera: Intrinsics) -> tuple[int, int]:
    strided = camera.strided(SEEN_STRIDE)
    return strided.height, strided.width


def _decoder(fields: StateFields, level: str) -> DecoderWeights:
    hidden = fields.array(f"decoder_{level}:output_linear.weight", np.float32, (None, None)).shape[1]
    if not 1 <= hidden <= 32:
        raise fields.damaged(f"decoder_{level}:output_linear.weight", f"{hidden} is no width of a decoder")
    shapes = expected_shapes(level, hidden)
    tensors = {name: fields.array(f"decoder_{level}:{name}", np.float32, shape) for name, shape in shapes.items()}
    return DecoderWeights(level, hidden, tensors)


def _check_same_map(source: str, saved: Config, config: Config) -> None:
    for level in LEVELS:
        name = f"{level}_spacing"
        ours, theirs = getattr(config.grid, name), getattr(saved.grid, name)
        if ours != theirs:
            raise ConfigError(f"grid.{name} = {ours} does not fit the map {source}, which has {theirs}")
    if config.grid.layout != saved.grid.layout:
        raise ConfigError(
            f"grid.layout = {config.grid.layout} does not fit the map {source}, which is {saved.grid.layout}"
        )
