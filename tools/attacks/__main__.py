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
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from tools.attacks import folders
from tools.attacks.isolation import Account, attack


def _module(module: str, memory_gb: float = 0.0, **options: Any) -> Callable[[str, int, int], Account]:
    def run(name: str, count: int, seed: int) -> Account:
        return attack(name, f"tools.attacks.{module}", count, seed=seed, memory_gb=memory_gb, **options)

    return run


_stops = _module("stops", seconds=600.0)  # each of its runs has a limit of its own

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
    "soak": (_module("soak"), 200, 12),
    "threads": (_module("threads"), 20, 2),
    "forks": (_module("threads"), 20, 2),
    "kill -9 at changes": (_stops, 1000, 6),
    "kill -9 at moments": (_stops, 100, 4),
    "kill in a write": (_stops, 30, 3),
    "SIGTERM": (_stops, 20, 3),
    "full disks": (_stops, 30, 3),
    "full disks, no checkpoints": (_stops, 30, 3),
}
"""By name: what runs it, and its tries at a release and in a quick look."""


def table(accounts: list[Account]) -> str:
    """As Markdown."""
    lines = [
        "| attack | tries | refused, typed | right result | crashes | untyped | hangs > 20 s | wrong | lost | s |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for one in accounts:
        typed = one.outcomes.get("typed error", 0)
        back = sum(one.outcomes.values()) - typed
        failures = [len(part) for part in (one.crashes, one.untyped, one.hangs, one.wrong, one.lost)]
        cells = [one.name, one.tries, typed, back, *failures, f"{one.seconds:.0f}"]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


def _read(path: Path | None) -> dict[str, Account]:
    """Accounts of before, by name."""
    if path is None or not path.is_file():
        return {}
    accounts = [Account(**one) for one in json.loads(path.read_text())]
    return {one.name: replace(one, outcomes=Counter(one.outcomes)) for one in accounts}


def main() -> int:
    """Run the kinds that are asked for."""
    parser = argparse.ArgumentParser(prog="python -m tools.attacks", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("kinds", nargs="*", metavar="KIND[:COUNT]", help=f"of {', '.join(KINDS)} (default: all)")
    parser.add_argument("--quick", action="store_true", help="a few tries each")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "-o", "--output", type=Path, metavar="FILE",
        help="also write the accounts there, as JSON; kinds that it holds in full are not repeated",
    )  # fmt: skip
    options = parser.parse_args()
    done = _read(options.output)
    for word in options.kinds or KINDS:
        name, _, count = word.partition(":")
        if name not in KINDS:
            parser.error(f"unknown kind {name!r}; known are {', '.join(KINDS)}")
        run, many, few = KINDS[name]
        wanted = int(count) if count else few if options.quick else many
        if name in done and done[name].asked >= wanted:
            continue
        account = run(name, wanted, options.seed)
        account.asked = wanted
        done[name] = account
        print(f"{name}: {account.tries} tries, {len(account.failures)} failures, {dict(account.outcomes)}", flush=True)
        for failure in account.failures:
            print(f"  {failure}", flush=True)
        if options.output:
            options.output.write_text(json.dumps([vars(one) for one in done.values()], indent=1))
    accounts = [done[name] for name in KINDS if name in done]
    print(table(accounts))
    return 1 if any(account.failures for account in accounts) else 0


if __name__ == "__main__":
    sys.exit(main())
