"""Frames that a camera, a disk or a hand has spoilt, into `Slam.step`: a bad one changes nothing."""

from __future__ import annotations

from typing import Any

import numpy as np

from tools.attacks import scene
from tools.attacks.isolation import Attempt
from tools.attacks.values import DOUBLES, OBJECTS, numbers
from warpslam.errors import WarpSlamError
from warpslam.frames import FrameStatus
from warpslam.slam import Slam

_FRESH_MAP = 40  # tries on one map


def prepare(name: str) -> Attempt:
    """A map that is made anew now and then, tracked or with given poses."""
    slams: list[Slam] = []

    def attempt(rng: np.random.Generator) -> str:
        if not slams or len(slams[0].history) > _FRESH_MAP:
            given = rng.random() < 0.3
            slams[:] = [scene.small_slam(*(["tracking.use_given_poses=true"] if given else []), count=3)]
        slam = slams[0]
        frame = scene.frames()[int(rng.integers(3, 6))]
        arguments: dict[str, Any] = {
            "rgb": frame.rgb.copy(), "depth": frame.depth.copy(), "timestamp": 10.0 + len(slam.history) / 30,
            "T_world_camera": frame.T_world_camera,
        }  # fmt: skip
        for _ in range(int(rng.integers(1, 3))):
            _spoil(arguments, rng)
        before, count = scene.map_digest(slam), len(slam.history)
        try:
            result = slam.step(**arguments)
        except WarpSlamError:
            assert scene.map_digest(slam) == before, "an error, and another map"
            assert len(slam.history) == count, "an error, and the frame counts"
            raise
        assert np.isfinite(result.T_world_camera).all(), "a pose that is not finite"
        if result.status != FrameStatus.OK:
            assert scene.map_digest(slam) == before, f"{result.status}, and another map"
        for grid in slam.scene.grids.values():
            assert np.isfinite(grid.features.numpy()).all(), "a map that is not finite"
        return str(result.status)

    return attempt


def _spoil(arguments: dict[str, Any], rng: np.random.Generator) -> None:
    name = str(rng.choice(["rgb", "depth", "depth", "timestamp", "T_world_camera"]))
    value = arguments[name]
    if rng.random() < 0.15:
        arguments[name] = OBJECTS[rng.integers(0, len(OBJECTS))]
    elif name == "timestamp":
        arguments[name] = float(rng.choice(DOUBLES))
    elif name == "T_world_camera":
        T = np.eye(4) if not isinstance(value, np.ndarray) or value.shape != (4, 4) else value.copy()
        kind = rng.integers(0, 4)
        if kind == 0:
            T[rng.integers(0, 4), rng.integers(0, 4)] = rng.choice(DOUBLES)
        elif kind == 1:
            T[:3, 3] += rng.normal(size=3) * 10.0 ** rng.uniform(-2, 7)
        elif kind == 2:
            T = T.T.copy()
        else:
            T = -T
        arguments[name] = T
    elif isinstance(value, np.ndarray) and value.ndim >= 2:
        arguments[name] = _spoilt_image(value, rng)


def _spoilt_image(image: np.ndarray, rng: np.random.Generator) -> Any:
    kind = rng.integers(0, 10)
    if kind == 0:
        return image[:-1]
    if kind == 1:
        return image.astype(rng.choice([np.float64, np.int16, np.int64, np.uint16, np.float16, np.complex64, bool]))
    if kind == 2:
        return np.zeros_like(image)
    if kind == 3:
        return rng.permutation(image.reshape(-1)).reshape(image.shape)
    if kind == 4:
        return image[::-1]
    if kind == 5:
        with np.errstate(over="ignore", invalid="ignore"):
            return np.asfortranarray(image * image.dtype.type(rng.choice([0.5, 2.0, 10.0])))
    if image.dtype.kind == "f":
        changed = image.copy()
        share = rng.choice([0.01, 0.5, 1.0])
        where = rng.random(image.shape) < share
        with np.errstate(over="ignore"):
            changed[where] = numbers(rng, (int(where.sum()),), 0.8).astype(image.dtype)
        return changed
    return rng.integers(0, 256, image.shape, dtype=np.uint8)
