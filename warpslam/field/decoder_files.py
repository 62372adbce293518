"""Decoder weights from files: torch checkpoints, ours, the authors' and others' with the same names; and state files,
which need no torch: importing it takes seconds and 200 MB, so the package's own weights are one.
"""

from __future__ import annotations

import contextlib
import os
import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from warpslam.errors import CheckpointError, brief
from warpslam.field.decoders import (
    BLOCK_COUNT,
    EMBEDDING_SIZE,
    FEATURE_SIZE,
    LEVELS,
    MAX_HIDDEN,
    STATE_FORM,
    STATE_SUFFIX,
    Decoders,
    DecoderWeights,
    expected_shapes,
    import_torch,
    random_decoder,
)
from warpslam.reading import MEGABYTE, check_regular
from warpslam.storage.state_file import read_state

DEFAULT_PATH = Path(__file__).parents[1] / "data" / "decoders.safetensors"
_FILE_LIMIT = 512 * MEGABYTE
_NESTING_KEYS = ("decoder_state_dict", "decoders", "model", "state_dict", "decoder")


def load_decoders(
    path: str | Path | None = None,
    *,
    coarse: str | Path | None = None,
    middle_fine: str | Path | None = None,
    color_seed: int = 0,
) -> Decoders:
    """Read decoder weights from torch checkpoints, or from a state file.

    Args:
        path: What `Decoders.save` wrote, or a state dict with the prefixes `coarse_decoder.`, `middle_decoder.`,
            `fine_decoder.`, `color_decoder.` (hidden width at most 32, possibly nested under a key such as `model`),
            or a folder that holds `coarse.pt` and `middle_fine.pt`. With neither this nor the next two, the weights
            that come with warpslam.
        coarse: The authors' `coarse.pt`. Give `middle_fine`, too.
        middle_fine: The authors' `middle_fine.pt`.
        color_seed: Seed of the colour decoder, which the authors' files do not contain.

    Returns:
        Float32 weights at the width found in the file; call `.padded()` for the width the kernels expect.

    Raises:
        CheckpointError: A file is missing, is no checkpoint, or lacks a tensor; a shape is wrong; a weight is not
            finite.
        MissingDependencyError: The file is a torch checkpoint, and torch is not installed.
    """
    if coarse is not None or middle_fine is not None:
        if path is not None:
            raise CheckpointError("Give either `path` or the pair `coarse` and `middle_fine`, not both.")
        if coarse is None or middle_fine is None:
            missing = "coarse" if coarse is None else "middle_fine"
            raise CheckpointError(f"The authors' weights come as a pair of files; `{missing}` is not given.")
        return _load_pair(Path(coarse), Path(middle_fine), color_seed)
    path = DEFAULT_PATH if path is None else Path(path)
    if os.path.isdir(path):  # whatever the path
        return _load_pair(path / "coarse.pt", path / "middle_fine.pt", color_seed)
    state = _find_state(_read_checkpoint(path), path)
    return Decoders(*(_collect(state, f"{level}_decoder.", level, path) for level in LEVELS))


def _load_pair(coarse: Path, middle_fine: Path, color_seed: int) -> Decoders:
    """The authors' two files; their `decoder.coarse.` is the middle level here."""
    coarse_state = _authors_state(coarse)
    state = _authors_state(middle_fine)
    return Decoders(
        _collect(coarse_state, "decoder.", "coarse", coarse),
        _collect(state, "decoder.coarse.", "middle", middle_fine),
        _collect(state, "decoder.fine.", "fine", middle_fine),
        random_decoder("color", color_seed, MAX_HIDDEN),
    )


def _authors_state(path: Path) -> dict[str, Any]:
    checkpoint = _read_checkpoint(path)
    state = checkpoint.get("model", checkpoint)
    if not isinstance(state, Mapping):
        raise CheckpointError(f"{path}: the key `model` holds a {type(state).__name__}; expected a state dict.")
    return {key: value for key, value in state.items() if "decoder" in str(key) and "encoder" not in str(key)}


def _find_state(checkpoint: Mapping[str, Any], path: Path) -> Mapping[str, Any]:
    """The mapping with our prefixes: the checkpoint itself or one level below."""
    nested = [checkpoint[key] for key in _NESTING_KEYS if isinstance(checkpoint.get(key), Mapping)]
    nested += [value for key, value in checkpoint.items() if isinstance(value, Mapping) and key not in _NESTING_KEYS]
    prefixes = tuple(f"{level}_decoder." for level in LEVELS)
    for state in (checkpoint, *nested):
        if any(str(key).startswith(prefixes) for key in state):
            return state
    raise CheckpointError(
        f"{path}: no key starts with {', '.join(prefixes)} (found: {_preview(checkpoint)}). Give a NICE-SLAM decoder "
        "state dict, or the authors' two files as `coarse` and `middle_fine` (or the folder that holds both)."
    )


def _collect(state: Mapping[str, Any], prefix: str, level: str, path: Path) -> DecoderWeights:
    """Check and convert the tensors of one level."""
    found = {str(key)[len(prefix) :]: value for key, value in state.items() if str(key).startswith(prefix)}
    if not found:
        raise CheckpointError(
            f"{path}: the {level} decoder is missing: no key starts with {prefix!r} (found: {_preview(state)})."
        )
    hidden = _hidden_width(found, prefix, level, path)
    shapes = expected_shapes(level, hidden)
    tensors = {}
    for name, shape in shapes.items():
        if name not in found:
            raise CheckpointError(
                f"{path}: key {prefix + name!r} is missing, expected shape {shape}. The file is incomplete; save the "
                "whole state dict of the decoders again."
            )
        tensors[name] = _to_array(found[name], shape, prefix + name, path)
    unexpected = sorted(set(found) - set(shapes))
    if unexpected:
        raise CheckpointError(
            f"{path}: unexpected key {prefix + unexpected[0]!r} (and {len(unexpected) - 1} more): the {level} decoder "
            f"here has {BLOCK_COUNT} blocks, see warpslam.field.decoders. Only this architecture is supported."
        )
    return DecoderWeights(level, hidden, tensors)


def _hidden_width(found: Mapping[str, Any], prefix: str, level: str, path: Path) -> int:
    name = "pts_linears.0.bias"
    if name not in found:
        raise CheckpointError(f"{path}: key {prefix + name!r} is missing, expected shape (hidden width,).")
    shape = tuple(getattr(found[name], "shape", ()))
    if len(shape) != 1 or not 1 <= shape[0] <= MAX_HIDDEN:
        raise CheckpointError(
            f"{path}: key {prefix + name!r} has shape {shape}, expected (hidden width,) with a width of 1 to "
            f"{MAX_HIDDEN}. Wider {level} decoders are not supported."
        )
    return int(shape[0])


def _to_array(value: Any, shape: tuple[int, ...], key: str, path: Path) -> np.ndarray:
    if tuple(getattr(value, "shape", shape)) != shape:
        raise CheckpointError(
            f"{path}: key {key!r} has shape {tuple(value.shape)}, expected {shape}. The feature size must be "
            f"{FEATURE_SIZE} and the embedding size {EMBEDDING_SIZE}."
        )
    if isinstance(value, np.ndarray) and value.dtype.kind == "f":
        array = value.astype(np.float32)
    else:
        torch = import_torch()
        if not isinstance(value, torch.Tensor) or value.layout != torch.strided or value.is_quantized:
            raise CheckpointError(f"{path}: key {key!r} is a {type(value).__name__}, expected a dense tensor {shape}.")
        array = value.detach().to(device="cpu", dtype=torch.float32).contiguous().numpy().copy()
    if not np.isfinite(array).all():
        bad = int((~np.isfinite(array)).sum())
        raise CheckpointError(
            f"{path}: key {key!r} has {bad} of {array.size} weights that are NaN or infinite. "
            "Use an earlier checkpoint of the training run."
        )
    return array


def _read_checkpoint(path: Path) -> Mapping[str, Any]:
    """Load a checkpoint without running code from it."""
    if not os.path.isfile(path):
        raise CheckpointError(
            f"{path}: there is no such file. Give the path of a decoder checkpoint (.pth, .pt or .safetensors), or of "
            "a folder that holds coarse.pt and middle_fine.pt."
        )
    if path.suffix == STATE_SUFFIX:
        return read_state(path, STATE_FORM)[1]
    torch = import_torch()
    _check_sums(path)
    try:
        with _numpy_scalars_allowed(torch), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    # A damaged file can fail in the zip reader, the unpickler or the storage reader, each with its own exception type.
    except Exception as error:
        reason = str(error).strip().splitlines()[0][:200] if str(error).strip() else type(error).__name__
        raise CheckpointError(
            f"{path}: not a torch checkpoint of tensors, or damaged ({type(error).__name__}: {reason}). Download or "
            "save it again; a file that carries Python objects has to be re-saved as a plain state dict."
        ) from error
    if not isinstance(checkpoint, Mapping):
        raise CheckpointError(f"{path}: holds a {type(checkpoint).__name__}, expected a state dict.")
    return checkpoint


def _check_sums(path: Path) -> None:
    """The check sums of a zip file, which torch writes and does not look at: one bit would make other weights.

    Files of torch before 1.6 are no zip files, and have none.
    """
    try:
        check_regular(path, _FILE_LIMIT)
        if not zipfile.is_zipfile(path):
            return
        with zipfile.ZipFile(path) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > 2 * _FILE_LIMIT:
                raise CheckpointError(f"{path}: unpacks to more than any decoder has. Use another copy.")
            damaged = archive.testzip()
    except OSError as error:
        why = error.strerror or error
        raise CheckpointError(f"{path}: can't be read ({why}). Download or save it again.") from error
    except Exception as error:  # zipfile has many
        raise CheckpointError(f"{path}: damaged ({brief(error)}). Download or save it again.") from error
    if damaged is not None:
        raise CheckpointError(
            f"{path}: the check sum of its part {brief(damaged)!r} does not agree with the content, which is truncated "
            "or altered. Download or save it again."
        )


def _numpy_scalars_allowed(torch: Any) -> contextlib.AbstractContextManager[None]:
    """Training scripts often store their best loss as a NumPy scalar; that is data, not code."""
    safe_globals = getattr(torch.serialization, "safe_globals", None)
    if safe_globals is None:
        return contextlib.nullcontext()
    scalar = np.float64(0).__reduce__()[0]
    allowed = [(scalar, f"numpy.{core}.multiarray.scalar") for core in ("core", "_core")]
    return safe_globals([*allowed, np.dtype, type(np.dtype(np.float64)), type(np.dtype(np.float32))])


def _preview(state: Mapping[str, Any]) -> str:
    keys = [str(key) for key in list(state)[:4]]
    return ", ".join(keys) + (", ..." if len(state) > 4 else "") if keys else "no keys at all"
