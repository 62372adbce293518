"""Suite files for tests, and runs that need no SLAM."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from warpslam.batch import local as batch


@pytest.fixture
def write_suite(tmp_path: Path) -> Callable[..., Path]:
    """Write a suite of one sequence ``room`` and the studies that are named; further fields as given."""

    def write(*studies: str, **fields: Any) -> Path:
        content = {
            "sequences": {"room": {"path": "data/room", "preset": "default"}},
            "studies": dict.fromkeys(studies or ("tracking", "color")),
            **fields,
        }
        path = tmp_path / "suite.yaml"
        path.write_text(yaml.safe_dump(content))
        return path

    return write


@pytest.fixture
def fake_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Workers whose runs are those of `tests.bench.fake_worker`."""
    worker = str(Path(__file__).with_name("fake_worker.py"))
    monkeypatch.setattr(batch, "WORKER_COMMAND", (sys.executable, worker))
