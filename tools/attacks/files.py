"""Maps, checkpoints and decoders of strangers: mutated bytes, and mutated values under a digest that agrees."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from tools.attacks import scene
from tools.attacks.isolation import Attempt
from tools.attacks.values import mutated_array, mutated_bytes, mutated_json
from warpslam.field.decoder_files import load_decoders
from warpslam.pipeline.checkpoints import RUN_FORMAT, read_checkpoint
from warpslam.pipeline.observer import Observer
from warpslam.pipeline.run import run
from warpslam.pipeline.setup import resolve
from warpslam.runs.folder import RunFolder
from warpslam.runs.record import Progress
from warpslam.runs.request import RunRequest
from warpslam.slam import Slam
from warpslam.slam_state import MAP_FORMAT
from warpslam.storage.state_file import read_state, write_state
from warpslam.synthetic import SyntheticSequence


def prepare(name: str) -> Attempt:
    """``name`` is "maps", "checkpoints" or "decoders"."""
    folder = Path(tempfile.mkdtemp(prefix="warpslam-attacks-"))
    return {"maps": _maps, "checkpoints": _checkpoints, "decoders": _decoders}[name](folder)


def _maps(folder: Path) -> Attempt:
    whole, path = folder / "whole.safetensors", folder / "map.safetensors"
    slam = scene.small_slam(count=4)
    slam.save(whole)
    frame = scene.frames()[4]

    def attempt(rng: np.random.Generator) -> str:
        _mutate(whole, path, MAP_FORMAT, rng)
        loaded = Slam.load(path, "cpu", localize_only=bool(rng.integers(0, 2)))
        return _use(loaded, frame)

    return attempt


def _use(slam: Slam, frame: Any) -> str:
    """Everything that reads the map."""
    result = slam.step(frame.rgb, frame.depth, frame.timestamp + 10.0)
    image = slam.render(result.T_world_camera, stride=8)
    assert np.isfinite(image.depth).all(), "a rendering that is not finite"
    assert np.isfinite(slam.trajectory.poses).all(), "a trajectory that is not finite"
    slam.mesh(0.3)
    return str(result.status)


def _checkpoints(folder: Path) -> Attempt:
    sequence = SyntheticSequence(1, 4, intrinsics=scene.CAMERA)
    request = RunRequest(overrides=scene.SMALL, preset="default", device="cpu", checkpoint_every=2)
    request = resolve(request, sequence)
    run_folder = RunFolder(folder / "run")
    whole = folder / "whole.safetensors"
    with contextlib.suppress(_Enough):
        run(request, run_folder.path, sequence=sequence, observer=_Copier(run_folder.checkpoint, whole))
    frame = scene.frames()[4]

    def attempt(rng: np.random.Generator) -> str:
        run_folder.previous_checkpoint.unlink(missing_ok=True)
        _mutate(whole, run_folder.checkpoint, RUN_FORMAT, rng)
        saved = read_checkpoint(run_folder)
        saved.check(request, sequence)
        return _use(saved.slam(), frame)

    return attempt


class _Enough(Exception):  # noqa: N818
    """The checkpoint is there, and the rest of the run of no use."""


class _Copier(Observer):
    """Keeps the second checkpoint of a run."""

    def __init__(self, checkpoint: Path, copy: Path) -> None:
        self._checkpoint, self._copy = checkpoint, copy

    def frame(self, progress: Progress) -> None:
        if progress.done == 3:
            shutil.copyfile(self._checkpoint, self._copy)
            raise _Enough


def _decoders(folder: Path) -> Attempt:
    truth = load_decoders()
    paths = [folder / f"decoders{suffix}" for suffix in (".pth", ".safetensors")]
    for path in paths:
        truth.save(path)
    whole = [path.read_bytes() for path in paths]

    def attempt(rng: np.random.Generator) -> str:
        kind = int(rng.integers(0, len(paths)))
        path, data = paths[kind], whole[kind]
        changed = bytearray(data)
        if rng.random() < 0.5:
            changed[rng.integers(0, len(data))] ^= 1 << int(rng.integers(0, 8))
        else:
            changed = bytearray(mutated_bytes(data, rng))
        path.write_bytes(changed)
        loaded = load_decoders(path)
        for ours, theirs in zip(truth, loaded, strict=True):
            for key, tensor in ours.tensors.items():
                assert np.array_equal(tensor, theirs.tensors[key]), f"other weights: {ours.level} {key}"
        return "the same weights"

    return attempt


def _mutate(whole: Path, path: Path, form: Any, rng: np.random.Generator) -> None:
    """One file of another: wrong bytes, or wrong values that are written as if they were right."""
    if rng.random() < 0.25:
        path.write_bytes(mutated_bytes(whole.read_bytes(), rng))
        return
    header, arrays = read_state(whole, form)
    arrays = dict(arrays)
    if rng.random() < 0.5:
        header = mutated_json(header, rng)
    for _ in range(int(rng.integers(0, 4))):
        # Weights of decoders are many, and all alike.
        groups: dict[str, list[str]] = {}
        for name in sorted(arrays):
            groups.setdefault(name.partition(":")[0].partition("_")[0], []).append(name)
        name = str(rng.choice(groups[str(rng.choice(sorted(groups)))]))
        if rng.random() < 0.1:
            del arrays[name]
            break
        arrays[name] = mutated_array(arrays[name], rng)
    text = json.dumps(header)
    if os.path.exists(path):
        os.unlink(path)
    write_state(path, form, json.loads(text), arrays)
