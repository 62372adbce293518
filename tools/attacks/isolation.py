"""Many tries of one kind in a process of their own, so that what ends or hangs a process is counted, not suffered."""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import resource
import selectors
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import psutil

ROOT = Path(__file__).resolve().parents[2]
SECONDS = 20.0
"""A try that takes longer hangs: of the clock where it sleeps, of a core where a busy machine keeps it waiting."""
START_SECONDS = 600.0
"""Until the first try begins: kernels may have to be compiled."""
TYPED, UNTYPED, WRONG, LOST, HANGS = "typed error", "untyped error", "wrong result", "lost", "hangs"
_TRIES = "WARPSLAM_ATTACKS_TRIES"

Attempt = Callable[[np.random.Generator], str]
"""A try: says what came of it (and more behind a semicolon), raises an error of ours where the input was refused, and
`AssertionError` where a result is wrong; `StopIteration` is no try, and the end of its kind."""


class Lost(Exception):  # noqa: N818
    """What had been computed is gone."""


class Untyped(Exception):  # noqa: N818
    """A process of its own, which a try began, ended in a traceback."""


class Hang(Exception):  # noqa: N818
    """Such a process did not end."""


def number_of(rng: np.random.Generator) -> int:
    """Of the try that a generator was made for."""
    seed = rng.bit_generator.seed_seq
    assert isinstance(seed, np.random.SeedSequence) and isinstance(seed.entropy, list)
    return int(seed.entropy[1])


def tries() -> int:
    """How many this kind has."""
    return int(os.environ[_TRIES])


@dataclass
class Account:
    """What came of the tries of one kind."""

    name: str
    outcomes: Counter[str] = field(default_factory=Counter)
    crashes: list[str] = field(default_factory=list)
    hangs: list[str] = field(default_factory=list)
    untyped: list[str] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    """What tries told of themselves behind a semicolon."""
    seconds: float = 0.0
    asked: int = 0
    """Tries that were asked for."""

    @property
    def tries(self) -> int:
        return sum(self.outcomes.values()) + len(self.crashes + self.hangs + self.untyped + self.wrong + self.lost)

    @property
    def failures(self) -> list[str]:
        return [
            f"{self.name}: {kind}: {text}"
            for kind in ("crashes", "hangs", "untyped", "wrong", "lost")
            for text in getattr(self, kind)
        ]

    def note(self, number: int, outcome: str, detail: str) -> None:
        """One try that came back."""
        failures = {UNTYPED: self.untyped, WRONG: self.wrong, LOST: self.lost, HANGS: self.hangs}.get(outcome)
        if failures is not None:
            failures.append(f"try {number}: {detail}")
        else:
            self.outcomes[outcome] += 1
            if detail:
                self.remarks.append(detail)


def attack(
    name: str,
    module: str,
    count: int,
    *,
    seed: int = 0,
    build: str = "usual",
    memory_gb: float = 0,
    seconds: float | None = None,
) -> Account:
    """``count`` tries of ``module.attempt``, or of ``module.prepare()``'s result, in child processes.

    Args:
        name: Of the account, and first argument of ``prepare``.
        module: Python module.
        count: Tries; each has a random generator of its own, by number.
        seed: Of all of them.
        build: Of the kernels: "usual"; "debug", which checks every access to an array on the CPU; or "ptx", the code
            for CUDA, whose accesses `tools.gpu.ptx_on_cpu` checks.
        memory_gb: More address space than this beyond what the process has when it starts ends in `MemoryError`.
        seconds: A try that takes longer hangs; `SECONDS` by default.
    """
    account, start, done = Account(name), time.monotonic(), 0
    with tempfile.TemporaryDirectory(prefix="warpslam-attacks-", ignore_cleanup_errors=True) as folder:
        while done < count:
            numbers = (seed, done, count, build, memory_gb)
            done = _run_child(account, [name, module, *map(str, numbers)], done, folder, seconds or SECONDS)
    account.seconds = time.monotonic() - start
    return account


def _run_child(account: Account, arguments: list[str], first: int, folder: str, seconds: float) -> int:
    """Tries until the child ends; returns the number of the next one. What they write lies in ``folder``."""
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    child = subprocess.Popen(
        [sys.executable, "-c", "from tools.attacks.isolation import main; main()", *arguments],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=ROOT, start_new_session=True,
        env={**os.environ, "TMPDIR": folder, "PYTHONPATH": path, _TRIES: arguments[4]},
    )  # fmt: skip
    assert child.stdout is not None and child.stderr is not None
    running, texts, rest = first, b"", b""
    limit = time.monotonic() + START_SECONDS
    last, spent, began = limit, 0.0, False
    process = psutil.Process(child.pid)
    with selectors.DefaultSelector() as selector:
        for stream in (child.stdout, child.stderr):
            os.set_blocking(stream.fileno(), False)
            selector.register(stream, selectors.EVENT_READ)
        while selector.get_map():
            ready = selector.select(max(limit - time.monotonic(), 0.0))
            if not ready and time.monotonic() >= limit:
                if began and time.monotonic() < last and is_kept_waiting(process, spent, seconds):
                    limit = time.monotonic() + 2.0  # from now on: this process may have been stopped as well
                    continue
                os.killpg(child.pid, signal.SIGKILL)
                child.wait()
                account.hangs.append(f"try {running}: nothing for {seconds:g} s")
                return running + 1
            for key, _ in ready:
                data = os.read(key.fd, 1 << 16)
                if not data:
                    selector.unregister(key.fileobj)
                elif key.fileobj is child.stderr:
                    texts = (texts + data)[-4000:]
                else:
                    *lines, rest = (rest + data).split(b"\n")
                    for line in lines:
                        news = json.loads(line)
                        running, limit, began = news["next"], time.monotonic() + seconds, True
                        last, spent = limit + START_SECONDS, _seconds_of(process)
                        if "outcome" in news:
                            account.note(news["try"], news["outcome"], news["detail"])
    code = child.wait()
    if code == 0:
        return running
    words = texts.decode(errors="replace").strip().splitlines()[-1:] or ["no word"]
    if not began:
        raise RuntimeError(f"{account.name}: the tries can't begin (exit {code}): {texts.decode(errors='replace')}")
    account.crashes.append(f"try {running}: exit {code}: {words[0][:300]}")
    return running + 1


def _seconds_of(process: psutil.Process) -> float:
    """Of a core that a process and its children have had."""
    total = 0.0
    with contextlib.suppress(psutil.Error):
        for one in (process, *process.children(recursive=True)):
            times = one.cpu_times()
            total += times.user + times.system
    return total


def is_kept_waiting(process: psutil.Process, before: float, seconds: float = SECONDS) -> bool:
    """Whether a process that had used ``before`` seconds when its try began has not had its time yet, and wants it."""
    if _seconds_of(process) - before >= seconds:
        return False
    for _ in range(10):
        with contextlib.suppress(psutil.Error, OSError):
            for one in (process, *process.children(recursive=True)):
                states = [path.read_text().rpartition(")")[2].split()[0] for path in _threads_of(one.pid)]
                if set(states) & {"R", "D", "T"}:
                    return True
        time.sleep(0.1)
    return False


def _threads_of(pid: int) -> list[Path]:
    return [folder / "stat" for folder in Path(f"/proc/{pid}/task").iterdir()]


def main() -> None:
    """The child: arguments are those of `attack`."""
    name, module, seed, first, count, build, memory_gb = sys.argv[1:]
    news = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # what anything prints is no news
    import warp as wp

    if build == "debug":
        wp.config.mode = "debug"
    wp.config.log_level = wp.LOG_ERROR
    from warpslam.errors import WarpSlamError

    home = importlib.import_module(module)
    if build == "ptx":
        from tools.gpu import ptx_on_cpu

        ptx_on_cpu.install(check=True)
    attempt: Attempt = home.prepare(name) if hasattr(home, "prepare") else home.attempt
    if float(memory_gb):
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        size = pages * resource.getpagesize() + int(float(memory_gb) * 1e9)
        resource.setrlimit(resource.RLIMIT_AS, (size, size))
    news.write(json.dumps({"next": int(first)}) + "\n")
    for number in range(int(first), int(count)):
        detail = ""
        with contextlib.suppress(FileNotFoundError):
            os.remove(f"core.{os.getpid()}")
        try:
            outcome, _, detail = attempt(np.random.default_rng([int(seed), number])).partition("; ")
        except StopIteration:
            news.write(json.dumps({"next": int(count)}) + "\n")
            return
        except WarpSlamError as error:
            outcome = TYPED
            if len(str(error)) > 4000:
                outcome, detail = WRONG, f"a message of {len(str(error))} letters"
        except AssertionError as error:
            outcome, detail = WRONG, f"{error} {_where(error)}"
        except (Lost, Hang, Untyped) as error:
            outcome, detail = {Lost: LOST, Hang: HANGS, Untyped: UNTYPED}[type(error)], str(error)
        except BaseException as error:
            outcome, detail = UNTYPED, f"{type(error).__name__}: {str(error)[:200]} {_where(error)}"
        news.write(json.dumps({"try": number, "outcome": outcome, "detail": detail, "next": number + 1}) + "\n")


def _where(error: BaseException) -> str:
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if "/warpslam/" in frame.filename] or frames
    return f"({Path(ours[-1].filename).name}:{ours[-1].lineno})"
