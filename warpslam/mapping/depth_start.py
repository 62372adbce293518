"""Features to start from where a frame measures a surface for the first time.

The paper starts every vertex from noise and leaves the rest to the optimiser, which needs tens of iterations with rays
near the vertex. But what a vertex of the middle level has to say is known as soon as its depth is: how far it lies from
the measured surface. So a vertex that is seen for the first time starts from a feature f(s) = base + s * slope, s being
its signed distance along the ray (z-depth, positive behind the surface). Base and slope are fitted once per decoder, so
that the decoder reads s times a steepness from f(s), wherever the vertex lies. Trilinear interpolation of such features
is the feature of the interpolated distance: planes come out exactly, and the optimiser starts from a surface that is
off by centimetres where the decoder or the scene is not so simple.

That is for given poses, where it is the default. A tracked camera believes a sharp surface, and at the border of what
was mapped the start is sharp and wrong: it may drift with its own guesses.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from warpslam.camera import Intrinsics
from warpslam.field.arrays import projection, struct
from warpslam.field.decoders import BLOCK_COUNT, EMBEDDING_SIZE, FEATURE_SIZE, SKIP_BLOCK, DecoderWeights
from warpslam.kernels import seen
from warpslam.kernels.grid import Vec32
from warpslam.mapping.frustum import REACH
from warpslam.runtime.phases import phase
from warpslam.scene.feature_grid import FeatureGrid

# Of the logit by the distance, and the largest distance, in vertex spacings.
STEEPNESS = 2.56
TRUNCATION = 1.6
_POINTS = 1500
_EXTENT = 6.0  # [m] points of the fit lie so far from the origin, along each axis
_ITERATIONS = 50
# Weight of the squared features against that of the squared error of the logit: small ones stay within the optimiser's
# reach.
_RIDGE = 1e-3


class DepthStart:
    """Starts the vertices of a grid of the middle level.

    base, slope: float32 (32,) each; slope per metre.
    """

    def __init__(self, weights: DecoderWeights, spacing: float) -> None:
        self.base, self.slope = fit_signed_distance(weights, STEEPNESS / spacing, TRUNCATION * spacing)

    @phase("depth start")
    def apply(
        self, grid: FeatureGrid, camera: Intrinsics, T_world_camera: np.ndarray, depth: wp.array, selected: wp.array
    ) -> None:
        """Start what a frame sees first.

        Args:
            grid: Of the middle level; `FeatureGrid.seen` says what has been started.
            camera: Intrinsics of the depth image.
            T_world_camera: Pose of the frame (4, 4).
            depth: Depth image on the device [m], float32 (H, W), 0 = missing.
            selected: Only vertices that are 1 here change, uint8 (rows,).
        """
        line = struct(
            seen.FeatureLine,
            base=Vec32(*self.base),
            slope=Vec32(*self.slope),
            truncation=TRUNCATION * grid.spacing,
            reach=REACH * grid.spacing,
        )
        inputs = [grid.lattice, *projection(camera, T_world_camera), depth, selected, line]
        wp.launch(
            seen.start_from_depth,
            dim=grid.own_rows,
            inputs=inputs,
            outputs=[grid.seen, grid.features],
            device=grid.device,
            record_tape=False,
        )


def fit_signed_distance(weights: DecoderWeights, steepness: float, truncation: float) -> tuple[np.ndarray, np.ndarray]:
    """Features on a line that a decoder reads as signed distance: logit(p, base + s * slope) ~ steepness * s.

    Least squares over points p and distances s, by Levenberg-Marquardt.

    Args:
        weights: Of a decoder with coordinates and one feature, such as the middle one.
        steepness: Of the logit [1/m].
        truncation: Largest |s| [m].

    Returns:
        base, slope [1/m]: float32 (32,) each.
    """
    tensors = {name: tensor.astype(np.float64) for name, tensor in weights.padded().tensors.items()}
    rng = np.random.default_rng(0)
    points = rng.uniform(-_EXTENT, _EXTENT, (_POINTS, 3))
    s = rng.uniform(-truncation, truncation, (_POINTS, 1))
    target = steepness * s[:, 0]

    def errors(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Errors of the logits and their derivatives by x = [base, slope * truncation]."""
        features = x[:FEATURE_SIZE] + s / truncation * x[FEATURE_SIZE:]
        logits, by_feature = logit_and_derivative(tensors, points, features)
        return logits - target, np.concatenate([by_feature, s / truncation * by_feature], axis=1)

    x = np.zeros(2 * FEATURE_SIZE)
    damping = 1.0
    error, J = errors(x)
    cost = np.mean(error**2) + _RIDGE * x @ x
    for _ in range(_ITERATIONS):
        H = J.T @ J / _POINTS
        H += np.diag(damping * np.diag(H) + _RIDGE)
        candidate = x - np.linalg.solve(H, J.T @ error / _POINTS + _RIDGE * x)
        new_error, new_J = errors(candidate)
        new_cost = np.mean(new_error**2) + _RIDGE * candidate @ candidate
        if new_cost < cost:
            x, error, J, cost = candidate, new_error, new_J, new_cost
            damping = max(damping / 3.0, 1e-4)
        else:
            damping *= 3.0
    return x[:FEATURE_SIZE].astype(np.float32), (x[FEATURE_SIZE:] / truncation).astype(np.float32)


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
