"""Runs that are stopped: killed at each of their file operations, by SIGTERM, by a disk that fills.

A child runs `warpslam run` on a small written sequence with checkpoints, counts the calls of the functions that change
files, and kills itself before a given one. Whatever is left must lead to the bytes of a run that was not stopped.
"""

from __future__ import annotations

import atexit
import builtins
import hashlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from functools import cache
from pathlib import Path
from typing import Any

from tools.attacks import scene
from tools.attacks.isolation import ROOT, Account
from warpslam.runs.folder import RunFolder
from warpslam.synthetic import SyntheticSequence, write_sequence

FRAMES = 4
_SAME = ("trajectory.tum", "ground_truth.tum", "mesh.ply", "map.safetensors", "frames.csv")
_THERE = ("metrics.json", "timing.json", "frames.json", "report.html", "panels.png", "manifest.json", "config.yaml")


@cache
def home() -> Path:
    """Folder with the sequence."""
    folder = Path(tempfile.mkdtemp(prefix="warpslam-attacks-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    write_sequence(SyntheticSequence(1, FRAMES, intrinsics=scene.CAMERA), folder / "sequence")
    return folder


def arguments(output: Path, *, checkpoints: bool = True) -> list[str]:
    """Of the run."""
    words = ["run", str(home() / "sequence"), "--preset", "default", "--device", "cpu", "-o", str(output)]
    words += ["--set", *scene.SMALL]
    return words + (["--checkpoint-every", "2"] if checkpoints else [])


def child(mode: str, number: int, words: list[str], **keywords: Any) -> subprocess.CompletedProcess[str]:
    """``warpslam`` in a process in which something happens at the ``number``-th change of a file."""
    command = [sys.executable, "-m", "tools.attacks.stops", mode, str(number), *words]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600, check=False, **keywords)


@cache
def reference() -> tuple[dict[str, str], int]:
    """Digests of a run that was not stopped, and its changes of files."""
    output = home() / "reference"
    done = child("count", 0, arguments(output))
    if done.returncode != 0:
        raise RuntimeError(done.stderr)
    return digests(output), int(done.stderr.strip().splitlines()[-1].split()[-1])


def digests(folder: Path) -> dict[str, str]:
    """Of the files that a stop must not change."""
    return {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in _SAME}


def kill_everywhere(account: Account, points: list[int], times: list[float]) -> None:
    """Kill -9 before the given changes of files (from 1 on), and after the given seconds; then go on."""
    truth, _ = reference()
    for point in points:
        output = home() / "killed"
        shutil.rmtree(output, ignore_errors=True)
        child("kill", point, arguments(output))
        _go_on(account, f"kill at change {point}", output, truth)
    for seconds in times:
        output = home() / "killed"
        shutil.rmtree(output, ignore_errors=True)
        _signal_after(signal.SIGKILL, seconds, arguments(output))
        _go_on(account, f"kill after {seconds:.2f} s", output, truth)


def _go_on(account: Account, what: str, output: Path, truth: dict[str, str]) -> None:
    folder = RunFolder(output)
    begun = folder.is_unfinished or folder.has_results or folder.metrics.is_file()
    done = child("none", 0, ["run", "--resume", str(output)] if begun else arguments(output))
    if "Traceback" in done.stderr:
        account.untyped.append(f"{what}: {done.stderr.strip().splitlines()[-1][:200]}")
    elif done.returncode != 0:
        account.lost.append(f"{what}: exit {done.returncode}: {done.stderr.strip()[-300:]}")
    elif digests(output) != truth:
        account.wrong.append(f"{what}: other bytes")
    elif missing := [name for name in _THERE if not (output / name).is_file()]:
        account.lost.append(f"{what}: no {', '.join(missing)}")
    else:
        account.outcomes["the same bytes" if begun else "nothing was there yet"] += 1


def _signal_after(number: int, seconds: float, words: list[str]) -> tuple[int, str]:
    """Exit code and standard error of a run that is sent a signal."""
    process = subprocess.Popen(
        [sys.executable, "-m", "tools.attacks.stops", "none", "0", *words],
        cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        time.sleep(seconds)
        process.send_signal(number)
        _, text = process.communicate(timeout=300)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        return -1, "it did not end"
    return process.returncode, text


def terminate(account: Account, times: list[float]) -> None:
    """SIGTERM after so many seconds to a run without checkpoints: what was done by then is written, exit 143."""
    for seconds in times:
        output = home() / "terminated"
        shutil.rmtree(output, ignore_errors=True)
        code, text = _signal_after(signal.SIGTERM, seconds, arguments(output, checkpoints=False))
        frames = (
            len(RunFolder(output).trajectory.read_text().splitlines()) - 1
            if (output / "trajectory.tum").exists()
            else 0
        )
        logged = (output / "log.txt").read_text().count(": frame ") if (output / "log.txt").exists() else 0
        if code == -1:
            account.hangs.append(f"SIGTERM after {seconds:.2f} s")
        elif "Traceback" in text:
            account.untyped.append(f"SIGTERM after {seconds:.2f} s: {text.strip().splitlines()[-1][:200]}")
        elif code == -signal.SIGTERM and logged == 0:
            account.outcomes["before there was a program"] += 1
        elif code not in (143, 0):
            account.wrong.append(f"SIGTERM after {seconds:.2f} s: exit {code}")
        elif frames < logged:
            account.lost.append(f"SIGTERM after {seconds:.2f} s: {frames} of {logged} frames")
        else:
            account.outcomes[f"exit {code}"] += 1


def fill_disk(account: Account, sizes: list[int], *, checkpoints: bool) -> None:
    """Disks with room for so many bytes: what fits is there, and with space again the run is finished."""
    truth, _ = reference()
    for size in sizes:
        output = home() / "full"
        shutil.rmtree(output, ignore_errors=True)
        done = child("full", size, arguments(output, checkpoints=checkpoints))
        what = f"disk of {size / 1e3:.0f} kB, {'with' if checkpoints else 'no'} checkpoints"
        if "Traceback" in done.stderr:
            account.untyped.append(f"{what}: {done.stderr.strip().splitlines()[-1][:200]}")
        elif checkpoints or done.returncode == 0:
            _go_on(account, what, output, truth)
        elif not (output / "trajectory.tum").is_file():
            account.outcomes["one line" if size < 20_000 else "trajectory elsewhere"] += 1
        else:
            again = child("none", 0, ["report", str(output)])
            there = [name for name in ("trajectory.tum", "metrics.json", "report.html") if (output / name).is_file()]
            if again.returncode != 0 or len(there) < 3:
                account.lost.append(f"{what}: {again.stderr.strip()[-200:]} {there}")
            else:
                account.outcomes["finished from what fitted"] += 1


# -- the child -------------------------------------------------------------------------------------------------------


class _Changes:
    """Counts what changes files under the temporary folder, and does something at one of them."""

    def __init__(self, mode: str, number: int) -> None:
        self.mode, self.number, self.count, self.used = mode, number, 0, 0

    def before(self, path: Any) -> None:
        if "warpslam-attacks-" not in os.fsdecode(os.fspath(path)):
            return
        self.count += 1
        if self.mode == "kill" and self.count == self.number:
            os.kill(os.getpid(), signal.SIGKILL)

    def install(self) -> None:
        for name in ("rename", "replace", "unlink", "remove", "mkdir", "rmdir"):
            setattr(os, name, self._counted(getattr(os, name)))
        real_open = builtins.open

        def counted_open(file: Any, mode: str = "r", *rest: Any, **keywords: Any) -> Any:
            if isinstance(file, str | os.PathLike) and set(mode) & set("wax+"):
                self.before(file)
            return real_open(file, mode, *rest, **keywords)

        builtins.open = counted_open
        import io

        io.open = counted_open  # pathlib's

    def _counted(self, function: Any) -> Any:
        def counted(path: Any, *rest: Any, **keywords: Any) -> Any:
            self.before(path)
            return function(path, *rest, **keywords)

        return counted


def main() -> int:
    """``MODE NUMBER ARGUMENTS...``: MODE is none, count, kill, or full."""
    mode, number, *words = sys.argv[1:]
    import warp as wp

    wp.config.log_level = wp.LOG_ERROR
    from warpslam import cli

    changes = _Changes(mode, int(number))
    if mode in ("count", "kill"):
        changes.install()
    if mode == "full":
        import resource

        # The largest file that can be written: as a disk that is full does, the system refuses the rest.
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (int(number), int(number)))
    code = cli.main(words)
    if mode == "count":
        print("changes", changes.count, file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
