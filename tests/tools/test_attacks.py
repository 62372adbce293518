"""The attacks find nothing, and would find something: each kind a few times, and accounts of what misbehaves."""

import json
import os
import subprocess
import sys
import time
from collections import Counter

import numpy as np
import psutil
import pytest
import warp as wp

from tools.attacks import __main__ as attacks
from tools.attacks import isolation, kernels, misbehaviour, values
from tools.gpu import ptx_on_cpu

ROOT = isolation.ROOT


def test_every_way_to_fail_is_counted(monkeypatch):
    """A try that kills its process, hangs, raises anything, or gives a wrong result is an entry of its kind, and the
    tries after it go on.
    """
    monkeypatch.setattr(isolation, "SECONDS", 3.0)
    account = isolation.attack("misbehaviour", misbehaviour.__name__, 20)
    assert account.tries == len(misbehaviour.WAYS) - 1  # the last one ends its kind
    assert account.outcomes == {"fine": 2, "typed error": 1} and account.remarks == ["remarkable"] * 2
    kinds = (account.crashes, account.hangs, account.untyped, account.wrong, account.lost)
    assert [len(kind) for kind in kinds] == [2, 1, 2, 2, 1]
    text = attacks.table([account])
    assert "| misbehaviour | 11 | 1 | 2 | 2 | 2 | 1 | 2 | 1 |" in text


@pytest.mark.parametrize(
    ("code", "before", "waits"),
    [("while True: pass", 0.0, True), ("while True: pass", -9.0, False), ("import time; time.sleep(60)", 0.0, False)],
)
def test_a_process_that_wants_its_core_is_kept_waiting(code, before, waits):
    """On a busy machine only what sleeps, or has had its seconds of a core, hangs."""
    process = subprocess.Popen([sys.executable, "-c", code])
    try:
        time.sleep(1.0)
        assert isolation.is_kept_waiting(psutil.Process(process.pid), before, 9.0) == waits
    finally:
        process.kill()
        process.wait()


def test_accounts_go_on_by_kind(tmp_path, monkeypatch, capsys):
    """Kinds that a file of accounts holds are not repeated; others are added to it."""
    asked = []

    def run(name, count, seed):
        asked.append((name, count))
        return isolation.Account(name, Counter({"fine": count}))

    monkeypatch.setattr(attacks, "KINDS", {"a": (run, 9, 1), "b": (run, 8, 2)})
    for words in (["a"], ["a:9", "b:3"], [], ["--quick"]):
        monkeypatch.setattr(sys, "argv", ["attacks", *words, "-o", str(tmp_path / "accounts.json")])
        assert attacks.main() == 0
    assert asked == [("a", 9), ("b", 3), ("b", 8)]
    assert "| a | 9 | 0 | 9 |" in capsys.readouterr().out


def test_hostile_numbers_reach_no_place_outside_the_arrays():
    """Kernels that turn numbers into indices, at NaN, infinity and the edges of int32: see `tools.attacks.kernels`."""
    for seed in range(30):
        kernels.attempt(np.random.default_rng(seed))


def test_usual_points_are_looked_up_as_ever():
    """The guards change nothing where there is nothing to guard: corner and offset are those of the definition."""
    lattice = kernels.lattice()
    rng = np.random.default_rng(0)
    points = rng.uniform([-1.2, -0.2, 1.8], [0.2, 0.7, 3.7], size=(500, 3)).astype(np.float32)
    level = kernels.struct(kernels.grid.Level, lattice=lattice, features=wp.ones(24, dtype=kernels.Vec32, device="cpu"))
    cells, features = wp.zeros(500, dtype=kernels.Cell, device="cpu"), wp.zeros(500, dtype=kernels.Vec32, device="cpu")
    inputs = [level, wp.array(points, dtype=wp.vec3, device="cpu")]
    wp.launch(kernels.look_up, 500, inputs, [cells, features], device="cpu")
    u = (points - np.float32([-1, 0, 2])) * np.float32(2)
    last = np.array(kernels.SHAPE) - 1
    inside = np.clip(u, 0, last)
    corner = np.minimum(inside.astype(int), last - 1)
    found = cells.numpy()
    np.testing.assert_array_equal(found["corner"], corner)
    np.testing.assert_array_equal(found["offset"], inside - corner)
    np.testing.assert_array_equal(found["free"], (u > 0) & (u < last))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["kernels checked", "kernels from PTX"])
def test_hostile_numbers_in_builds_that_check(name):
    """Every access to an array is checked there."""
    if name == "kernels from PTX" and ptx_on_cpu.c_compiler() is None:
        pytest.skip("no C compiler")
    run, _, few = attacks.KINDS[name]
    account = run(name, few, 0)
    assert not account.failures and account.outcomes == {"ok": few}


@pytest.mark.parametrize("name", ["decoders", "folders replica", "folders tum_rgbd"])
def test_quick_kinds(name):
    """Files whose reading takes milliseconds."""
    run, _, few = attacks.KINDS[name]
    account = run(name, few, 0)
    assert account.tries == few and not account.failures
    assert account.outcomes["typed error"] > 0


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in attacks.KINDS if not name.startswith("kernels ")])
def test_every_kind(name):
    """All kinds at the counts of a quick look; ``python -m tools.attacks`` has those of a release."""
    if name == "folders cofusion":
        pytest.importorskip("OpenEXR", reason="the package openexr is not installed")
    run, _, few = attacks.KINDS[name]
    account = run(name, few, 1)
    assert not account.failures and account.tries > 0


def test_mutations_are_plain_json_and_change_something():
    """What the fuzzer makes of a header can be written again, and is not always what it was."""
    header = {"a": 1, "b": {"c": [1.5, None, "x"]}, "d": True}
    made = [values.mutated_json(header, np.random.default_rng(seed)) for seed in range(50)]
    assert sum(json.dumps(one) != json.dumps(header) for one in made) > 45
    array = np.arange(12.0).reshape(3, 4)
    changed = [values.mutated_array(array, np.random.default_rng(seed)) for seed in range(50)]
    assert sum(one.shape != array.shape or not np.array_equal(one, array) for one in changed) > 40


def test_the_command_knows_its_kinds():
    """An unknown kind is refused by name."""
    done = subprocess.run(
        [sys.executable, "-m", "tools.attacks", "moon:3"], cwd=ROOT, capture_output=True, text=True, check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert done.returncode == 2 and "moon" in done.stderr
