"""A long run of small frames, `CHUNK` a try: memory, files, threads and the time of a frame stay what they were."""

from __future__ import annotations

import time

import numpy as np
import psutil

from tools.attacks.isolation import Attempt
from warpslam.camera import Intrinsics
from warpslam.config import Config
from warpslam.slam import Slam
from warpslam.synthetic import SyntheticSequence

CHUNK = 100
_FRAMES = 60
_PATH = 400  # frames of the path that these are the first of
_WARM = 4  # tries after which caches are filled and the map is grown
_BYTES_A_FRAME = 40_000  # a keyframe's compact image and its rows, over the frames between two
_CAMERA = Intrinsics(30.0, 30.0, 19.5, 14.5, 40, 30)
_SETTINGS = (
    "tracking.pixels=64", "tracking.ignore_edge_u=2", "tracking.ignore_edge_v=2", "mapping.pixels=64",
    "mapping.every=50", "mapping.first_iterations=20", "mapping.iterations=4", "mapping.coarse_iterations=1",
    "mapping.active_share=0", "direct.sure_correlation=0.3", "direct.sure_agreement=0.3", "direct.sure_cost=1000",
    "direct.sure_shift=1000",
)  # fmt: skip
"""A frame in milliseconds: at this size most poses would be doubted, and looked for everywhere."""


def prepare(name: str) -> Attempt:
    """There and back through a rendered room, for as long as tries are asked for."""
    sequence = SyntheticSequence(1, _PATH, intrinsics=_CAMERA)
    frames = [sequence[n] for n in range(_FRAMES)]
    slam = Slam(_CAMERA, Config.from_preset("default", list(_SETTINGS)), "cpu")
    process = psutil.Process()
    begin: dict[str, float] = {}
    times: list[float] = []
    rng = np.random.default_rng(0)

    def attempt(_: np.random.Generator) -> str:
        start = time.process_time()
        for _n in range(CHUNK):
            count = len(slam.history)
            place = count % (2 * _FRAMES - 2)
            frame = frames[place if place < _FRAMES else 2 * _FRAMES - 2 - place]
            noisy = np.clip(frame.rgb + rng.normal(scale=1.0, size=frame.rgb.shape), 0, 255).astype(np.uint8)
            slam.step(noisy, frame.depth, count / 30, frame.T_world_camera)
        times.append((time.process_time() - start) / CHUNK)
        now = {
            "bytes": float(process.memory_info().rss), "files": float(process.num_fds()),
            "threads": float(process.num_threads()), "frames": float(len(slam.history)),
        }  # fmt: skip
        if len(times) == _WARM:
            begin.update(now)
        if len(times) > _WARM:
            grown = now["bytes"] - begin["bytes"]
            allowed = 6e7 + _BYTES_A_FRAME * (now["frames"] - begin["frames"])
            assert grown <= allowed, f"{grown / 1e6:.0f} MB more after {now['frames']:.0f} frames"
            assert now["files"] <= begin["files"] + 2, f"{now['files']:.0f} files are open"
            assert now["threads"] <= begin["threads"] + 2, f"{now['threads']:.0f} threads"
        if len(times) >= 3 * _WARM:
            early, late = np.median(times[2:_WARM]), np.median(times[-_WARM:])
            assert late <= 2.5 * early, f"{1e3 * late:.0f} ms a frame after {1e3 * early:.0f} ms"
        return (
            f"{CHUNK} frames; {now['frames']:.0f} frames: {1e3 * times[-1]:.1f} ms a frame, {now['bytes'] / 1e6:.0f} "
            f"MB, {now['files']:.0f} files, {now['threads']:.0f} threads, {len(slam.keyframes)} keyframes"
        )

    return attempt
