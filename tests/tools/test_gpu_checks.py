"""What is asked of a machine with a GPU, as far as it can be tried without one."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import warp as wp

from tests.test_slam import new_slam
from tools.gpu import check, check_kernels, ptx_on_cpu
from warpslam.config import PRESETS, Config
from warpslam.synthetic import SyntheticSequence

FOLDER = Path(check.__file__).parent
ROOT = FOLDER.parent.parent
STEPS = [
    "info",
    "compile",
    "smoke",
    "parity",
    "replica",
    "phases",
    "slam",
    "kernels",
    "demo",
    "repeat",
    "profile",
    "ncu",
]
STEPS += ["memcheck", "fresh"]


def run_check(folder: Path, *arguments: str, out: Path) -> tuple[str, dict]:
    """What the check of this folder prints, started as check.sh starts it, and its figures."""
    path = os.pathsep.join([str(ROOT), str(folder)])
    environment = {**os.environ, "PYTHONPATH": path, "CHECK_DEVICE": "cpu", "CHECK_SMALL": "1", "CHECK_SLOW": "10"}
    command = [sys.executable, str(folder / "check.py"), *arguments, "--out", str(out)]
    done = subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout, json.loads((out / "figures.json").read_text())


def test_steps_are_whole():
    """Every step is there, in its order, named in the description, with a limit within which a lease can hold it."""
    assert list(check.STEPS) == STEPS
    assert check.__doc__ is not None
    for name, step in check.STEPS.items():
        assert f"\n    {name:9} " in check.__doc__
        assert callable(step.run) and step.run.__doc__ and 10 <= step.limit <= 120


def test_what_the_steps_name_exists():
    """Presets with their settings, test files and single tests; the engine's tests are real ones."""
    for preset, overrides in check.REPLICA_RUNS:
        assert preset in PRESETS
        Config.from_preset(preset, list(overrides))
    for test in (*check.KERNEL_TESTS, *check.NOT_ON_A_DEVICE, *check.ENGINE_TESTS):
        path, _, name = test.partition("::")
        assert (ROOT / path).exists(), test
        assert not name or f"def {name}(" in (ROOT / path).read_text(), test


@pytest.mark.parametrize("copied", [False, True])
def test_runs_in_place_and_as_a_copy(copied, tmp_path):
    """Steps in processes of their own, from tools/gpu or from a copy of four files: all of the smoke test is well."""
    folder = FOLDER
    if copied:
        folder = tmp_path / "copy"
        folder.mkdir()
        for name in ("check.sh", "check.py", "check_kernels.py", "on_cuda.py"):
            (folder / name).write_bytes((FOLDER / name).read_bytes())
    printed, figures = run_check(folder, "all", "info", "smoke", out=tmp_path / "out")
    assert list(figures) == ["info", "smoke"] and all(result["exit"] == 0 for result in figures.values())
    assert figures["info"]["device"] and figures["info"]["warp"] == wp.config.version
    assert "FAILED" not in printed and figures["smoke"]["launch"] == figures["smoke"]["tape"] == "ok"
    assert figures["smoke"]["graph"]["us_a_launch"] > 0


def test_an_unknown_step_is_refused(tmp_path):
    """A misspelt step ends the check before it begins, with the names that there are."""
    with pytest.raises(AssertionError, match="no step smoek: choose from info, compile"):
        run_check(FOLDER, "all", "smoek", out=tmp_path)


@pytest.fixture(scope="module")
def engine():
    """A run over three small frames, and its last frame."""
    small = "mapping.every=1", "keyframes.every=1", "mapping.first_iterations=5", "mapping.iterations=4"
    slam = new_slam(*small, preset="rendering")
    sequence = SyntheticSequence(1, 8, intrinsics=slam.intrinsics)
    for n in range(3):
        frame = sequence[n]
        slam.step(frame.rgb, frame.depth, frame.timestamp, frame.T_world_camera if n == 0 else None)
    return slam, frame


def test_each_launch_of_an_iteration_is_timed(engine):
    """The record of a mapping iteration is found, and all its launches have a time; the engine's calls still run."""
    slam, frame = engine
    program = slam.mapper._launcher._kinds["color"][1]
    figures = check.examine(program, slam.mapper._batch, repeats=1)
    names = {row["kernel"] for row in figures["rows"]}
    assert {"middle_forward", "color_backward", "composite", "adam_rows"} <= names
    assert all(row["us"] > 0 for row in figures["rows"]) and figures["launches"] == len(figures["rows"])
    for function, _ in check.engine_calls(slam, 2, frame).values():
        function()


def test_slam_is_moved_to_the_device_that_is_named(tmp_path):
    """With the plugin the device of a test's Slam is the one in CHECK_DEVICE, whether it was given or not."""
    test = tmp_path / "test_device.py"
    test.write_text(
        "import pytest\n"
        "from tests.test_slam import CAMERA, DECODERS, new_slam\n"
        "from warpslam.slam import Slam\n"
        "@pytest.mark.parametrize('make', [new_slam, lambda: Slam(CAMERA, decoders=DECODERS)])\n"
        "def test_device(make):\n"
        "    with pytest.raises(Exception, match='cuda:77'):\n"
        "        make()\n"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(FOLDER)]), "CHECK_DEVICE": "cuda:77"}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "on_cuda", str(test)]
    done = subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True)
    assert "2 passed" in done.stdout, done.stdout + done.stderr


@pytest.mark.skipif(ptx_on_cpu.c_compiler() is None, reason="no C compiler that could build the translated PTX")
def test_a_kernel_runs_from_ptx(tmp_path, monkeypatch):
    """The adjoint is left out; blocks, threads, arguments and branches of the PTX give what the CPU backend gives."""
    monkeypatch.setattr(ptx_on_cpu, "CACHE", tmp_path)
    n = 700  # three blocks, the last of them not full
    x = wp.array(np.arange(n, dtype=np.float32), device="cpu")
    y = wp.zeros(n, dtype=float, device="cpu")
    runner = ptx_on_cpu.Runner(check=True, count=True, shuffle=True)
    command = ptx_on_cpu.Command(runner, check_kernels.scale, n, [x, 2.5, y], None)
    command.launch()
    np.testing.assert_array_equal(y.numpy(), 2.5 * np.arange(n, dtype=np.float32))
    assert "| scale | 1 | 700 |" in runner.table()

    short = wp.zeros(n - 1, dtype=float, device="cpu")
    with pytest.raises(IndexError, match="scale.* 1 accesses outside its arrays"):
        ptx_on_cpu.Command(runner, check_kernels.scale, n, [x, 2.5, short], None).launch()
