"""A map from poses that are known, of a robot arm or another program, and a view of it.

python -m warpslam.examples.known_poses [FRAMES [SETTING=VALUE ...]]
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

import warpslam
from warpslam.examples.first_steps import CAMERA, SETTINGS
from warpslam.synthetic import SyntheticSequence


def main(frame_count: int = 10, *, settings: Sequence[str] = SETTINGS, output: Path = Path("known_poses.png")) -> float:
    """Map, and write the last frame beside its rendering; returns the median error of the rendered depth [m]."""
    sequence = SyntheticSequence(room_seed=0, frame_count=frame_count, intrinsics=CAMERA)
    settings = [*settings, "tracking.use_given_poses=true"]
    slam = warpslam.Slam(CAMERA, warpslam.Config.from_preset("default", settings))
    for frame in sequence:
        # Camera to world, 4x4, axes of OpenCV: x right, y down, z forward.
        slam.step(frame.rgb, frame.depth, frame.timestamp, frame.T_world_camera)
    slam.finish()

    last = sequence[frame_count - 1]
    view = slam.render(sequence.ground_truth()[-1], depth=last.depth)
    is_known = last.depth > 0
    error = float(np.median(np.abs(view.depth - last.depth)[is_known]))
    Image.fromarray(np.hstack([last.rgb, np.uint8(255 * np.clip(view.rgb, 0, 1))])).save(output)
    print(f"{output}: input beside rendering; rendered depth is {1000 * error:.1f} mm off in the median")
    return error


if __name__ == "__main__":
    main(*map(int, sys.argv[1:2]), settings=[*SETTINGS, *sys.argv[2:]])
