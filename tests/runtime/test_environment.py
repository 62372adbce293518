"""Memory and cores of this process, and what is installed, as the system tells."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import psutil
import pytest
import torch
import warp as wp

from warpslam.errors import ConfigError
from warpslam.runtime import cores, environment

_GROW = """
import json
import numpy as np
from warpslam.runtime import environment

before = environment.resident_bytes()
array = np.ones(8 << 20)
print(json.dumps([before, environment.resident_bytes() - before, array.nbytes, environment.peak_memory_mib()]))
"""


def test_memory_of_a_process():
    """What an array takes is seen while it is there, and the peak is never below; in a new process, as a long one gives
    memory back whenever it likes.
    """
    done = subprocess.run([sys.executable, "-c", _GROW], capture_output=True, text=True, check=True)
    before, grown, size, peak_mib = json.loads(done.stdout)
    assert 0.8 * size < grown < 2 * size
    assert peak_mib * 2**20 >= 0.99 * (before + grown)


def test_memory_that_is_free():
    """The machine has more than nothing."""
    assert 0.0 < environment.free_gigabytes(wp.get_device("cpu")) < 1e5


def test_cores_are_those_of_the_process(monkeypatch):
    """Those it is pinned to, ascending; all of them where the system pins nothing."""
    if hasattr(os, "sched_getaffinity"):
        assert cores.process_cores() == sorted(os.sched_getaffinity(0))
    monkeypatch.setattr("psutil.Process.cpu_affinity", lambda self: [4, 0, 2], raising=False)
    assert cores.process_cores() == [0, 2, 4]
    monkeypatch.delattr("psutil.Process.cpu_affinity")
    assert cores.process_cores() == list(range(psutil.cpu_count()))


@pytest.mark.parametrize(("text", "count"), [("", 3), ("2", 2), ("9", 3)])
def test_threads_can_be_fewer_than_cores(monkeypatch, text, count):
    """WARPSLAM_THREADS lowers the number and never raises it."""
    monkeypatch.setattr(cores, "process_cores", lambda: [0, 1, 2])
    monkeypatch.setenv("WARPSLAM_THREADS", text)
    assert cores._core_count.__wrapped__() == count
    monkeypatch.setenv("WARPSLAM_THREADS", "many")
    with pytest.raises(ConfigError, match="WARPSLAM_THREADS = 'many'"):
        cores._core_count.__wrapped__()


def test_torch_build_is_that_which_loads(monkeypatch):
    """What its version file says agrees with what the loaded package says; without a package there is none."""
    build = environment.torch_build()
    expected = f"CUDA {torch.version.cuda}" if torch.version.cuda else "CPU only"
    assert build is not None and build.target == expected and 1e7 < build.bytes < 1e11
    monkeypatch.setattr(environment, "find_spec", lambda name: None)
    assert environment.torch_build() is None
