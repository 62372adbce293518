"""Whether a camera is found again in a map: after its lens was covered, and after it was carried elsewhere.

    python -m tools.benchmarks.relocalization HOUSE/walk --blackouts 50 --kidnappings 50 --set loops.enabled=true

The map is made of all frames; what the camera sees later are its frames with new noise of `NOISE` grey values, so that
no image is that of a keyframe. Frames that were lost when the map was made are no known places. A blackout covers the
lens for 100 black frames while the camera moves on along its path; a kidnapping is the next frame from anywhere else.
A trial is right if a frame of the first `WITHIN` is OK and no frame that is OK is off by more than `OFF`, wrong if one
is, and lost otherwise. Trials follow each other in one session, so what a wrong pose adds to the map stays.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tools.benchmarks.tracking import open_named
from warpslam.cli.common import quiet_warp
from warpslam.config import Config
from warpslam.errors import InputError
from warpslam.frames import FrameStatus
from warpslam.sequences import RgbdSequence
from warpslam.slam import Slam

WITHIN = 10
"""Frames."""
OFF = 0.5
"""[m]"""
COVERED = 100
"""Black frames of a blackout."""
NOISE = 2.0
"""Standard deviation."""
APART = 1.0
"""A kidnapped camera is at least so far away [m]."""


@dataclass(frozen=True)
class Trial:
    """What became of one."""

    kind: str
    """blackout or kidnapping."""
    first: int
    """Frame of the sequence that is seen first afterwards."""
    outcome: str
    """right, wrong or lost."""
    after: int | None
    """Frames until it was found."""
    off: float
    """Largest error of a frame that was OK [m], 0 if none was."""
    seconds: float


def make_map(sequence: RgbdSequence, config: Config, device: str) -> Slam:
    """Track through all frames."""
    slam = Slam(sequence.intrinsics, config, device, timing=sequence.timing)
    for index in range(len(sequence)):
        frame = sequence[index]
        pose = frame.T_world_camera if index == 0 else None
        slam.step(frame.rgb, frame.depth, frame.timestamp, pose, depth_timestamp=frame.depth_timestamp)
    return slam


def attempt(slam: Slam, sequence: RgbdSequence, truth: np.ndarray, kind: str, first: int) -> Trial:
    """The camera sees frames from ``first`` on."""
    start, time_ = time.perf_counter(), slam.history.last_timestamp
    camera = sequence.intrinsics
    black = np.zeros((camera.height, camera.width, 3), np.uint8)
    for _ in range(COVERED if kind == "blackout" else 0):
        time_ += 1 / 30
        slam.step(black, np.ones((camera.height, camera.width), np.float32), time_)
    after, off = None, 0.0
    for count in range(WITHIN):
        index = first + count
        frame, rng = sequence[index], np.random.default_rng([index, len(slam.history)])
        rgb = np.clip(np.rint(frame.rgb + rng.normal(0.0, NOISE, frame.rgb.shape)), 0, 255).astype(np.uint8)
        time_ += 1 / 30
        result = slam.step(rgb, frame.depth, time_)
        if result.status is FrameStatus.OK:
            after = count + 1 if after is None else after
            off = max(off, float(np.linalg.norm(result.T_world_camera[:3, 3] - truth[index][:3, 3])))
    outcome = "lost" if after is None else "wrong" if off > OFF else "right"
    return Trial(kind, first, outcome, after, off, time.perf_counter() - start)


def trials(
    slam: Slam, sequence: RgbdSequence, truth: np.ndarray, blackouts: int, kidnappings: int, seed: int
) -> list[Trial]:
    """All of them, in a row that a seed decides."""
    rng = np.random.default_rng(seed)
    kinds = rng.permutation(["blackout"] * blackouts + ["kidnapping"] * kidnappings).tolist()
    last, here = len(sequence) - WITHIN, 0
    known = np.array([status is FrameStatus.OK for status in slam.trajectory.status[: len(sequence)]])
    found = []
    for kind in kinds:
        far = np.linalg.norm(truth[:, :3, 3] - truth[here][:3, 3], axis=1) > APART
        anywhere = [n for n in range(last) if far[n] and known[n : n + WITHIN].all()]
        ahead = [n for n in anywhere if 0 < n - here <= COVERED] or anywhere
        choice = ahead if kind == "blackout" else anywhere
        if not choice:
            raise InputError("the path is too short to carry the camera elsewhere")
        first = int(rng.choice(choice))
        found.append(attempt(slam, sequence, truth, kind, first))
        here = first + WITHIN - 1
        print(found[-1], file=sys.stderr, flush=True)
    return found


def main(arguments: list[str] | None = None) -> int:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequence", metavar="SEQUENCE", help="folder or scene, +what goes wrong, @frames")
    parser.add_argument("--blackouts", type=int, default=50)
    parser.add_argument("--kidnappings", type=int, default=50)
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="GROUP.FIELD=VALUE")
    parser.add_argument("--cache", type=Path, default=Path("rendered"), metavar="DIR", help="of rendered scenes")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all trials there")
    parser.add_argument("--seed", type=int, default=0, help="of the order and the places")
    parser.add_argument("--device", default="cpu", help="Warp device (cpu)")
    options = parser.parse_args(arguments)
    quiet_warp()
    sequence = open_named(options.sequence, options.cache)
    truth = sequence.ground_truth()
    if truth is None:
        parser.error(f"{options.sequence} has no true poses to compare with")
    config = Config.from_preset(sequence.preset, ["mapping.enabled=false", *options.overrides])
    slam = make_map(sequence, config, options.device)
    lost = sum(status is not FrameStatus.OK for status in slam.trajectory.status)
    print(f"map of {len(sequence)} frames, {len(slam.keyframes)} keyframes, {lost} frames lost", file=sys.stderr)
    slam = Slam.from_state(slam.state(), options.device, localize_only=True)
    slam.forget_pose()
    found = trials(slam, sequence, truth, options.blackouts, options.kidnappings, options.seed)
    print(
        "| | right | wrong | lost | frames until found, median | seconds a trial, median |\n|---|---|---|---|---|---|"
    )
    for kind in ("blackout", "kidnapping"):
        of_kind = [trial for trial in found if trial.kind == kind]
        if of_kind:
            outcomes = Counter(trial.outcome for trial in of_kind)
            after = [trial.after for trial in of_kind if trial.after is not None]
            print(
                f"| {kind}s | {outcomes['right']} | {outcomes['wrong']} | {outcomes['lost']} "
                f"| {np.median(after) if after else float('nan'):.0f} "
                f"| {np.median([trial.seconds for trial in of_kind]):.1f} |"
            )
    if options.json:
        options.json.write_text(json.dumps([vars(trial) for trial in found], indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
