"""Features that a frozen decoder reads as something known, wherever they lie: fits, once per decoder."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from warpslam.errors import CheckpointError
from warpslam.field.decoders import BLOCK_COUNT, EMBEDDING_SIZE, FEATURE_SIZE, SKIP_BLOCK, DecoderWeights

POINTS = 1500
EXTENT = 6.0
"""Points of a fit lie so far from the origin, along each axis [m]."""
FREE_LOGIT = -1.0
"""Of free space: occupancy 5e-5, so that a ray of 48 samples keeps its light, and its gradient has not vanished yet."""
MAX_FREE_LOGIT = -0.5
"""A decoder that says more at some point has no feature of free space."""
_ITERATIONS = 50
# Weight of the squared features against that of the squared error of the logit: small ones stay within the optimiser's
# reach.
_RIDGE = 1e-3


def free_feature(weights: DecoderWeights) -> np.ndarray:
    """The fixed feature vector of free space (A.2): the decoder's logit is about `FREE_LOGIT` at every point.

    Args:
        weights: Of a decoder with coordinates and one feature, such as the middle one.

    Returns:
        float32 (32,).

    Raises:
        CheckpointError: No such feature was found: at some point the logit exceeds `MAX_FREE_LOGIT`.
    """
    tensors = double_tensors(weights)
    points = np.random.default_rng(0).uniform(-EXTENT, EXTENT, (POINTS, 3))

    def errors(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        logits, by_feature = logit_and_derivative(tensors, points, np.broadcast_to(x, (POINTS, FEATURE_SIZE)))
        return logits - FREE_LOGIT, by_feature

    feature = least_squares(errors, np.zeros(FEATURE_SIZE)).astype(np.float32)
    largest = float((errors(feature.astype(np.float64))[0] + FREE_LOGIT).max())
    if not largest <= MAX_FREE_LOGIT:
        raise CheckpointError(
            f"grid.middle_start = free: the {weights.level} decoder has no feature that it reads as free space "
            f"everywhere (the best one has a logit of {largest:.2f} somewhere): use middle_start = noise"
        )
    return feature


def least_squares(errors: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]], x: np.ndarray) -> np.ndarray:
    """x that makes the mean squared error least, plus a ridge, by Levenberg-Marquardt; float64 (n,).

    Args:
        errors: Errors (N,) for an x, and their derivatives by it (N, n).
        x: To start from, float64 (n,).
    """
    damping = 1.0
    error, J = errors(x)
    cost = np.mean(error**2) + _RIDGE * x @ x
    for _ in range(_ITERATIONS):
        H = J.T @ J / len(error)
        H += np.diag(damping * np.diag(H) + _RIDGE)
        candidate = x - np.linalg.solve(H, J.T @ error / len(error) + _RIDGE * x)
        new_error, new_J = errors(candidate)
        new_cost = np.mean(new_error**2) + _RIDGE * candidate @ candidate
        if new_cost < cost:
            x, error, J, cost = candidate, new_error, new_J, new_cost
            damping = max(damping / 3.0, 1e-4)
        else:
            damping *= 3.0
    return x


def double_tensors(weights: DecoderWeights) -> dict[str, np.ndarray]:
    """Tensors of a decoder at full width, float64, by the reference's names."""
    return {name: tensor.astype(np.float64) for name, tensor in weights.padded().tensors.items()}


def logit_and_derivative(
    tensors: dict[str, np.ndarray], points: np.ndarray, features: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Logits (N,) of a decoder at points (N, 3) [m] with features (N, 32), and their derivatives by those, (N, 32).

    tensors: By the reference's names, see `warpslam.field.decoders`.
    """
    embedding = np.sin(points @ tensors["embedder._B"])
    h = embedding
    active = []
    for k in range(BLOCK_COUNT):
        entry = np.concatenate([embedding, h], axis=1) if k == SKIP_BLOCK else h
        a = entry @ tensors[f"pts_linears.{k}.weight"].T + tensors[f"pts_linears.{k}.bias"]
        active.append(a > 0)
        h = np.maximum(a, 0.0) + features @ tensors[f"fc_c.{k}.weight"].T + tensors[f"fc_c.{k}.bias"]
    output = tensors["output_linear.weight"][0]
    g = np.broadcast_to(output, h.shape)
    by_feature = np.zeros_like(features)
    for k in reversed(range(BLOCK_COUNT)):
        by_feature += g @ tensors[f"fc_c.{k}.weight"]
        if k > 0:
            weight = tensors[f"pts_linears.{k}.weight"]
            g = (g * active[k]) @ (weight[:, EMBEDDING_SIZE:] if k == SKIP_BLOCK else weight)
    return h @ output + tensors["output_linear.bias"][0], by_feature
