"""Run folders whose files somebody has altered: the commands that read them give a result or a line."""

from __future__ import annotations

import contextlib
import io
import json
import shutil
import tempfile
from pathlib import Path

import numpy as np

from tools.attacks import scene
from tools.attacks.isolation import TYPED, Attempt
from tools.attacks.values import mutated_bytes, mutated_json
from warpslam import cli
from warpslam.cli.exit_codes import EXIT_ERROR, EXIT_UNEXPECTED
from warpslam.pipeline.run import run
from warpslam.runs.request import RunRequest, Source
from warpslam.synthetic import SyntheticSequence, write_sequence

_TEXTS = ("metrics.json", "timing.json", "frames.json", "input.json", "manifest.json")
_OTHERS = (
    "config.yaml", "trajectory.tum", "ground_truth.tum", "frames.csv", "panels.npz", "map.safetensors", "mesh.ply",
    "log.txt", "panels.png",
)  # fmt: skip
_COMMANDS = (
    ("report",), ("eval",), ("check",), ("report",), ("run", "--resume"), ("mesh", "--voxel", "0.2"),
    ("render", "--frame", "1"),
)  # fmt: skip


def prepare(name: str) -> Attempt:
    """One small run."""
    home = Path(tempfile.mkdtemp(prefix="warpslam-attacks-"))
    sequence = SyntheticSequence(1, 3, intrinsics=scene.CAMERA)
    write_sequence(sequence, home / "sequence")
    whole = home / "whole"
    settings = (*scene.SMALL, "meshing.voxel=0.1", "mapping.first_iterations=5", "mapping.iterations=2")
    request = RunRequest(Source(str(home / "sequence")), overrides=settings, preset="default", device="cpu")
    run(request, whole)

    def attempt(rng: np.random.Generator) -> str:
        folder = home / "run"
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(whole, folder)
        for _ in range(int(rng.integers(1, 3))):
            _alter(folder, rng)
        command, *options = _COMMANDS[rng.integers(0, len(_COMMANDS))]
        said = io.StringIO()
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            try:
                code = cli.main([command, *options, str(folder)])
            except SystemExit as error:
                code = int(error.code or 0)
        text = said.getvalue()
        assert "Traceback" not in text, "a traceback"
        if code == EXIT_UNEXPECTED:
            raise RuntimeError(text.strip()[-300:])
        assert len(text) < 20000, f"{len(text)} letters"
        return TYPED if code == EXIT_ERROR else f"exit {code}"

    return attempt


def _alter(folder: Path, rng: np.random.Generator) -> None:
    text = rng.random() < 0.6
    path = folder / str(rng.choice(_TEXTS if text else _OTHERS))
    if not path.is_file():
        return
    if rng.random() < 0.1:
        path.unlink()
        return
    data = path.read_bytes()
    if text and rng.random() < 0.7:
        with contextlib.suppress(ValueError):  # it has been altered before
            data = json.dumps(mutated_json(json.loads(data), rng)).encode()
            path.write_bytes(data)
            return
    path.write_bytes(mutated_bytes(data, rng))
