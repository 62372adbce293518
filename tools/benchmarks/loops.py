"""What closing of loops does to trajectories, and what it believes.

    python -m tools.benchmarks.loops HOUSE/loop+kinect HOUSE/loop_noise DATA/tum_fr3_cabinet --seeds 3
    python -m tools.benchmarks.loops HOUSE/loop --focal 1.01
    python -m tools.benchmarks.loops corridor posters --cache rendered --twin 8

Each sequence is tracked twice, without and with loops. Sequences are named as in `tools.benchmarks.tracking`; with
several seeds the noise of "+kinect" is another one each time, and sequences without noise run once.

- ATE [cm]: RMSE and largest error of all frames at the end, after rigid alignment.
- end gap: error of the last frame as seen from the first one [cm], [degrees].
- pairs: keyframes that were compared; loops: those that hold; false: loops that passed all gates but are off by more
  than 10 cm or 5 degrees (pairs whose true poses are known).
- ms a keyframe: of all that loops add to it where the graph is not solved, median and 99 %; seconds of the dearest one
  where it is.
- ``--focal``: the camera is believed to have a focal length that is so many times the true one, so that it drifts.
- ``--twin``: the sequence is seen twice, the second time in a room alike so many metres away, to which the camera is
  carried: every loop between the two is false.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from tools.benchmarks.tracking import FALSE_STEP, FALSE_TURN, open_named
from warpslam.cli.common import quiet_warp
from warpslam.config import Config
from warpslam.errors import InputError
from warpslam.evaluation import ate
from warpslam.loops.verification import Gate
from warpslam.poses import inverse, motion_between
from warpslam.sequences import RgbdSequence
from warpslam.slam import Slam
from warpslam.synthetic.attacks import kinect_noise


@dataclass(frozen=True)
class Row:
    """One sequence, with loops or without."""

    ate_cm: float
    ate_max_cm: float
    gap_cm: float
    gap_degrees: float
    lost: int
    keyframes: int
    pairs: int = 0
    refused: dict[str, int] | None = None
    """Pairs by the gate that they failed at."""
    loops: int = 0
    false: int = 0
    moved_cm: float = 0.0
    """Largest distance that a keyframe moved at once."""
    look_ms: tuple[float, float] = (0.0, 0.0)
    solve_s: float = 0.0


def measure(sequence: RgbdSequence, truth: np.ndarray, config: Config, focal: float, twin: float, device: str) -> Row:
    """Track all frames."""
    camera = sequence.intrinsics
    camera = replace(camera, fx=focal * camera.fx, fy=focal * camera.fy)
    slam = Slam(camera, config, device, timing=sequence.timing)
    looks: list[tuple[float, bool]] = []
    if slam.loops is not None:
        _time(slam, looks)
    poses, last = [], 0.0
    offset = np.eye(4)
    for visit in range(2 if twin else 1):
        for index in range(len(sequence)):
            frame = sequence[index]
            given = frame.T_world_camera if index == 0 else None
            if visit and not index:
                offset[0, 3], last = twin, slam.history.last_timestamp
                slam.forget_pose()
                given = offset @ truth[0]
            # A second visit begins a minute later.
            late = last - sequence[0].timestamp + 60.0 if visit else 0.0
            depth_time = None if frame.depth_timestamp is None else frame.depth_timestamp + late
            slam.step(frame.rgb, frame.depth, frame.timestamp + late, given, depth_timestamp=depth_time)
        poses.append(offset @ truth)
    truth, found = np.concatenate(poses), np.array(slam.trajectory.poses)
    known = np.flatnonzero(np.isfinite(truth).all(axis=(1, 2)))
    first, end = known[0], known[-1]
    gap = motion_between(inverse(truth[first]) @ truth[end], inverse(found[first]) @ found[end])
    error = ate(found, truth)
    lost = sum(str(status) != "OK" for status in slam.trajectory.status)
    row = Row(100 * error.rmse, 100 * error.max, 100 * float(gap[0]), float(gap[1]), lost, len(slam.keyframes))
    if slam.loops is None:
        return row
    account = slam.loops.account()
    calm = [1e3 * seconds for seconds, solved in looks if not solved] or [0.0]
    gates = [entry["gate"] for entry in slam.loops.log]
    return replace(
        row,
        pairs=account["candidates"],
        refused={str(gate): gates.count(str(gate)) for gate in Gate if gate is not Gate.PASSED},
        loops=len(account["edges"]),
        false=sum(_is_false(entry, truth) for entry in slam.loops.log),
        moved_cm=100 * account["largest_move_m"],
        look_ms=(float(np.median(calm)), float(np.quantile(calm, 0.99))),
        solve_s=max((seconds for seconds, solved in looks if solved), default=0.0),
    )


def _time(slam: Slam, looks: list[tuple[float, bool]]) -> None:
    """Note CPU seconds of each call, and whether it solved the graph."""
    assert slam.loops is not None
    loops, original = slam.loops, slam.loops.look

    def look(history):
        start, solved = time.process_time(), loops.figures.solved
        try:
            return original(history)
        finally:
            looks.append((time.process_time() - start, loops.figures.solved > solved))

    loops.look = look  # type: ignore[method-assign]


def _is_false(entry: dict, truth: np.ndarray) -> bool:
    i, j = entry["frames"]
    if entry["gate"] != str(Gate.PASSED) or not np.isfinite(truth[[i, j]]).all():
        return False
    step, turn = motion_between(inverse(truth[i]) @ truth[j], entry["T"])
    return bool(step > FALSE_STEP or turn > FALSE_TURN)


def table(rows: dict[str, tuple[Row, Row]]) -> str:
    """As Markdown."""
    lines = [
        "| sequence | ATE (max) without [cm] | with | end gap without | with | keyframes | pairs | loops | false "
        "| moved [cm] | ms a keyframe, median / 99 % | solving [s] |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, (a, b) in rows.items():
        lines.append(
            f"| {name} | {a.ate_cm:.2f} ({a.ate_max_cm:.2f}) | {b.ate_cm:.2f} ({b.ate_max_cm:.2f}) "
            f"| {a.gap_cm:.2f} cm, {a.gap_degrees:.2f} | {b.gap_cm:.2f} cm, {b.gap_degrees:.2f} | {b.keyframes} "
            f"| {b.pairs} | {b.loops} | {b.false} | {b.moved_cm:.1f} | {b.look_ms[0]:.0f} / {b.look_ms[1]:.0f} "
            f"| {b.solve_s:.2f} |"
        )
    return "\n".join(lines)


def _seeded(text: str, cache: Path, seeds: int) -> dict[str, RgbdSequence]:
    """The sequence, or one a seed where it has noise of its own."""
    name, _, part = text.partition("@")
    if not name.endswith("+kinect") or Path(name).is_dir():
        return {text: open_named(text, cache)}
    plain = open_named(name.removesuffix("+kinect") + (f"@{part}" if part else ""), cache)
    return {f"{text} {seed}": kinect_noise(plain, seed=seed) for seed in range(seeds)}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequences", nargs="+", metavar="SEQUENCE", help="folder or scene, +what goes wrong, @frames")
    parser.add_argument("--seeds", type=int, default=1, help="of noise (1)")
    parser.add_argument("--focal", type=float, default=1.0, help="believed focal length over the true one (1)")
    parser.add_argument("--twin", type=float, default=0.0, metavar="METRES", help="a room alike so far away")
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="GROUP.FIELD=VALUE")
    parser.add_argument("--cache", type=Path, default=Path("rendered"), metavar="DIR", help="of rendered scenes")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures there")
    parser.add_argument("--device", default="cpu", help="Warp device (cpu)")
    options = parser.parse_args(arguments)
    quiet_warp()
    rows: dict[str, tuple[Row, Row]] = {}
    for text in options.sequences:
        for name, sequence in _seeded(text, options.cache, options.seeds).items():
            truth = sequence.ground_truth()
            if truth is None:
                raise InputError(f"{name} has no true poses to compare with")
            both = []
            for enabled in (False, True):
                overrides = ["mapping.enabled=false", *options.overrides, f"loops.enabled={str(enabled).lower()}"]
                config = Config.from_preset(sequence.preset, overrides)
                both.append(measure(sequence, truth, config, options.focal, options.twin, options.device))
            rows[name] = both[0], both[1]
            print(name, asdict(both[1]), file=sys.stderr, flush=True)
    print(table(rows))
    if options.json:
        options.json.write_text(json.dumps({k: [asdict(row) for row in v] for k, v in rows.items()}, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
