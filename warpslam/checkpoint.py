"""Saved state of a `Slam`: one .npz of plain arrays and one JSON header. Reading it can't run code."""

from __future__ import annotations

import json
import os
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from warpslam.camera import Intrinsics
from warpslam.config import Config
from warpslam.decoders import LEVELS, Decoders, DecoderWeights
from warpslam.errors import CheckpointError, ConfigError
from warpslam.keyframes import Keyframe, SeenDepth

if TYPE_CHECKING:
    from warpslam.slam import Slam

FORMAT = "warpslam-map"
VERSION = 1


def save_slam(slam: Slam, path: Path) -> None:
    """Write to a temporary file first, so that a crash never leaves half a file under ``path``."""
    header = {
        "format": FORMAT,
        "version": VERSION,
        "seed": slam.seed,
        "config": slam.config.model_dump(),
        "intrinsics": vars(slam.intrinsics),
        "status": slam._status,
        "current": slam._current,
        "mapped": slam._mapped,
        "keyframes": [keyframe.index for keyframe in slam.keyframes],
        "seen": [seen.index for seen in slam._seen],
    }
    arrays: dict[str, np.ndarray] = {
        "header": np.frombuffer(json.dumps(header).encode(), np.uint8),
        "timestamps": np.array(slam._timestamps),
        "vectors": np.array(slam._vectors).reshape(-1, 7),
        "bounds": np.stack(slam.scene.bounds),
        "keyframe_poses": np.array([keyframe.pose for keyframe in slam.keyframes]).reshape(-1, 7),
    }
    arrays["seen"] = np.array([seen.millimetres for seen in slam._seen], np.uint16)
    # Slot 0 is the current frame; keyframes follow in order.
    slots = [0, *(keyframe.slot for keyframe in slam.keyframes)]
    for name, pool in zip(("images_rgb", "images_depth", "images_scale"), slam._images.arrays, strict=True):
        arrays[name] = pool.numpy()[slots]
    for level, grid in slam.scene.grids.items():
        arrays[f"grid_{level}_first"] = grid.first
        arrays[f"grid_{level}_shape"] = np.array(grid.shape)
        arrays[f"grid_{level}"] = grid.features.numpy()[: grid.row_count]
    for level in LEVELS:
        weights = getattr(slam.scene.decoder_weights, level)
        if level == "color":
            weights = slam.scene.decoders["color"].unpack()
        for name, tensor in weights.tensors.items():
            arrays[f"decoder_{level}:{name}"] = tensor
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(path.name + ".part")
    with open(temporary, "wb") as file:
        np.savez(file, **arrays)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)


def load_slam(path: Path, device: str | None = None) -> Slam:
    """Raises `CheckpointError` for a file that is missing, damaged, or of another format or version."""
    from warpslam.slam import Slam

    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except FileNotFoundError:
        raise CheckpointError(f"{path}: no such file; a run writes its map as map.npz") from None
    except (OSError, ValueError, zipfile.BadZipFile, EOFError) as error:
        raise CheckpointError(
            f"{path}: not a readable .npz file ({error}); it may be truncated: use another copy"
        ) from None
    try:
        header = json.loads(arrays["header"].tobytes())
        if header["format"] != FORMAT or header["version"] != VERSION:
            raise CheckpointError(
                f"{path}: field version is {header['version']}, expected {VERSION}: "
                "load it with the warpslam that wrote it"
            )
        decoders = Decoders(*(_decoder(arrays, level) for level in LEVELS))
        config = Config.from_dict(header["config"], source=f"{path}: config")
        slam = Slam(Intrinsics(**header["intrinsics"]), config, device, header["seed"], decoders=decoders)
        slam._status, slam._current, slam._mapped = header["status"], header["current"], header["mapped"]
        slam._timestamps = [float(t) for t in arrays["timestamps"]]
        slam._vectors = list(arrays["vectors"])
        slam.scene.restore_bounds(*arrays["bounds"])
        for level, grid in slam.scene.grids.items():
            grid.restore(arrays[f"grid_{level}_first"], arrays[f"grid_{level}_shape"], arrays[f"grid_{level}"])
        slots = slam._images.restore(arrays["images_rgb"], arrays["images_depth"], arrays["images_scale"])
        slam._seen = [SeenDepth(*pair) for pair in zip(header["seen"], arrays["seen"], strict=True)]
        poses = arrays["keyframe_poses"]
        slam.keyframes = [
            Keyframe(index, slot, pose) for index, slot, pose in zip(header["keyframes"], slots[1:], poses, strict=True)
        ]
    except (KeyError, TypeError, ValueError, ConfigError) as error:
        raise CheckpointError(f"{path}: field {error} is missing or damaged: use another copy") from None
    return slam


def _decoder(arrays: dict[str, np.ndarray], level: str) -> DecoderWeights:
    prefix = f"decoder_{level}:"
    tensors = {name[len(prefix) :]: array for name, array in arrays.items() if name.startswith(prefix)}
    return DecoderWeights(level, tensors["output_linear.weight"].shape[1], tensors)
