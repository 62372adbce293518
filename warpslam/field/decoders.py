"""Decoder weights: read, check, pad, initialise and write them (paper Sec. 3.1, supplement A.5).

Four small networks turn features into occupancy and colour. Each has five blocks of one hidden width (32 in the paper)
and a skip connection in front of block 3. With e = sin(p . B), p in world metres and c the interpolated feature:

    middle, fine, color:  h = e;  h = ReLU(W_k h + b_k) + V_k c + d_k  (k = 0..4);  h = [e, h] after k = 2
    coarse:               h = c;  h = ReLU(W_k h + b_k)                (k = 0..4);  h = [c, h] after k = 2
    output = W_o h + b_o

The names of the tensors are those of the authors' checkpoints: `pts_linears.k` (W, b), `fc_c.k` (V, d), `embedder._B`
(B, shape (3, 93)) and `output_linear`. All weights are NumPy arrays here; torch is imported only to read or write
its checkpoints.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warpslam.errors import CheckpointError, MissingDependencyError
from warpslam.storage.state_file import StateFormat, write_state

LEVELS = ("coarse", "middle", "fine", "color")
"""Of the map; a stage of mapping is called after the last one that it optimises."""
FEATURE_SIZE = 32
EMBEDDING_SIZE = 93
EMBEDDING_SCALE = 25.0
BLOCK_COUNT = 5
SKIP_BLOCK = 3
MAX_HIDDEN = 32
STATE_FORM = StateFormat("warpslam-decoders", 1, "decoders that `Decoders.save` wrote")
STATE_SUFFIX = ".safetensors"
_OUTPUT_SIZE = {"coarse": 1, "middle": 1, "fine": 1, "color": 4}
_CONDITION_SIZE = {"middle": FEATURE_SIZE, "fine": 2 * FEATURE_SIZE, "color": FEATURE_SIZE}


def expected_shapes(level: str, hidden: int) -> dict[str, tuple[int, ...]]:
    """Name and shape of every tensor of one decoder.

    Args:
        level: "coarse", "middle", "fine" or "color".
        hidden: Width of the blocks.

    Returns:
        Shapes, (out, in) for weights, by the reference's names, in the order the reference saves them.
    """
    shapes: dict[str, tuple[int, ...]] = {}
    # What enters block 0 and, again, the skip: the embedding, or for the coarse level the feature itself.
    entry = FEATURE_SIZE if level == "coarse" else EMBEDDING_SIZE
    if level != "coarse":
        for k in range(BLOCK_COUNT):
            shapes[f"fc_c.{k}.weight"] = (hidden, _CONDITION_SIZE[level])
            shapes[f"fc_c.{k}.bias"] = (hidden,)
        shapes["embedder._B"] = (3, EMBEDDING_SIZE)
    for k in range(BLOCK_COUNT):
        size_in = entry if k == 0 else entry + hidden if k == SKIP_BLOCK else hidden
        shapes[f"pts_linears.{k}.weight"] = (hidden, size_in)
        shapes[f"pts_linears.{k}.bias"] = (hidden,)
    shapes["output_linear.weight"] = (_OUTPUT_SIZE[level], hidden)
    shapes["output_linear.bias"] = (_OUTPUT_SIZE[level],)
    return shapes


@dataclass(frozen=True)
class DecoderWeights:
    """Weights of one decoder.

    Attributes:
        level: "coarse", "middle", "fine" or "color".
        hidden: Width of the blocks, at most 32.
        tensors: float32 arrays by reference name, shapes as `expected_shapes(level, hidden)`.
    """

    level: str
    hidden: int
    tensors: dict[str, np.ndarray]

    def padded(self, hidden: int = MAX_HIDDEN) -> DecoderWeights:
        """Same function with wider blocks.

        The added hidden units have zero weights and biases on both sides, so they stay exactly zero and the output is
        unchanged. Zeros go at the end of each axis: the skip input is [entry, hidden], with the hidden part last.

        Args:
            hidden: New width, at least the present one.
        """
        if hidden < self.hidden:
            raise CheckpointError(f"The {self.level} decoder is {self.hidden} wide; it can't be padded to {hidden}.")
        tensors = {}
        for name, shape in expected_shapes(self.level, hidden).items():
            old = self.tensors[name]
            tensors[name] = np.pad(old, [(0, new - size) for new, size in zip(shape, old.shape, strict=True)])
        return DecoderWeights(self.level, hidden, tensors)


@dataclass(frozen=True)
class Decoders:
    """The four decoders of a map."""

    coarse: DecoderWeights
    middle: DecoderWeights
    fine: DecoderWeights
    color: DecoderWeights

    def __iter__(self) -> Iterator[DecoderWeights]:
        """Coarse, middle, fine, color."""
        return (getattr(self, level) for level in LEVELS)

    def padded(self, hidden: int = MAX_HIDDEN) -> Decoders:
        """All four at one hidden width; computes exactly the same outputs."""
        return Decoders(*(weights.padded(hidden) for weights in self))

    def state_dict(self) -> dict[str, np.ndarray]:
        """All tensors by full name, such as `middle_decoder.fc_c.0.weight` (float32 arrays)."""
        return {f"{w.level}_decoder.{name}": array for w in self for name, array in w.tensors.items()}

    def save(self, path: str | Path) -> None:
        """Write a torch state dict that `load_decoders` and the authors' code both read, or a state file.

        Args:
            path: File to write; its folder is created. One that ends in ``.safetensors`` is a state file, with a check
                sum of all weights.

        Raises:
            CheckpointError: The state file can't be written.
            MissingDependencyError: It is to be a torch checkpoint, and torch is not installed.
        """
        path = Path(path)
        if path.suffix == STATE_SUFFIX:
            write_state(path, STATE_FORM, {}, self.state_dict())
            return
        torch = import_torch()
        path.parent.mkdir(parents=True, exist_ok=True)
        state = {name: torch.from_numpy(np.ascontiguousarray(array)) for name, array in self.state_dict().items()}
        torch.save(state, path)


def random_decoders(seed: int = 0, hidden: int = MAX_HIDDEN) -> Decoders:
    """Untrained decoders, initialised as the reference does.

    Block weights are Xavier uniform with gain sqrt(2) and zero bias, the output layer has gain 1, the feature layers
    `fc_c` are uniform in +-1/sqrt(fan_in) (weight and bias), and B is normal with standard deviation 25 rad/m.

    Args:
        seed: Each decoder draws from its own stream of this seed.
        hidden: Width of the blocks.
    """
    return Decoders(*(random_decoder(level, seed, hidden) for level in LEVELS))


def random_decoder(level: str, seed: int, hidden: int) -> DecoderWeights:
    """Untrained weights of one level, from torch's initialisation of the reference."""
    rng = np.random.default_rng([seed, LEVELS.index(level)])
    tensors = {}
    for name, shape in expected_shapes(level, hidden).items():
        if name == "embedder._B":
            array = rng.normal(0.0, EMBEDDING_SCALE, shape)
        elif name.startswith("fc_c"):
            limit = 1.0 / np.sqrt(_CONDITION_SIZE[level])
            array = rng.uniform(-limit, limit, shape)
        elif name.endswith("bias"):
            array = np.zeros(shape)
        else:
            gain = 1.0 if name.startswith("output") else np.sqrt(2.0)
            limit = gain * np.sqrt(6.0 / sum(shape))
            array = rng.uniform(-limit, limit, shape)
        tensors[name] = array.astype(np.float32)
    return DecoderWeights(level, hidden, tensors)


def import_torch() -> Any:
    """The module torch.

    Raises:
        MissingDependencyError: It is not installed.
    """
    try:
        import torch
    except ImportError as error:
        raise MissingDependencyError("Reading or writing decoder checkpoints needs torch: pip install torch") from error
    return torch
