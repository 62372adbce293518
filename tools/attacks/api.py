"""Public functions and constructors, given what nobody should give them."""

from __future__ import annotations

import copy
import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from tools.attacks import scene
from tools.attacks.isolation import Attempt
from tools.attacks.values import DOUBLES, OBJECTS, numbers
from warpslam.camera import Intrinsics, SensorTiming
from warpslam.config import Config
from warpslam.field.decoder_files import load_decoders
from warpslam.sequences import open_sequence
from warpslam.slam import Slam

_PATHS = (
    "map", "", "a/b/map", "\0", "x" * 300, "\udcff", "new\nline\x1b[31m", "/dev/null", "/dev/full", "/proc/self/mem",
    "/proc/version", "/proc/kmsg", ".", "~", "map.safetensors/map",
)  # fmt: skip
_SETTINGS = (
    "grid.margin", "grid.fine_spacing", "grid.max_gigabytes", "grid.max_depth", "mapping.pixels", "mapping.window",
    "mapping.every", "mapping.iterations", "keyframes.every", "keyframes.max_gigabytes", "tracking.pixels",
    "tracking.ignore_edge_u", "direct.window", "direct.joint", "schedule", "sampling.surface", "meshing.voxel", "seed",
    "", "grid", "grid.fine_spacing.x",
)  # fmt: skip
_VALUES = (
    "=0", "=-1", "=1", "=1e-9", "=1e9", "=nan", "=.inf", "=null", "=[]", "={}", "=x", "=true", "=!!python/none", "=",
    "", "=" + "9" * 500, "=strict", "=overlapped", "=0.5", "=&a [*a]", "=\x00", "=2026-01-01",
)  # fmt: skip


def prepare(name: str) -> Attempt:
    """On one small map."""
    folder = Path(tempfile.mkdtemp(prefix="warpslam-attacks-"))
    os.chdir(folder)  # names without a folder are tried, too
    slam = scene.small_slam()
    good = slam.trajectory.poses[0]
    depth = scene.frames()[0].depth

    def pose(rng: np.random.Generator) -> Any:
        kind = rng.integers(0, 5)
        if kind == 0:
            return OBJECTS[rng.integers(0, len(OBJECTS))]
        T = copy.deepcopy(good)
        if kind == 1:
            T[rng.integers(0, 4), rng.integers(0, 4)] = rng.choice(DOUBLES)
        elif kind == 2:
            T[:3, 3] = numbers(rng, (3,))
        elif kind == 3:
            T = numbers(rng, (4, 4), 0.1)
        else:
            T[:3, 3] = rng.normal(size=3) * 10.0 ** rng.uniform(-1, 5)
        return _as_tensor(T, rng)

    def points(rng: np.random.Generator) -> Any:
        if rng.random() < 0.2:
            return OBJECTS[rng.integers(0, len(OBJECTS))]
        return _as_tensor(numbers(rng, (int(rng.integers(0, 50)), 3), rng.choice([0.0, 0.1])), rng)

    def attempt(rng: np.random.Generator) -> str:
        kind = rng.integers(0, 9)
        if kind == 0:
            stride = rng.choice([1, 4, 7]) if rng.random() < 0.6 else OBJECTS[rng.integers(0, len(OBJECTS))]
            image = slam.render(pose(rng), stride=stride if rng.random() < 0.5 else int(rng.integers(-2, 90)))
            assert np.isfinite(image.depth).all() and np.isfinite(image.rgb).all(), "an image that is not finite"
            return "rendered"
        if kind == 1:
            guide = numbers(rng, (60, 80), 0.3) if rng.random() < 0.7 else OBJECTS[rng.integers(0, len(OBJECTS))]
            image = slam.render(good, depth=guide if rng.random() < 0.8 else depth[:-1], stride=4)
            assert np.isfinite(image.depth).all() and np.isfinite(image.rgb).all(), "an image that is not finite"
            return "rendered"
        if kind == 2:
            assert np.isfinite(
                slam.scene.query_occupancy(points(rng), rng.choice(["fine", "middle", "coarse", "x"]))
            ).all()
            return "asked"
        if kind == 3:
            assert np.isfinite(slam.scene.query_color(points(rng))).all(), "a colour that is not finite"
            return "asked"
        if kind == 4:
            return _constructed(rng)
        if kind == 5:
            path = _PATHS[rng.integers(0, len(_PATHS))]
            path = path if rng.random() < 0.3 else str(folder / path)
            slam.save(path)
            return f"saved: {type(Slam.load(path)).__name__}"
        if kind == 6:
            return _opened(rng, folder)
        voxel = rng.choice([0.2, 0.3, 1e-9, 1e-4, *DOUBLES]) if rng.random() < 0.6 else None
        slam.mesh(OBJECTS[rng.integers(1, len(OBJECTS))] if voxel is None else voxel)
        return "meshed"

    return attempt


def _any_number(rng: np.random.Generator, good: float) -> Any:
    kind = rng.integers(0, 4)
    if kind == 0:
        return OBJECTS[rng.integers(0, len(OBJECTS))]
    return float(rng.choice(DOUBLES)) if kind == 1 else good


def _constructed(rng: np.random.Generator) -> str:
    """Cameras, timings, settings and the `Slam` that has them."""
    camera = Intrinsics(*(_any_number(rng, good) for good in (60.0, 60.0, 39.5, 29.5, 80, 60)))
    timing = SensorTiming(_any_number(rng, 0.01), _any_number(rng, 0.02))
    words = [str(rng.choice(_SETTINGS)) + str(rng.choice(_VALUES)) for _ in range(2)]
    config = Config.from_preset("default" if rng.random() < 0.9 else str(rng.choice(_VALUES)), [*scene.SMALL, *words])
    device = str(rng.choice(["cpu", "cuda", "cuda:0", "cuda:99", "gpu", "", "cpu\n", "cpu:1"]))
    slam = Slam(camera, config, device, decoders=scene.decoders(), timing=timing)
    frame = scene.frames()[0]
    return f"a Slam: {slam.step(frame.rgb, frame.depth).status}"


def _opened(rng: np.random.Generator, folder: Path) -> str:
    """Folders that are none, and maps and decoders that are none."""
    path = str(rng.choice([*_PATHS, str(folder), "/proc/self", "/dev"]))
    kind = rng.integers(0, 3)
    if kind == 0:
        dataset = rng.choice([None, "replica", "tum_rgbd", "scannet", "cofusion", "seven_scenes", "icl", "azure", "x"])
        return f"opened: {len(open_sequence(path, dataset, scene.CAMERA if rng.random() < 0.5 else None))}"
    if kind == 1:
        return f"loaded: {Slam.load(path)}"
    return f"loaded: {load_decoders(path)}"


def _as_tensor(array: np.ndarray, rng: np.random.Generator) -> Any:
    if rng.random() > 0.1:
        return array
    import torch

    return torch.tensor(array, requires_grad=True)
