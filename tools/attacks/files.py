"""Maps, checkpoints and decoders of strangers: mutated bytes, and mutated values under a digest that agrees."""

from __future__ import annotations

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
from warpslam.field.decoder_files import DEFAULT_PATH, load_decoders
from warpslam.pipeline.checkpoints import RUN_FORMAT, read_checkpoint
from warpslam.pipeline.run import run
from warpslam.runs.folder import RunFolder
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
    run_folder = RunFolder(folder / "run")
    run(request, run_folder.path, sequence=_Interrupted(sequence, 3))
    whole = folder / "whole.safetensors"
    shutil.copyfile(run_folder.checkpoint, whole)
    frame = scene.frames()[4]

    def attempt(rng: np.random.Generator) -> str:
        run_folder.previous_checkpoint.unlink(missing_ok=True)
        _mutate(whole, run_folder.checkpoint, RUN_FORMAT, rng)
        saved = read_checkpoint(run_folder)
        saved.check(request, sequence)
        return _use(saved.slam(), frame)

    return attempt


class _Interrupted(SyntheticSequence):
    """Ctrl-C comes while a frame is read."""

    def __init__(self, base: SyntheticSequence, at: int) -> None:
        self.__dict__.update(base.__dict__)
        self._at = at

    def __getitem__(self, index: int) -> Any:
        if index == self._at:
            self._at = -1
            raise KeyboardInterrupt
        return super().__getitem__(index)


def _decoders(folder: Path) -> Attempt:
    data = DEFAULT_PATH.read_bytes()
    path = folder / "decoders.pth"
    truth = load_decoders()

    def attempt(rng: np.random.Generator) -> str:
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
        name = str(rng.choice(sorted(arrays)))
        if rng.random() < 0.1:
            del arrays[name]
            break
        arrays[name] = mutated_array(arrays[name], rng)
    text = json.dumps(header)
    if os.path.exists(path):
        os.unlink(path)
    write_state(path, form, json.loads(text), arrays)
