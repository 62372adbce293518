"""Decoder weights as the kernels read them: rows of 32."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import warp as wp

from warpslam.field.decoders import DecoderWeights
from warpslam.kernels.decoder import layout
from warpslam.kernels.grid import Vec32


class PackedDecoder:
    """Weights of one decoder as the kernels read them: rows of 32, and the rows of the transposed matrices.

    weights, transposed: arrays of `Vec32`; rows in `warpslam.kernels.decoder.layout`.
    """

    def __init__(self, weights: DecoderWeights, device: wp.Device) -> None:
        self.level = weights.level
        self.device = device
        tensors = weights.padded().tensors
        rows, columns = (_pack_coarse if self.level == "coarse" else _pack)(tensors, self.level)
        self.weights = wp.array(rows, dtype=Vec32, device=device)
        self.transposed = wp.array(columns, dtype=Vec32, device=device)
        self._output = tensors["output_linear.weight"], tensors["output_linear.bias"]

    def unpack(self) -> DecoderWeights:
        """The weights by the reference's names (hidden width 32), as they are now."""
        if self.level == "coarse":
            raise NotImplementedError("the coarse decoder is never trained: keep the weights it was made from")
        rows = self.weights.numpy()
        size = 64 if self.level == "fine" else 32
        out = layout.V + 5 * size
        tensors: dict[str, np.ndarray] = {}
        for k in range(5):
            tensors[f"fc_c.{k}.weight"] = rows[layout.V + size * k : layout.V + size * (k + 1)].T.copy()
            tensors[f"fc_c.{k}.bias"] = rows[layout.FC_BIAS + k].copy()
        tensors["embedder._B"] = rows[:9].reshape(3, 3, 32).transpose(1, 0, 2).reshape(3, 96)[:, :93].copy()
        embedding = {0: rows[layout.E0 : layout.E0 + 93].T, 3: rows[layout.E3 : layout.E3 + 93].T}
        hidden = {k: rows[w : w + 32].T for k, w in zip((1, 2, 3, 4), _HIDDEN_ROWS, strict=True)}
        for k in range(5):
            parts = [part[k] for part in (embedding, hidden) if k in part]
            tensors[f"pts_linears.{k}.weight"] = np.concatenate(parts, axis=1)
            tensors[f"pts_linears.{k}.bias"] = rows[layout.BIAS + k].copy()
        weight, bias = (array.copy() for array in self._output)
        # The colour decoder's fourth output takes no part, and keeps the values it was loaded with.
        used = 3 if self.level == "color" else 1
        weight[:used] = rows[out : out + used]
        bias[:used] = rows[out + used, :used]
        tensors["output_linear.weight"], tensors["output_linear.bias"] = weight, bias
        return DecoderWeights(self.level, 32, tensors)


_HIDDEN_ROWS = (layout.W1, layout.W2, layout.W3, layout.W4)


def _pack(tensors: Mapping[str, np.ndarray], level: str) -> tuple[np.ndarray, np.ndarray]:
    size = 64 if level == "fine" else 32
    outputs = 3 if level == "color" else 1
    out = layout.V + 5 * size
    rows = np.zeros((out + outputs + 1, 32), np.float32)
    columns = np.zeros((layout.V_T + 160, 32), np.float32)
    B = np.zeros((3, 96), np.float32)
    B[:, :93] = tensors["embedder._B"]
    rows[:9] = B.reshape(3, 3, 32).transpose(1, 0, 2).reshape(9, 32)
    linears = [tensors[f"pts_linears.{k}.weight"] for k in range(5)]
    for first, first_T, matrix in (
        (layout.E0, layout.E0_T, linears[0]),
        (layout.E3, layout.E3_T, linears[3][:, :93]),
    ):
        rows[first : first + 93] = matrix.T
        padded = np.pad(matrix, ((0, 0), (0, 3)))
        columns[first_T : first_T + 96] = padded.reshape(32, 3, 32).transpose(1, 0, 2).reshape(96, 32)
    hidden_T = (layout.W1_T, layout.W2_T, layout.W3_T, layout.W4_T)
    hidden = (linears[1], linears[2], linears[3][:, 93:], linears[4])
    for row, row_T, matrix in zip(_HIDDEN_ROWS, hidden_T, hidden, strict=True):
        rows[row : row + 32] = matrix.T
        columns[row_T : row_T + 32] = matrix
    for k in range(5):
        rows[layout.BIAS + k] = tensors[f"pts_linears.{k}.bias"]
        rows[layout.FC_BIAS + k] = tensors[f"fc_c.{k}.bias"]
        matrix = tensors[f"fc_c.{k}.weight"]
        rows[layout.V + size * k : layout.V + size * (k + 1)] = matrix.T
        columns[layout.V_T + 32 * k : layout.V_T + 32 * (k + 1)] = matrix[:, :32]
    rows[out : out + outputs] = tensors["output_linear.weight"][:outputs]
    rows[out + outputs, :outputs] = tensors["output_linear.bias"][:outputs]
    return rows, columns


def _pack_coarse(tensors: Mapping[str, np.ndarray], level: str) -> tuple[np.ndarray, np.ndarray]:
    linears = [tensors[f"pts_linears.{k}.weight"] for k in range(5)]
    matrices = (linears[0], linears[1], linears[2], linears[3][:, :32], linears[3][:, 32:], linears[4])
    firsts = (layout.C_W0, layout.C_W1, layout.C_W2, layout.C_C3, layout.C_W3, layout.C_W4)
    rows = np.zeros((layout.C_OUT + 2, 32), np.float32)
    columns = np.zeros((layout.C_BIAS, 32), np.float32)
    for first, matrix in zip(firsts, matrices, strict=True):
        rows[first : first + 32] = matrix.T
        columns[first : first + 32] = matrix
    for k in range(5):
        rows[layout.C_BIAS + k] = tensors[f"pts_linears.{k}.bias"]
    rows[layout.C_OUT] = tensors["output_linear.weight"][0]
    rows[layout.C_OUT + 1, 0] = tensors["output_linear.bias"][0]
    return rows, columns
