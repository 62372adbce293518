"""A loop over the arrays of one's own camera: depth in millimetres, times, and frames that are no use.

python -m warpslam.examples.own_camera [FRAMES [SETTING=VALUE ...]]
"""

import sys
from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np

import warpslam
from warpslam.examples.first_steps import CAMERA, SETTINGS
from warpslam.synthetic import SyntheticSequence


def frames_of_my_camera(count: int) -> Iterator[tuple[np.ndarray, np.ndarray, float]]:
    """What a driver gives: colour uint8 (H, W, 3), depth uint16 (H, W) in millimetres, time [s]; one frame is black."""
    for frame in SyntheticSequence(room_seed=0, frame_count=count, intrinsics=CAMERA):
        light = frame.index != count // 2
        yield light * frame.rgb, (1000 * light * frame.depth).astype(np.uint16), frame.timestamp


def main(frame_count: int = 20, *, settings: Sequence[str] = SETTINGS) -> warpslam.Slam:
    """Track and map; a frame that is no use is told, and changes nothing."""
    slam = warpslam.Slam(CAMERA, warpslam.Config.from_preset("default", list(settings)))
    statuses: Counter[str] = Counter()
    for rgb, depth, time in frames_of_my_camera(frame_count):
        result = slam.step(rgb, depth, time, depth_scale=1000)
        statuses[str(result.status)] += 1
        if result.status != "OK":  # LOST: the camera was not found; SKIPPED: nothing usable in the images
            print(f"frame {result.index} at {time:.2f} s is {result.status}: {result.message}")
    slam.finish()
    print(f"{dict(statuses)}; the map takes {slam.map_bytes / 1e6:.1f} MB and has {len(slam.keyframes)} keyframes")
    return slam


if __name__ == "__main__":
    main(*map(int, sys.argv[1:2]), settings=[*SETTINGS, *sys.argv[2:]])
