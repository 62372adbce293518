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
from warpslam.field.decoders import FEATURE_SIZE, DecoderWeights
from warpslam.field.feature_fit import EXTENT, POINTS, double_tensors, least_squares, logit_and_derivative
from warpslam.kernels import seen
from warpslam.kernels.grid import Vec32
from warpslam.mapping.frustum import REACH
from warpslam.runtime.phases import phase
from warpslam.scene.feature_grid import FeatureGrid

# Of the logit by the distance, and the largest distance, in vertex spacings.
STEEPNESS = 2.56
TRUNCATION = 1.6


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
    tensors = double_tensors(weights)
    rng = np.random.default_rng(0)
    points = rng.uniform(-EXTENT, EXTENT, (POINTS, 3))
    s = rng.uniform(-truncation, truncation, (POINTS, 1))
    target = steepness * s[:, 0]

    def errors(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Errors of the logits and their derivatives by x = [base, slope * truncation]."""
        features = x[:FEATURE_SIZE] + s / truncation * x[FEATURE_SIZE:]
        logits, by_feature = logit_and_derivative(tensors, points, features)
        return logits - target, np.concatenate([by_feature, s / truncation * by_feature], axis=1)

    x = least_squares(errors, np.zeros(2 * FEATURE_SIZE))
    return x[:FEATURE_SIZE].astype(np.float32), (x[FEATURE_SIZE:] / truncation).astype(np.float32)
