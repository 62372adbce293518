"""A small map that attacks are made on: a few frames of a rendered room, and the settings that make them quick."""

from __future__ import annotations

import hashlib
from functools import cache

from warpslam.camera import Intrinsics
from warpslam.config import Config
from warpslam.field.decoder_files import load_decoders
from warpslam.field.decoders import Decoders
from warpslam.sequences.base import Frame
from warpslam.slam import Slam
from warpslam.synthetic import SyntheticSequence

CAMERA = Intrinsics(60.0, 60.0, 39.5, 29.5, 80, 60)
SMALL = (
    "tracking.pixels=64", "tracking.iterations=3", "tracking.ignore_edge_u=4", "tracking.ignore_edge_v=4",
    "mapping.pixels=100", "mapping.every=2", "mapping.first_iterations=20", "mapping.iterations=10",
    "mapping.coarse_iterations=2", "mapping.refinement_rounds=1", "keyframes.every=2", "grid.max_gigabytes=0.5",
)  # fmt: skip


@cache
def frames(count: int = 6) -> list[Frame]:
    """Of a furnished room."""
    sequence = SyntheticSequence(1, count, intrinsics=CAMERA)
    return [sequence[n] for n in range(count)]


@cache
def decoders() -> Decoders:
    """The package's own."""
    return load_decoders()


def new_slam(*overrides: str) -> Slam:
    """With the small settings."""
    return Slam(CAMERA, Config.from_preset("default", [*SMALL, *overrides]), "cpu", decoders=decoders())


def small_slam(*overrides: str, count: int = 4) -> Slam:
    """After some good frames."""
    slam = new_slam(*overrides)
    for frame in frames()[:count]:
        slam.step(frame.rgb, frame.depth, frame.timestamp, frame.T_world_camera)
    return slam


def map_digest(slam: Slam) -> str:
    """Of the features, and of what the map covers."""
    digest = hashlib.sha256(repr((slam.scene.low.tolist(), slam.scene.high.tolist())).encode())
    for grid in slam.scene.grids.values():
        digest.update(grid.features.numpy().tobytes())
    return digest.hexdigest()
