"""A sequence in, trajectory and mesh out.

    python -m warpslam.examples.first_steps [FRAMES [SETTING=VALUE ...]]

With data of your own: ``sequence = warpslam.open_sequence("path/to/folder")``.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import warpslam
from warpslam.synthetic import SyntheticSequence

CAMERA = warpslam.Intrinsics(fx=125.0, fy=125.0, cx=79.5, cy=59.5, width=160, height=120)
SETTINGS = (  # for a minute of two cores; leave them out for the best that there is
    "mapping.first_iterations=150",
    "mapping.iterations=20",
    "mapping.refinement_rounds=2",
    "tracking.ignore_edge_u=5",
    "tracking.ignore_edge_v=5",
)


def main(frame_count: int = 20, *, settings: Sequence[str] = SETTINGS, output: Path = Path("first_steps.ply")) -> float:
    """Track, map and write the mesh; returns the error of the trajectory [m]."""
    sequence = SyntheticSequence(room_seed=0, frame_count=frame_count, intrinsics=CAMERA)
    config = warpslam.Config.from_preset(sequence.preset, list(settings))
    slam = warpslam.Slam(sequence.intrinsics, config, timing=sequence.timing)
    for frame in sequence:
        result = slam.step(frame.rgb, frame.depth, frame.timestamp, depth_timestamp=frame.depth_timestamp)
        print(f"frame {result.index}: {result.status}, camera at {result.T_world_camera[:3, 3].round(3)} m")
    slam.finish()
    error = warpslam.ate(slam.trajectory.poses, sequence.ground_truth()).rmse
    mesh = slam.mesh(voxel=0.04)
    mesh.export(output)
    print(f"ATE RMSE {100 * error:.2f} cm; {output}: {len(mesh.vertices)} vertices, {len(mesh.faces)} faces")
    return error


if __name__ == "__main__":
    main(*map(int, sys.argv[1:2]), settings=[*SETTINGS, *sys.argv[2:]])
