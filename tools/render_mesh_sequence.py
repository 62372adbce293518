"""Render a smooth RGB-D path around a point of a mesh, or through several, and write it as a Replica-layout folder.

Example: python tools/render_mesh_sequence.py --mesh scene.obj --frames 120 --out house --size 640x480
"""

from __future__ import annotations

import argparse
import sys
import time

import numpy as np

from warpslam.camera import Intrinsics
from warpslam.errors import InputError, WarpSlamError
from warpslam.synthetic import MeshRenderer, RenderedSequence, hand_held, load_mesh, orbit, walk, write_replica

# The defaults look at the dining table of the furnished test house, from the kitchen's side of the room.
ROOM = (6.6, 1.1)  # [m] point to look at, seen from above
TARGET_HEIGHT = 0.65  # [m]
EYE_HEIGHT = 1.4  # [m]
RADIUS = 2.3  # [m] horizontal distance from the point to the camera
START_ANGLE = -130.0  # [deg] direction from the point to the first camera
STEP = 0.013  # [m] per frame


def pair(separator: str, kind: type):
    """Parser of two values of one type, for argparse."""

    def parse(text: str) -> tuple:
        values = tuple(kind(value) for value in text.split(separator))
        if len(values) != 2:
            raise ValueError(text)
        return values

    parse.__name__ = f"pair like 1{separator}2"
    return parse


def points(text: str) -> np.ndarray:
    """Parser of points, for argparse: shape (n, 2)."""
    return np.array([pair(",", float)(point) for point in text.split()])


def parse_arguments(arguments: list[str] | None = None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--mesh", required=True, help="mesh file, metres, z up; materials and textures are used")
    parser.add_argument("--out", required=True, help="folder to write; must not hold frames yet")
    parser.add_argument("--frames", type=int, help="number of frames (120; hand-held: to the end of the path)")
    parser.add_argument("--size", type=pair("x", int), default=(640, 480), metavar="WxH", help="image size [px]")
    parser.add_argument("--focal", type=float, help="focal length [px]; default 525 at a width of 640 px")
    parser.add_argument("--room", type=pair(",", float), default=ROOM, metavar="X,Y", help="point to look at [m]")
    parser.add_argument("--target-height", type=float, default=TARGET_HEIGHT, help="height of that point [m]")
    parser.add_argument("--eye-height", type=float, default=EYE_HEIGHT, help="height of the camera [m]")
    parser.add_argument("--radius", type=float, default=RADIUS, help="horizontal distance to the point [m]")
    parser.add_argument("--start", type=float, default=START_ANGLE, help="direction of the first camera [deg]")
    parser.add_argument("--step", type=float, default=STEP, help="distance between frames [m]; negative = clockwise")
    parser.add_argument("--through", type=points, metavar='"X,Y X,Y ..."', help="walk through these points [m] instead")
    parser.add_argument("--hand-held", action="store_true", help="walk so: 8 cm, 4 deg a frame, pauses, quick turns")
    parser.add_argument("--noise", action="store_true", help="depth of a Kinect: noise, steps, holes")
    parser.add_argument("--depth-range", type=float, help="depth beyond is missing [m], colour is seen")
    parser.add_argument("--exposure", type=float, default=0.0, help="motion blur: shutter time over frame time")
    parser.add_argument("--max-depth", type=float, default=100.0, help="nothing is seen beyond [m]")
    parser.add_argument("--seed", type=int, default=0, help="seed of the hand's sway and of the noise")
    parser.add_argument("--device", help="Warp device that renders")
    return parser.parse_args(arguments)


def make_sequence(options: argparse.Namespace) -> RenderedSequence:
    """Load the mesh and lay the path."""
    width, height = options.size
    focal = options.focal or 525.0 * width / 640.0
    intrinsics = Intrinsics(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)
    frame_count = options.frames or 120
    if options.hand_held:
        if options.through is None:
            raise InputError("--hand-held walks along the points of --through, which is missing")
        poses = hand_held(options.through, seed=options.seed, eye_height=options.eye_height, max_frames=options.frames)
    elif options.through is not None:
        poses = walk(options.through, frame_count, eye_height=options.eye_height)
    else:
        poses = orbit(
            np.array([*options.room, options.eye_height]),
            (options.radius, options.radius),
            frame_count,
            turn=options.step / options.radius,
            start=np.radians(options.start),
            aim=options.target_height,
            phase=np.random.default_rng(options.seed).uniform(0, 2 * np.pi),
        )
    renderer = MeshRenderer(load_mesh(options.mesh), intrinsics, device=options.device, max_depth=options.max_depth)
    noise_seed = options.seed if options.noise else None
    return RenderedSequence(
        "mesh",
        renderer,
        poses,
        noise_seed=noise_seed,
        exposure=options.exposure,
        depth_range=options.depth_range,
    )


def main(arguments: list[str] | None = None) -> int:
    """Render and report what the frames look like."""
    options = parse_arguments(arguments)
    start = time.perf_counter()
    try:
        sequence = make_sequence(options)
        write_replica(sequence, options.out)
        depth = np.stack([sequence[index].depth for index in range(0, len(sequence), 10)])
    except WarpSlamError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    poses = sequence.ground_truth()
    moved = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    relative = poses[:-1, :3, :3].transpose(0, 2, 1) @ poses[1:, :3, :3]
    turned = np.degrees(np.arccos(np.clip((np.trace(relative, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    print(f"wrote {len(sequence)} frames to {options.out} in {time.perf_counter() - start:.1f} s")
    if len(sequence) > 1:
        print(f"per frame: {100 * moved.mean():.2f} cm (max {100 * moved.max():.2f}), at most {turned.max():.2f} deg")
    if (depth > 0).any():
        quantiles = np.percentile(depth[depth > 0], [1, 50, 99])
        print("depth 1 %, 50 %, 99 %: {:.2f}, {:.2f}, {:.2f} m; ".format(*quantiles), end="")
    print(f"missing {100 * (depth == 0).mean():.2f} %")
    return 0


if __name__ == "__main__":
    sys.exit(main())
