"""Every kind of attack, so many times, and what came of it as a table.

    python -m tools.attacks                     all kinds, at the counts of the release (hours)
    python -m tools.attacks --quick             all kinds, a few tries each (minutes)
    python -m tools.attacks maps:200 threads:4  some of them

The exit code is 1 where anything crashed, hung for more than 20 s, raised an error that is not typed, gave a wrong
result, or lost what had been computed.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from tools.attacks import folders, stops
from tools.attacks.isolation import Account, attack


def _module(module: str, memory_gb: float = 0.0, *, build: str = "usual") -> Callable[[str, int, int], Account]:
    def run(name: str, count: int, seed: int) -> Account:
        return attack(name, f"tools.attacks.{module}", count, seed=seed, memory_gb=memory_gb, build=build)

    return run


def _timed(work: Callable[[Account, int, int], None]) -> Callable[[str, int, int], Account]:
    def run(name: str, count: int, seed: int) -> Account:
        account, start = Account(name), time.monotonic()
        work(account, count, seed)
        account.seconds = time.monotonic() - start
        return account

    return run


def _kills(account: Account, count: int, seed: int) -> None:
    """At every change of a file if there are that few, and at up to 100 moments, half as many."""
    _, changes = stops.reference()
    points = np.unique(np.linspace(1, changes, min(count, changes)).round().astype(int)).tolist()
    moments = np.random.default_rng(seed).uniform(1.0, 40.0, max(1, min(count // 2, 100)))
    stops.kill_everywhere(account, points, moments.tolist())


def _terms(account: Account, count: int, seed: int) -> None:
    stops.terminate(account, np.random.default_rng(seed).uniform(1.0, 40.0, count).tolist())


def _disks(account: Account, count: int, seed: int) -> None:
    sizes = [int(size) for size in np.geomspace(4e3, 8e6, max(count // 2, 1))]
    for checkpoints in (True, False):
        stops.fill_disk(account, sizes, checkpoints=checkpoints)


KINDS: dict[str, tuple[Callable[[str, int, int], Account], int, int]] = {
    "kernels": (_module("kernels"), 2000, 50),
    "kernels checked": (_module("kernels", build="debug"), 500, 10),
    "kernels from PTX": (_module("kernels", build="ptx"), 100, 3),
    "arguments": (_module("api", 4.0), 1000, 40),
    "frames": (_module("frames"), 5000, 40),
    **{f"folders {name}": (_module("folders", 2.0), 2000, 20) for name in folders.FORMATS},
    "maps": (_module("files", 4.0), 1000, 20),
    "checkpoints": (_module("files", 4.0), 1000, 10),
    "decoders": (_module("files", 4.0), 1000, 50),
    "run folders": (_module("run_folders", 4.0), 500, 20),
    "soak": (_module("soak"), 1000, 12),
    "threads": (_module("threads"), 20, 2),
    "forks": (_module("threads"), 20, 2),
    "kill -9": (_timed(_kills), 1000, 6),
    "SIGTERM": (_timed(_terms), 20, 2),
    "full disks": (_timed(_disks), 60, 4),
}
"""By name: what runs it, and its tries at a release and in a quick look."""


def table(accounts: list[Account]) -> str:
    """As Markdown."""
    lines = [
        "| attack | tries | came back | refused, typed | untyped | crashes | hangs > 20 s | wrong | lost | s |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for one in accounts:
        typed = one.outcomes.get("typed error", 0)
        back = sum(one.outcomes.values()) - typed
        failures = [len(part) for part in (one.untyped, one.crashes, one.hangs, one.wrong, one.lost)]
        cells = [one.name, one.tries, back, typed, *failures, f"{one.seconds:.0f}"]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


def main() -> int:
    """Run the kinds that are asked for."""
    parser = argparse.ArgumentParser(prog="python -m tools.attacks", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("kinds", nargs="*", metavar="KIND[:COUNT]", help=f"of {', '.join(KINDS)} (default: all)")
    parser.add_argument("--quick", action="store_true", help="a few tries each")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-o", "--output", type=Path, help="also write the accounts there, as JSON")
    options = parser.parse_args()
    accounts = []
    for word in options.kinds or KINDS:
        name, _, count = word.partition(":")
        if name not in KINDS:
            parser.error(f"unknown kind {name!r}; known are {', '.join(KINDS)}")
        run, many, few = KINDS[name]
        account = run(name, int(count) if count else few if options.quick else many, options.seed)
        accounts.append(account)
        print(f"{name}: {account.tries} tries, {len(account.failures)} failures, {dict(account.outcomes)}", flush=True)
        for failure in account.failures:
            print(f"  {failure}", flush=True)
        if options.output:
            options.output.write_text(json.dumps([vars(one) for one in accounts], indent=1))
    print(table(accounts))
    return 1 if any(account.failures for account in accounts) else 0


if __name__ == "__main__":
    sys.exit(main())
