"""A saved map, in which a camera finds its place and is followed; the map stays as it is.

python -m warpslam.examples.localize_in_a_map [FRAMES [SETTING=VALUE ...]]
"""

import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import warpslam
from warpslam.examples.first_steps import CAMERA, SETTINGS
from warpslam.synthetic import SyntheticSequence


def main(frame_count: int = 14, *, settings: Sequence[str] = SETTINGS) -> float:
    """Map, save, load, and localize the frames backwards; returns the largest error of a position that is OK [m]."""
    sequence = SyntheticSequence(room_seed=0, frame_count=frame_count, intrinsics=CAMERA)
    slam = warpslam.Slam(CAMERA, warpslam.Config.from_preset("default", list(settings)))
    for frame in sequence:
        # The first pose is where the map's world begins; the others are tracked.
        slam.step(frame.rgb, frame.depth, frame.timestamp, frame.T_world_camera if frame.index == 0 else None)
    slam.finish()
    with TemporaryDirectory() as folder:
        path = Path(folder) / "map.safetensors"
        slam.save(path)
        localizer = warpslam.Slam.load(path, localize_only=True)
    errors = []
    for number in range(frame_count - 1, -1, -1):
        result = localizer.step(sequence[number].rgb, sequence[number].depth)
        if result.status == "LOST":  # a place that was found is believed when a few frames have confirmed it
            print(f"frame {number}: LOST, {result.message}")
            continue
        error = np.linalg.norm(result.T_world_camera[:3, 3] - sequence.ground_truth()[number, :3, 3])
        errors.append(float(error))
        print(f"frame {number}: {result.status}, {100 * error:.1f} cm off")
    return max(errors, default=np.inf)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:2]), settings=[*SETTINGS, *sys.argv[2:]])
