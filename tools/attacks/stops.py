"""Runs that are stopped: killed at each of their changes of files and at any moment, by SIGTERM, by a disk that fills.

A try forks a process that has everything imported and its kernels loaded; the child runs `warpslam run` on a small
written sequence. Whatever the stop leaves must lead to the bytes of a run that was not stopped.
"""

from __future__ import annotations

import builtins
import contextlib
import hashlib
import importlib
import io
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from tools.attacks import scene
from tools.attacks.isolation import SECONDS, Attempt, Hang, Lost, Untyped, is_kept_waiting, number_of, tries
from warpslam import cli
from warpslam.pipeline import results
from warpslam.pipeline.setup import load_kernels
from warpslam.report import pictures
from warpslam.runs.folder import RunFolder
from warpslam.synthetic import SyntheticSequence, write_sequence

__all__ = ["prepare"]

FRAMES = 4
_SETTINGS = (
    *scene.SMALL, "meshing.voxel=0.1", "grid.middle_spacing=0.64", "grid.fine_spacing=0.32", "grid.color_spacing=0.32",
    "mapping.pixels=64", "mapping.first_iterations=3", "mapping.iterations=2", "mapping.coarse_iterations=1",
    "mapping.active_share=0", "mapping.window=2",
)  # fmt: skip
_SAME = ("trajectory.tum", "ground_truth.tum", "mesh.ply", "map.safetensors", "frames.csv")
_THERE = ("metrics.json", "timing.json", "frames.json", "report.html", "panels.png", "manifest.json", "config.yaml")
_OF_A_STOP = ("trajectory.tum", "map.safetensors", "mesh.ply", "metrics.json", "report.html")
_LONGEST = 300.0  # [s] that a run may be kept waiting on a busy machine
_START = 4.0  # [s] that a program may need to begin
_PAGE = 4096
_STREAMS = ("shown.txt", "said.txt")  # standard output and standard error of a child
_NEEDED = (
    "warpslam.cli.run", "warpslam.cli.report", "torch", "matplotlib.figure", "matplotlib.backends.backend_agg",
    "scipy.spatial", "trimesh", "rich.progress",
)  # fmt: skip
"""Imported before the tries, and not in every child."""


def prepare(name: str) -> Attempt:
    """``name`` is one of `_ATTEMPTS`."""
    home = Path(tempfile.mkdtemp(prefix="warpslam-attacks-"))
    sequence = SyntheticSequence(1, FRAMES, intrinsics=scene.CAMERA)
    load_kernels(sequence, "cpu")
    for module in _NEEDED:
        importlib.import_module(module)
    results.PANEL_COUNT = pictures.SUPERSAMPLING = 1  # figures take longer than all else
    runs = _Runs(home)
    # Threads of libraries do not outlive a fork: whatever might begin one is done in a child.
    runs.child([], lambda: write_sequence(sequence, home / "sequence"))
    runs.learn()
    return _ATTEMPTS[name](runs)


@dataclass(frozen=True)
class Ended:
    """How a child came to its end."""

    code: int
    """Exit code, or minus the signal."""
    text: str
    """What it said on standard error."""
    seconds: float
    """From its start."""


class _Runs:
    """Runs of one sequence in forked children, and what comes of one that nobody stops."""

    def __init__(self, home: Path) -> None:
        self.home = home
        self.output = home / "run"
        self.truth: dict[str, str] = {}
        self.seconds = 60.0

    def learn(self) -> None:
        """The bytes of a whole run, and its seconds."""
        for _ in range(2):  # the first one finds nothing in the caches
            self.clear()
            done = self.child(self.words())
            if done.code != 0:
                raise RuntimeError(done.text)
        self.truth, self.seconds = digests(self.output), done.seconds

    def clear(self) -> None:
        """Nothing of the run before is left."""
        shutil.rmtree(self.output, ignore_errors=True)

    def words(self, *, checkpoints: bool = True) -> list[str]:
        """Of the command."""
        words = ["run", str(self.home / "sequence"), "--preset", "default", "--device", "cpu"]
        words += ["-o", str(self.output), "--set", *_SETTINGS]
        return words + (["--checkpoint-every", "2"] if checkpoints else [])

    def child(
        self,
        words: list[str],
        install: Callable[[], None] | None = None,
        stop: tuple[int, float] | None = None,
    ) -> Ended:
        """``warpslam`` in a child. ``install`` is called there first; ``stop`` is a signal that the child is sent, and
        after how many seconds.
        """
        for name in _STREAMS:
            (self.home / name).unlink(missing_ok=True)
        start = time.monotonic()
        pid = os.fork()
        if pid == 0:
            _be_child(words, self.home, install)
        process, limit = psutil.Process(pid), start + self.seconds + SECONDS
        due = None if stop is None else start + stop[1]
        while True:
            ended, status = os.waitpid(pid, os.WNOHANG)
            now = time.monotonic()
            if ended:
                break
            if stop is not None and due is not None and now >= due:
                os.kill(pid, stop[0])
                due = None
            if now > limit:
                if now - start < _LONGEST and is_kept_waiting(process, 0.0, self.seconds + SECONDS):
                    limit = time.monotonic() + 2.0
                    continue
                os.kill(pid, signal.SIGKILL)
                os.waitpid(pid, 0)
                raise Hang(f"a run that did not end within {now - start:.0f} s")
            time.sleep(0.002)
        text = self.said("said.txt")
        if "Traceback" in text:
            raise Untyped(text.strip().splitlines()[-1][:200])
        return Ended(os.waitstatus_to_exitcode(status), text, now - start)

    def said(self, name: str) -> str:
        """What the last child wrote to one of its `_STREAMS`."""
        path = self.home / name
        return path.read_text(errors="replace") if path.is_file() else ""

    def go_on(self) -> str:
        """After a stop: with what there is, the run comes to the bytes that it would have had."""
        folder = RunFolder(self.output)
        begun = folder.is_unfinished or folder.has_results
        done = self.child(["run", "--resume", str(self.output)] if begun else self.words())
        if done.code != 0:
            raise Lost(f"exit {done.code}: {done.text.strip()[-300:]}")
        if other := [name for name, digest in digests(self.output).items() if digest != self.truth[name]]:
            raise AssertionError(f"other bytes of {', '.join(other)}")
        if missing := [name for name in _THERE if not (self.output / name).is_file()]:
            raise Lost(f"no {', '.join(missing)}")
        return "the same bytes" if begun else "nothing was there yet"


def digests(folder: Path) -> dict[str, str]:
    """Of the files that a stop must not change; empty where one is not there."""
    files = {name: folder / name for name in _SAME}
    return {
        name: hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else "" for name, path in files.items()
    }


def _at_changes(runs: _Runs) -> Attempt:
    """Kill -9 before a change of a file; as many as there are tries, evenly spread, or all.

    What a kill leaves is what lies there at that moment: one run takes copies of its folder before each change.
    """
    runs.clear()
    states = runs.home / "states"
    (states / "contents").mkdir(parents=True)
    done = runs.child(runs.words(), lambda: _before_changes(_Keeper(runs.output, states)))
    if done.code != 0:
        raise RuntimeError(done.text)
    found = sorted(states.glob("*.json"))
    known: dict[str, str] = {}

    def attempt(rng: np.random.Generator) -> str:
        count = min(tries(), len(found))
        number = number_of(rng)
        if number >= count:
            raise StopIteration
        state = found[number * len(found) // count].read_text()
        if state not in known:
            runs.clear()
            _restore(json.loads(state), states, runs.output)
            known[state] = runs.go_on()
        return f"{known[state]}; {len(found)} changes, {len(known)} states so far"

    return attempt


class _Keeper:
    """Copies a folder, each content once."""

    def __init__(self, folder: Path, states: Path) -> None:
        self._folder, self._states, self._count = folder, states, 0

    def __call__(self) -> None:
        """Before a change."""
        self._count += 1
        state: dict[str, str | None] = {}
        for path in sorted(self._folder.rglob("*")):
            name = str(path.relative_to(self._folder))
            state[name] = None
            if path.is_file():
                data = path.read_bytes()
                state[name] = hashlib.sha256(data).hexdigest()
                content = self._states / "contents" / state[name]
                if not content.exists():
                    content.write_bytes(data)
        text = json.dumps(state if self._folder.is_dir() else None)
        (self._states / f"{self._count:06d}.json").write_text(text)


def _restore(state: dict[str, str | None] | None, states: Path, folder: Path) -> None:
    if state is None:
        return
    folder.mkdir()
    for name, digest in state.items():
        if digest is None:
            (folder / name).mkdir()
        else:
            shutil.copyfile(states / "contents" / digest, folder / name)


def _at_moments(runs: _Runs) -> Attempt:
    """Kill -9 after a random time."""

    def attempt(rng: np.random.Generator) -> str:
        runs.clear()
        runs.child(runs.words(), stop=(signal.SIGKILL, rng.uniform(0.0, runs.seconds)))
        return runs.go_on()

    return attempt


def _in_writes(runs: _Runs) -> Attempt:
    """A kill in the middle of what is written: at the first file that is larger than a random size."""

    def install(size: int) -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_DFL)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))

    def attempt(rng: np.random.Generator) -> str:
        runs.clear()
        size = int(10.0 ** rng.uniform(2.5, 7.0))
        runs.child(runs.words(), lambda: install(size))
        return runs.go_on()

    return attempt


def _terminated(runs: _Runs) -> Attempt:
    """SIGTERM after a random time to a run without checkpoints: what was done by then is written, exit 143."""

    def attempt(rng: np.random.Generator) -> str:
        runs.clear()
        if number_of(rng) % 4 == 3:
            return _while_starting(runs, rng.uniform(0.0, _START))
        delay = rng.uniform(0.0, runs.seconds)
        ended = runs.child(runs.words(checkpoints=False), stop=(signal.SIGTERM, delay))
        folder = RunFolder(runs.output)
        frames = len(folder.trajectory.read_text().splitlines()) - 1 if folder.trajectory.is_file() else 0
        shown = len(re.findall(r"^frame \d+/", runs.said("shown.txt"), re.MULTILINE))
        if ended.code == -signal.SIGTERM and shown == 0:
            return "before there was a program"
        assert ended.code in (143, 0), f"exit {ended.code} after {delay:.2f} s: {ended.text.strip()[-200:]}"
        lacking = [name for name in _OF_A_STOP if shown and not (runs.output / name).is_file()]
        if frames < shown or lacking:
            raise Lost(f"{frames} of {shown} frames after {delay:.2f} s, no {lacking}")
        return f"exit {ended.code}; {frames} frames, {ended.seconds - delay:.1f} s after the signal"

    return attempt


def _while_starting(runs: _Runs, delay: float) -> str:
    """SIGTERM to a process that may still be importing."""
    process = subprocess.Popen(
        [sys.executable, "-m", "warpslam", *runs.words()], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    time.sleep(delay)
    process.send_signal(signal.SIGTERM)
    try:
        _, text = process.communicate(timeout=_LONGEST)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        raise Hang(f"SIGTERM {delay:.2f} s after its start") from None
    if "Traceback" in text:
        raise Untyped(f"{delay:.2f} s after its start: {text.strip().splitlines()[-1][:200]}")
    assert process.returncode in (143, -signal.SIGTERM), f"exit {process.returncode} {delay:.2f} s after its start"
    return "while it started"


def _full_disks(runs: _Runs, *, checkpoints: bool) -> Attempt:
    """A disk with room for so many bytes: what fits is there, and with space again the run is finished."""

    def attempt(rng: np.random.Generator) -> str:
        runs.clear()
        size = int(np.geomspace(8e3, 8e6, max(tries(), 2))[number_of(rng)])
        with _disk(runs.output, size) as (install, grow):
            done = runs.child(runs.words(checkpoints=checkpoints), install)
            assert "unexpected" not in done.text, done.text.strip()[-200:]
            grow()
            if checkpoints or done.code == 0:
                return runs.go_on()
            if not (runs.output / "trajectory.tum").is_file():
                found = re.search(r"trajectory so far is in (\S+)", done.text)
                if found and Path(found[1]).is_file():
                    return "trajectory elsewhere"
                if "frame 1/" in runs.said("shown.txt"):
                    raise Lost(f"disk of {size / 1e3:.0f} kB: no trajectory: {done.text.strip()[-200:]}")
                return "one line"
            again = runs.child(["report", str(runs.output)])
            lacking = {"trajectory.tum", "metrics.json", "report.html"} - {file.name for file in runs.output.iterdir()}
            if again.code != 0 or lacking:
                raise Lost(f"disk of {size / 1e3:.0f} kB: {again.text.strip()[-200:]} {sorted(lacking)}")
            return "finished from what fitted"

    return attempt


_ATTEMPTS: dict[str, Callable[[_Runs], Attempt]] = {
    "kill -9 at changes": _at_changes,
    "kill -9 at moments": _at_moments,
    "kill in a write": _in_writes,
    "SIGTERM": _terminated,
    "full disks": lambda runs: _full_disks(runs, checkpoints=True),
    "full disks, no checkpoints": lambda runs: _full_disks(runs, checkpoints=False),
}


@contextmanager
def _disk(folder: Path, size: int) -> Iterator[tuple[Callable[[], None] | None, Callable[[], None]]]:
    """A file system of so many bytes at ``folder``: what a child calls to have it, and what gives it space again.

    Where no file system can be mounted, the system refuses files that grow beyond that size.
    """
    folder.mkdir()
    options = f"size={max(size // _PAGE, 1) * _PAGE}"
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)], capture_output=True, check=False
    )
    if mounted.returncode != 0:

        def install() -> None:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))

        yield install, lambda: None
        return
    try:
        grow = ["mount", "-o", "remount,size=1g", str(folder)]
        yield None, lambda: subprocess.run(grow, capture_output=True, check=True) and None
    finally:
        subprocess.run(["umount", str(folder)], capture_output=True, check=True)


# -- the child -------------------------------------------------------------------------------------------------------


def _be_child(words: list[str], home: Path, install: Callable[[], None] | None) -> None:
    code = 1
    with contextlib.suppress(BaseException):
        # (The streams are those of the attack, whose first is the news of its tries.)
        for number, name in enumerate(_STREAMS, 1):
            with open(home / name, "w") as file:
                os.dup2(file.fileno(), number)
        try:
            if install is not None:
                install()
            code = cli.main(words) if words else 0
        except SystemExit as error:
            code = int(error.code or 0)
        except BaseException:
            os.write(2, traceback.format_exc().encode())
    os._exit(code)


_CHANGING = ("rename", "replace", "unlink", "remove", "mkdir", "rmdir", "fsync", "truncate", "chmod", "utime")
_NEWS = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC


def _before_changes(note: Callable[[], None]) -> None:
    """Call ``note`` before whatever changes a file of the attack, but for its own changes."""
    is_noting = False

    def noted() -> None:
        nonlocal is_noting
        if not is_noting:
            is_noting = True
            note()
            is_noting = False

    def is_ours(path: Any, folder: Any = None) -> bool:
        with contextlib.suppress(OSError, TypeError):
            name = os.readlink(f"/proc/self/fd/{path}") if isinstance(path, int) else os.fsdecode(path)
            if folder is not None:
                name = os.path.join(os.readlink(f"/proc/self/fd/{folder}"), name)
            return "warpslam-attacks-" in os.path.abspath(name) and not name.endswith(_STREAMS)
        return False

    def counted(function: Any) -> Any:
        def call(path: Any, *rest: Any, **keywords: Any) -> Any:
            if is_ours(path, keywords.get("dir_fd") or keywords.get("src_dir_fd")):
                noted()
            return function(path, *rest, **keywords)

        return call

    for name in _CHANGING:
        setattr(os, name, counted(getattr(os, name)))
    real_open, open_file = os.open, builtins.open

    def counted_descriptor(path: Any, flags: int, *rest: Any, **keywords: Any) -> Any:
        if flags & _NEWS and is_ours(path, keywords.get("dir_fd")):
            noted()
        return real_open(path, flags, *rest, **keywords)

    def counted_open(file: Any, mode: str = "r", *rest: Any, **keywords: Any) -> Any:
        if set(mode) & set("wax+") and not isinstance(file, int) and is_ours(file):
            noted()
        return open_file(file, mode, *rest, **keywords)

    os.open = counted_descriptor
    builtins.open = counted_open
    io.open = counted_open  # type: ignore[assignment]  # pathlib's
