r"""How well, and at what price, the camera is tracked through any number of sequences, one after another.

    python -m tools.benchmarks.tracking DATA/tum_fr1_xyz HOUSE/house@0:240:2 corridor cabinet+half posters+frozen \
        --cache rendered --set mapping.enabled=false --json tracking.json

A sequence is a folder or a rendered scene (corridor, cabinet, posters; made once into the cache folder), then what goes
wrong in it after each "+" (see `warpslam render-room sequence --help`), then its frames after "@".

- ATE [cm]: RMSE and largest error of all frames after rigid alignment; "online" with the poses that `Slam.step`
  returned, "final" with those after `Slam.finish`. A frame that is not OK counts with the pose it was given.
- lost: frames that are not OK.
- false OK: frames that are OK, but whose motion since the OK frame before them is off by more than 10 cm or 5 degrees.
- within 2 sigma: share of frames whose shift against their keyframe is off by less than twice `FrameResult.sigma`.
- CPU ms a frame: process time of `Slam.step`, all threads together, without the first frame; of mapping, too, where
  that is on. Wall: all steps and `Slam.finish`, without loading images.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from warpslam.camera import Intrinsics
from warpslam.cli.common import parse_frames, quiet_warp
from warpslam.config import Config
from warpslam.errors import InputError, WarpSlamError
from warpslam.evaluation import ate
from warpslam.frames import FrameStatus
from warpslam.pipeline.methods import Method
from warpslam.poses import rotation_angles
from warpslam.sequences import RgbdSequence, open_sequence
from warpslam.slam import Slam
from warpslam.synthetic import HARD_SCENES, AlteredSequence, altered, make_sequence, write_replica

FALSE_STEP, FALSE_TURN = 0.10, 5.0  # [m], [deg]
CAMERA = Intrinsics(525.0, 525.0, 319.5, 239.5, 640, 480)


@dataclass(frozen=True)
class Drive:
    """What came of one sequence, frame by frame."""

    online: np.ndarray
    """Poses as `Slam.step` returned them, shape (N, 4, 4)."""
    final: np.ndarray
    """Poses after the end, shape (N, 4, 4)."""
    status: list[str]
    """Of each frame."""
    cpu_seconds: np.ndarray
    """Process time of each step, shape (N,)."""
    against: list[int | None]
    """Frame of the keyframe that each pose is against."""
    since: np.ndarray
    """Each pose in the axes of that keyframe as it then was, shape (N, 4, 4); NaN where there is none."""
    sigma: np.ndarray
    """Standard deviation of the shift since that keyframe [m], shape (N,); NaN where there is none."""
    wall_seconds: float
    """All steps and the end."""


@dataclass(frozen=True)
class Figures:
    """A row of the table."""

    frames: int
    ate_online_cm: float
    ate_online_max_cm: float
    ate_final_cm: float
    ate_final_max_cm: float
    lost: int
    false_ok: list[int]
    """Numbers of the frames."""
    within_two_sigma: float | None
    """None where no pose has a covariance."""
    cpu_ms_median: float
    cpu_ms_99: float
    wall_seconds: float


def drive(slam: Method, sequence: RgbdSequence) -> Drive:
    """Run all frames; the first one starts at its true pose where that is known."""
    online, status, cpu, against, since, sigma, wall = [], [], [], [], [], [], 0.0
    for index in range(len(sequence)):
        frame = sequence[index]
        pose = frame.T_world_camera if index == 0 else None
        start, used = time.perf_counter(), time.process_time()
        result = slam.step(frame.rgb, frame.depth, frame.timestamp, pose, depth_timestamp=frame.depth_timestamp)
        cpu.append(time.process_time() - used)
        wall += time.perf_counter() - start
        online.append(result.T_world_camera)
        status.append(str(result.status))
        reference = result.reference
        against.append(reference)
        sigma.append(result.sigma[0])
        known = np.full((4, 4), np.nan) if reference is None else slam.trajectory.poses[reference]
        since.append(np.linalg.inv(known) @ result.T_world_camera)
    start = time.perf_counter()
    slam.finish()
    wall += time.perf_counter() - start
    final = np.array(slam.trajectory.poses)
    return Drive(np.array(online), final, status, np.array(cpu), against, np.array(since), np.array(sigma), wall)


def judge(driven: Drive, truth: np.ndarray) -> Figures:
    """Compare with the truth, shape (N, 4, 4), NaN where unknown.

    Raises:
        InputError: No true pose is known.
    """
    online, final = ate(driven.online, truth), ate(driven.final, truth)
    milliseconds = 1e3 * (driven.cpu_seconds[1:] if len(driven.cpu_seconds) > 1 else driven.cpu_seconds)
    return Figures(
        len(truth),
        100 * online.rmse,
        100 * online.max,
        100 * final.rmse,
        100 * final.max,
        sum(status != FrameStatus.OK for status in driven.status),
        false_ok(driven.online, driven.status, truth),
        within_two_sigma(driven, truth),
        float(np.median(milliseconds)),
        float(np.quantile(milliseconds, 0.99)),
        driven.wall_seconds,
    )


def false_ok(poses: np.ndarray, status: Sequence[str], truth: np.ndarray) -> list[int]:
    """Frames that are OK, but off by more than 10 cm or 5 degrees against the OK frame before them.

    Args:
        poses: Estimated poses, shape (N, 4, 4).
        status: Of each frame.
        truth: True poses, shape (N, 4, 4); frames where it is unknown are left out.
    """
    usable = np.array([one == FrameStatus.OK for one in status]) & np.isfinite(truth).all(axis=(1, 2))
    here = np.flatnonzero(usable)
    before, now = here[:-1], here[1:]
    moved, expected = (np.linalg.inv(T[before]) @ T[now] for T in (poses, truth))
    error = np.linalg.inv(expected) @ moved
    off = np.linalg.norm(error[:, :3, 3], axis=1) > FALSE_STEP
    off |= np.degrees(rotation_angles(error[:, :3, :3])) > FALSE_TURN
    return now[off].tolist()


def within_two_sigma(driven: Drive, truth: np.ndarray) -> float | None:
    """Share of frames whose shift against their keyframe is off by less than two standard deviations, None if none has
    any; ``truth`` as for `false_ok`.
    """
    good = []
    for now, before in enumerate(driven.against):
        if before is None or before >= now or driven.status[now] != FrameStatus.OK or not np.isfinite(truth[now]).all():
            continue
        expected = np.linalg.inv(truth[before]) @ truth[now]
        off = np.linalg.norm((np.linalg.inv(expected) @ driven.since[now])[:3, 3])
        if np.isfinite(off):
            good.append(off < 2.0 * driven.sigma[now])
    return float(np.mean(good)) if good else None


def open_named(text: str, cache: Path, frames: slice = slice(None), *, published: bool = False) -> RgbdSequence:
    """A sequence by what the command line says of it; a scene that is not in the cache yet is rendered into it.

    Args:
        text: Folder or scene, "+" what goes wrong, "@" frames.
        cache: Folder of the scenes.
        frames: Frames where ``text`` names none.
        published: Frames of the size that the paper's code takes.

    Raises:
        WarpSlamError: There is no such folder, scene, alteration or frame.
    """
    name, _, part = text.partition("@")
    # A folder's own name may hold a "+".
    base, *alterations = [name] if Path(name).is_dir() else name.split("+")
    if base in HARD_SCENES:
        folder = cache / base
        if not (folder / "complete").exists():
            write_replica(make_sequence(base, intrinsics=CAMERA), folder)
            (folder / "complete").touch()
        sequence = open_sequence(folder)
        sequence.preset = "default"  # Replica's leaves out the borders of its images
    else:
        sequence = open_sequence(base)
    if published:
        sequence = sequence.as_published()
    if part:
        frames = parse_frames(part)
    if frames != slice(None):
        chosen = range(len(sequence))[frames]
        if not chosen:
            raise InputError(f"{text}: no frame of {len(sequence)} is chosen")
        sequence = AlteredSequence(sequence, "part", images=chosen)
    return altered(sequence, alterations)


def table(rows: dict[str, Figures | str]) -> str:
    """The figures of each sequence, or why there are none, as a Markdown table."""
    lines = [
        "| sequence | frames | ATE online (max) [cm] | ATE final (max) [cm] | lost | false OK | within 2 sigma "
        "| CPU ms, median / 99 % | wall [s] |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name, row in rows.items():
        if isinstance(row, str):
            lines.append(f"| {name} | {row} | | | | | | | |")
            continue
        lines.append(
            f"| {name} | {row.frames} | {row.ate_online_cm:.2f} ({row.ate_online_max_cm:.2f}) "
            f"| {row.ate_final_cm:.2f} ({row.ate_final_max_cm:.2f}) | {row.lost} | {len(row.false_ok)} "
            f"| {_percent(row.within_two_sigma)} | {row.cpu_ms_median:.0f} / {row.cpu_ms_99:.0f} "
            f"| {row.wall_seconds:.1f} |"
        )
    return "\n".join(lines)


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{share:.0%}"


def measure(text: str, options: argparse.Namespace) -> Figures:
    """One row."""
    sequence = open_named(text, options.cache, options.frames)
    truth = sequence.ground_truth()
    if truth is None:
        raise InputError(f"{text} has no true poses to compare with")
    overrides = [*options.overrides]
    if options.optimizer:
        overrides.append(f"tracking.optimizer={options.optimizer}")
    config = Config.from_preset(options.preset or sequence.preset, overrides)
    if config.published_images:
        sequence = open_named(text, options.cache, options.frames, published=True)
    slam = Slam(sequence.intrinsics, config, options.device, options.seed, timing=sequence.timing)
    return judge(drive(slam, sequence), truth)


def main(arguments: list[str] | None = None) -> int:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequences", nargs="+", metavar="SEQUENCE", help="folder or scene, +what goes wrong, @frames")
    parser.add_argument("--optimizer", help="tracking.optimizer (by default the preset's)")
    parser.add_argument("--frames", type=parse_frames, default=slice(None), metavar="A:B:STEP", help="of all sequences")
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="GROUP.FIELD=VALUE")
    parser.add_argument("--preset", help="settings for all sequences (by default each one's own)")
    parser.add_argument("--cache", type=Path, default=Path("rendered"), metavar="DIR", help="of rendered scenes")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures there")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device", default="cpu", help="Warp device (cpu)")
    options = parser.parse_args(arguments)
    quiet_warp()
    rows: dict[str, Figures | str] = {}
    for text in options.sequences:
        try:
            rows[text] = measure(text, options)
        except WarpSlamError as error:
            rows[text] = str(error)
        row = rows[text]
        print(f"{text}: {row if isinstance(row, str) else f'{row.wall_seconds:.1f} s'}", file=sys.stderr, flush=True)
        if options.json:
            record = {name: {"error": row} if isinstance(row, str) else asdict(row) for name, row in rows.items()}
            options.json.write_text(json.dumps(record, indent=1) + "\n")
    print(table(rows))
    return 1 if any(isinstance(row, str) for row in rows.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
