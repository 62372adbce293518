"""Warp says nothing of itself where nothing is wrong."""

from __future__ import annotations

import subprocess
import sys

CODE = """
import warpslam
camera = warpslam.Intrinsics(60, 60, 39.5, 29.5, 80, 60)
slam = warpslam.Slam(camera, device="cpu")
"""


def run(code: str) -> tuple[str, str]:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout, done.stderr


def test_a_program_hears_nothing():
    """Neither on standard output nor on standard error, with a CUDA driver or without."""
    assert run(CODE) == ("", "")


def test_who_wants_to_hear_it_does():
    """A level that was set before stays; and standard error is there again afterwards."""
    before, after = "import sys, warp as wp; wp.config.log_level = wp.LOG_DEBUG", "print('still here', file=sys.stderr)"
    out, err = run(f"{before}{CODE}{after}")
    assert "Devices" in out + err and "still here" in err
