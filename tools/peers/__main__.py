r"""warpslam side by side with other programs on one folder of RGB-D frames, each in a process of its own, one by one.

    python -m tools.peers DATA/tum_fr1_xyz --frames 0:100 --out runs/peers/fr1_xyz
    python -m tools.peers HOUSE/house --truth-mesh scene.obj --systems small-gicp open3d-slam warpslam

All get the frames of our reader (undistorted, cropped) and are judged alike: ATE RMSE and largest error after rigid
alignment over the frames that have a pose, those called lost included; lost frames; CPU time a frame of the whole
process, loading and mesh included, and of tracking alone; with a true surface, the mesh, culled as in
`warpslam.evaluation`.
Peers are extras: pip install -e ".[peers]". One that is not installed gets a row that says so. Rows marked "cited" are
figures of the NICE-SLAM paper on other sequences, of programs that need CUDA, or weights that are not to be had.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from tools.peers.recording import Recording
from tools.peers.systems import CITED, PEERS
from warpslam.errors import WarpSlamError
from warpslam.evaluation import ate, evaluate_mesh, load_mesh
from warpslam.storage.tum import associate, read_tum

OURS = "warpslam"


@dataclass
class Row:
    """One program on the folder."""

    title: str
    problem: str = ""
    """Why there are no figures."""
    ate_cm: float | None = None
    ate_max_cm: float | None = None
    lost: int | None = None
    without_pose: int = 0
    """Frames for which it gives no pose; they are not in the ATE."""
    cpu_seconds_a_frame: float | None = None
    tracking_cpu_seconds_a_frame: float | None = None
    wall_seconds: float | None = None
    peak_mib: float | None = None
    mesh: dict[str, float] = field(default_factory=dict)
    """Accuracy and completion [cm], and completion ratio within 5 cm [%]."""
    remarks: list[str] = field(default_factory=list)


def command_of(system: str, options: argparse.Namespace, out: Path) -> list[str]:
    """The process that runs a system."""
    frames = ["--frames", options.frames] if options.frames else []
    if system == OURS:
        settings = ["--set", *options.overrides] if options.overrides else []
        command = [sys.executable, "-m", "warpslam", "run", options.folder, "-o", str(out), "--device", "cpu"]
        return [*command, *frames, *settings]
    more = ["--depth-range", str(options.depth_range)] if options.depth_range else []
    more += ["--no-mesh"] if options.no_mesh else []
    return [sys.executable, "-m", "tools.peers.worker", system, options.folder, str(out), *frames, *more]


# The system has a process begin with the peak memory of the one that starts it, so a small one starts the command.
_STARTER = """
import json, os, subprocess, sys
process = subprocess.Popen(sys.argv[2:])
_, status, usage = os.wait4(process.pid, 0)
figures = os.waitstatus_to_exitcode(status), usage.ru_utime + usage.ru_stime, usage.ru_maxrss
os.write(int(sys.argv[1]), json.dumps(figures).encode())
"""


def run(command: list[str], log: Path) -> tuple[int, float, float, float]:
    """Run a process to its end; its output goes to ``log``.

    Returns:
        Exit status, CPU seconds of it and its children, seconds on the clock, and the most memory it held [MiB].
    """
    start = time.perf_counter()
    reading, writing = os.pipe()
    with open(log, "wb") as file, open(reading, encoding="utf-8") as answer:
        try:
            # -S: what site-packages load at the start would count as memory of the command.
            starter = subprocess.Popen(
                [sys.executable, "-I", "-S", "-c", _STARTER, str(writing), *command],
                stdout=file, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL, pass_fds=[writing],
            )  # fmt: skip
        finally:
            os.close(writing)
        told = answer.read()
        code = starter.wait()
    seconds = time.perf_counter() - start
    if not told:  # it was ended before the command was
        return code or 1, 0.0, seconds, 0.0
    code, cpu, peak = json.loads(told)
    return code, cpu, seconds, peak / 1024


def judge(row: Row, out: Path, recording: Recording) -> None:
    """Fill in what a run's folder tells: ATE, lost frames, times.

    Raises:
        WarpSlamError: A file in it can't be used.
    """
    times, poses = read_tum(out / "trajectory.tum")
    partner = associate(recording.times, times, 1e-3)
    has_pose = partner >= 0
    row.without_pose = int((~has_pose).sum())
    if recording.truth is not None:
        error = ate(poses[partner[has_pose]], recording.truth[has_pose])
        row.ate_cm, row.ate_max_cm = 100 * error.rmse, 100 * error.max
    if (out / "run.json").is_file():
        record: dict[str, Any] = json.loads((out / "run.json").read_text())
        row.lost, row.remarks = len(record["lost"]), record["remarks"]
        tracking = record["cpu_seconds"].get("tracking")
        if row.cpu_seconds_a_frame is not None:
            row.cpu_seconds_a_frame -= record["cpu_seconds"].get("setup", 0.0) / len(recording)
        row.tracking_cpu_seconds_a_frame = None if tracking is None else tracking / len(recording)
    elif (out / "metrics.json").is_file():
        counts = json.loads((out / "metrics.json").read_text())["frames"]
        row.lost = counts.get("LOST", 0) + counts.get("SKIPPED", 0)


def judge_mesh(row: Row, out: Path, recording: Recording, truth_mesh: Any) -> None:
    """Fill in how far the mesh is from the true surface; only where all true poses are known.

    Raises:
        WarpSlamError: The mesh can't be judged.
    """
    if recording.truth is None or not (out / "mesh.ply").is_file():
        return
    found = evaluate_mesh(out / "mesh.ply", truth_mesh, recording.sequence, recording.indices, recording.truth)
    (result,) = found.values()
    row.mesh = {
        "accuracy_cm": 100 * result.accuracy,
        "completion_cm": 100 * result.completion,
        "completion_ratio": 100 * result.completion_ratio,
    }


def measure(system: str, options: argparse.Namespace, recording: Recording, truth_mesh: Any) -> Row:
    """Run one system and judge it."""
    row = Row(system if system == OURS else PEERS[system].title)
    if system != OURS and (missing := PEERS[system].missing()):
        row.problem = missing
        return row
    out = options.out / system
    out.mkdir(parents=True, exist_ok=True)
    # A trajectory of an earlier run must not pass for one of this.
    (out / "trajectory.tum").unlink(missing_ok=True)
    log = options.out / f"{system}.log"
    code, cpu, row.wall_seconds, row.peak_mib = run(command_of(system, options, out), log)
    row.cpu_seconds_a_frame = cpu / len(recording)
    if code:
        row.problem = f"failed with exit status {code}, see {log}"
        return row
    try:
        judge(row, out, recording)
        if truth_mesh is not None:
            judge_mesh(row, out, recording, truth_mesh)
    except WarpSlamError as error:
        row.problem = str(error).splitlines()[0]
    return row


def table(rows: list[Row], *, meshes: bool) -> str:
    """All rows and the cited ones, in Markdown."""
    head = ["program", "ATE (max) [cm]", "lost", "CPU s a frame (tracking)", "wall [s]", "memory [MiB]"]
    head += ["mesh: accuracy / completion [cm] / within 5 cm [%]"] if meshes else []
    lines = [head, ["---"] * len(head)]
    for row in rows:
        name = "; ".join([row.title, *row.remarks])
        if row.problem:
            lines.append([name, row.problem, *[""] * (len(head) - 2)])
            continue
        lost = "-" if row.lost is None else str(row.lost)
        if row.without_pose:
            lost += f", {row.without_pose} without a pose"
        cells = [
            name,
            "-" if row.ate_cm is None else f"{row.ate_cm:.2f} ({row.ate_max_cm:.2f})",
            lost,
            f"{_number(row.cpu_seconds_a_frame)} ({_number(row.tracking_cpu_seconds_a_frame)})",
            _number(row.wall_seconds, 0),
            _number(row.peak_mib, 0),
        ]
        mesh = " / ".join(f"{value:.2f}" for value in row.mesh.values()) or "-"
        lines.append([*cells, mesh] if meshes else cells)
    for name, trajectory, mesh in CITED:
        cells = [f"{name} (cited)", trajectory, *["-"] * 4]
        if meshes or trajectory != "-":
            lines.append([*cells, mesh] if meshes else cells)
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


def _number(value: float | None, digits: int = 3) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def main(arguments: list[str] | None = None) -> int:
    """Run and print."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.peers", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", help="sequence, of any format that warpslam reads")
    systems = (*PEERS, OURS)
    parser.add_argument(
        "--systems", nargs="+", choices=systems, default=systems, metavar="NAME", help=", ".join(systems)
    )
    parser.add_argument("--frames", metavar="A:B:STEP", help="frames to use")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder of all runs (runs/peers/NAME)")
    parser.add_argument("--truth-mesh", metavar="FILE", help="true surface: judges the meshes")
    parser.add_argument("--no-mesh", action="store_true", help="of the peers; warpslam always makes one")
    parser.add_argument("--depth-range", type=float, metavar="M", help="depth that peers use [m] (by dataset)")
    parser.add_argument(
        "--set", dest="overrides", nargs="+", default=[], metavar="KEY=VALUE", help="warpslam's settings"
    )
    options = parser.parse_args(arguments)
    try:
        recording = Recording(options.folder, options.frames, options.depth_range)
        truth_mesh = load_mesh(options.truth_mesh) if options.truth_mesh else None
    except WarpSlamError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    options.out = options.out or Path("runs/peers") / recording.sequence.name
    rows = []
    for system in options.systems:
        rows.append(measure(system, options, recording, truth_mesh))
        row = rows[-1]
        print(f"{row.title}: {row.problem or f'{row.wall_seconds:.0f} s'}", file=sys.stderr, flush=True)
        options.out.mkdir(parents=True, exist_ok=True)
        (options.out / "peers.json").write_text(json.dumps([asdict(row) for row in rows], indent=1) + "\n")
    print(f"{recording.sequence.name}, {len(recording)} frames\n")
    print(table(rows, meshes=truth_mesh is not None))
    return 0


if __name__ == "__main__":
    sys.exit(main())
