"""Fixtures that more than one test folder uses."""

from __future__ import annotations

import os
import signal
from functools import partial
from pathlib import Path

import numpy as np
import pytest

REPOSITORY = Path(__file__).resolve().parent.parent

LONGEST = (
    "examples/test_examples.py", "tracking/test_localizer.py", "kernels/test_cuda_compile.py", "test_slam.py",
    "pipeline/test_resume.py", "report/test_comparison.py", "mapping/test_mapper.py", "baselines/test_imap.py",
    "batch/test_batch_resume.py", "batch/test_cluster.py", "tools/test_gpu_checks.py", "tools/test_pretraining.py",
    "tools/test_decoder_comparison.py", "synthetic/test_moving.py", "mapping/test_scheduler.py",
)  # fmt: skip
"""Files that take longest, the longest first."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest files come first: of several workers, none is left alone with one at the end."""
    rank = {REPOSITORY / "tests" / name: number for number, name in enumerate(LONGEST)}
    items.sort(key=lambda item: rank.get(item.path, len(rank)))


def _shared_path(variable: str, default: str) -> Path:
    """Path named by an environment variable, else ``default`` beside the repository; skips if it isn't there."""
    path = Path(os.environ[variable]) if variable in os.environ else REPOSITORY.parent / "shared" / default
    if not path.exists():
        pytest.skip(f"no test data at {path}: set {variable} to where it is")
    return path


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder with the test sequences, one folder each."""
    return _shared_path("WARPSLAM_DATA", "data")


@pytest.fixture
def small_evaluation(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fewer points and virtual views than the protocols have."""
    from warpslam.evaluation import protocols, virtual_views

    few_points = partial(protocols.evaluate_reconstruction, sample_count=20_000)
    monkeypatch.setattr(protocols, "evaluate_reconstruction", few_points)
    monkeypatch.setattr(virtual_views, "VIEW_COUNT", 2)
    monkeypatch.setattr(virtual_views, "CULLING_VIEW_COUNT", 4)


@pytest.fixture(scope="session")
def golden() -> np.lib.npyio.NpzFile:
    """Reference vectors: inputs and outputs of the authors' implementation on a small scene."""
    return np.load(_shared_path("WARPSLAM_GOLDEN", "golden/reference_vectors.npz"))


@pytest.fixture
def ctrl_c():
    """SIGINT is ctrl-C, as in a terminal; a shell makes what it runs in the background ignore it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)
