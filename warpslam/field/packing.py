"""Decoder weights as the kernels read them: rows of 32."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import warp as wp

from warpslam.field.decoders import DecoderWeights
from warpslam.kernels import decoder
from warpslam.kernels.grid import Vec32


class PackedDecoder:
    """Weights of one decoder as the kernels read them: rows of 32, and the rows of the transposed matrices.

    weights, transposed: arrays of `Vec32`; layouts in `warpslam.kernels.decoder`.
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
        out = decoder.V + 5 * size
        tensors: dict[str, np.ndarray] = {}
        for k in range(5):
            tensors[f"fc_c.{k}.weight"] = rows[decoder.V + size * k : decoder.V + size * (k + 1)].T.copy()
            tensors[f"fc_c.{k}.bias"] = rows[decoder.FC_BIAS + k].copy()
        tensors["embedder._B"] = rows[:9].reshape(3, 3, 32).transpose(1, 0, 2).reshape(3, 96)[:, :93].copy()
        embedding = {0: rows[decoder.E0 : decoder.E0 + 93].T, 3: rows[decoder.E3 : decoder.E3 + 93].T}
        hidden = {k: rows[w : w + 32].T for k, w in zip((1, 2, 3, 4), _HIDDEN_ROWS, strict=True)}
        for k in range(5):
            parts = [part[k] for part in (embedding, hidden) if k in part]
            tensors[f"pts_linears.{k}.weight"] = np.concatenate(parts, axis=1)
            tensors[f"pts_linears.{k}.bias"] = rows[decoder.BIAS + k].copy()
        weight, bias = (array.copy() for array in self._output)
        # The colour decoder's fourth output takes no part, and keeps the values it was loaded with.
        used = 3 if self.level == "color" else 1
        weight[:used] = rows[out : out + used]
        bias[:used] = rows[out + used, :used]
        tensors["output_linear.weight"], tensors["output_linear.bias"] = weight, bias
        return DecoderWeights(self.level, 32, tensors)


_HIDDEN_ROWS = (decoder.W1, decoder.W2, decoder.W3, decoder.W4)


def _pack(tensors: Mapping[str, np.ndarray], level: str) -> tuple[np.ndarray, np.ndarray]:
    size = 64 if level == "fine" else 32
    outputs = 3 if level == "color" else 1
    out = decoder.V + 5 * size
    rows = np.zeros((out + outputs + 1, 32), np.float32)
    columns = np.zeros((decoder.V_T + 160, 32), np.float32)
    B = np.zeros((3, 96), np.float32)
    B[:, :93] = tensors["embedder._B"]
    rows[:9] = B.reshape(3, 3, 32).transpose(1, 0, 2).reshape(9, 32)
    linears = [tensors[f"pts_linears.{k}.weight"] for k in range(5)]
    for first, first_T, matrix in (
        (decoder.E0, decoder.E0_T, linears[0]),
        (decoder.E3, decoder.E3_T, linears[3][:, :93]),
    ):
        rows[first : first + 93] = matrix.T
        padded = np.pad(matrix, ((0, 0), (0, 3)))
        columns[first_T : first_T + 96] = padded.reshape(32, 3, 32).transpose(1, 0, 2).reshape(96, 32)
    hidden_T = (decoder.W1_T, decoder.W2_T, decoder.W3_T, decoder.W4_T)
    hidden = (linears[1], linears[2], linears[3][:, 93:], linears[4])
    for row, row_T, matrix in zip(_HIDDEN_ROWS, hidden_T, hidden, strict=True):
        rows[row : row + 32] = matrix.T
        columns[row_T : row_T + 32] = matrix
    for k in range(5):
        rows[decoder.BIAS + k] = tensors[f"pts_linears.{k}.bias"]
        rows[decoder.FC_BIAS + k] = tensors[f"fc_c.{k}.bias"]
        matrix = tensors[f"fc_c.{k}.weight"]
        rows[decoder.V + size * k : decoder.V + size * (k + 1)] = matrix.T
        columns[decoder.V_T + 32 * k : decoder.V_T + 32 * (k + 1)] = matrix[:, :32]
    rows[out : out + outputs] = tensors["output_linear.weight"][:outputs]
    rows[out + outputs, :outputs] = tensors["output_linear.bias"][:outputs]
    return rows, columns


def _pack_coarse(tensors: Mapping[str, np.ndarray], level: str) -> tuple[np.ndarray, np.ndarray]:
    linears = [tensors[f"pts_linears.{k}.weight"] for k in range(5)]
    matrices = (linears[0], linears[1], linears[2], linears[3][:, :32], linears[3][:, 32:], linears[4])
    firsts = (decoder.C_W0, decoder.C_W1, decoder.C_W2, decoder.C_C3, decoder.C_W3, decoder.C_W4)
    rows = np.zeros((decoder.C_OUT + 2, 32), np.float32)
    columns = np.zeros((decoder.C_BIAS, 32), np.float32)
    for first, matrix in zip(firsts, matrices, strict=True):
        rows[first : first + 32] = matrix.T
        columns[first : first + 32] = matrix
    for k in range(5):
        rows[decoder.C_BIAS + k] = tensors[f"pts_linears.{k}.bias"]
    rows[decoder.C_OUT] = tensors["output_linear.weight"][0]
    rows[decoder.C_OUT + 1, 0] = tensors["output_linear.bias"][0]
    return rows, columns
