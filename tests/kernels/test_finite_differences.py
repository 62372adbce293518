"""Gradients of the kernels against central differences of their own forward pass, without any other implementation.

Held fixed, because the authors let no gradient through: the sample depths, the choice of rays and inliers, the variance
that divides residuals, and the middle feature that enters the fine decoder (all rows are equal here, so that it does
not depend on the point).
"""

from __future__ import annotations

import numpy as np
import pytest

from tests.kernels.iteration import Iteration
from tests.kernels.random_scene import random_field, random_rays
from warpslam.field.decoders import DecoderWeights
from warpslam.field.packing import PackedDecoder

SEED = 5
COLOR_WEIGHT = {"mapping": 0.2, "tracking": 0.5}


@pytest.fixture
def make(device):
    """Function that makes an iteration of a stage on a random scene whose middle rows are all equal."""

    def build(stage: str) -> Iteration:
        field = random_field(SEED)
        if stage in ("fine", "color"):
            rows = field.grids["middle"].rows.detach()
            field.grids["middle"].rows = rows[:1].expand_as(rows).contiguous()
        return Iteration(field, random_rays(SEED)[0], stage, device)

    return build


def loss_of(run: Iteration, kind: str = "mapping") -> float:
    """The loss of the paper, in float64 from the rendered depth and colour, at the samples and inliers of before."""
    run.batch.cast(run.poses)
    run.render()
    depth, rgb, measured_depth, measured_rgb, sigma = (
        run.array(name).astype(np.float64) for name in ("depth", "rgb", "measured_depth", "measured_rgb", "sigma")
    )
    kept = run.array("keep") != 0
    depth_error, rgb_error = np.abs(measured_depth - depth), np.abs(measured_rgb - rgb).sum(axis=1)
    if kind == "tracking":
        inlier = run.array("inlier") != 0
        return float((depth_error / sigma)[inlier].sum() + COLOR_WEIGHT[kind] * rgb_error[inlier].sum())
    loss = depth_error[kept & (measured_depth > 0)].sum()
    if run.stage == "color":
        loss += COLOR_WEIGHT[kind] * rgb_error[kept].sum()
    return float(loss)


def check(value: np.ndarray, gradient: np.ndarray, assign, loss, step: float) -> None:
    """Derivatives along four directions, the sum of the gradient's and a random one, agree within 1 %.

    ``assign`` sets the variable and ``loss`` evaluates; ``step`` is the length of the change.
    """
    rng = np.random.default_rng(SEED)
    value, gradient = value.astype(np.float64), gradient.astype(np.float64)
    length = np.linalg.norm(gradient)
    assert length > 0
    errors = []
    for _ in range(4):
        random = np.where(gradient != 0, rng.normal(size=gradient.shape), 0.0)
        direction = random / np.linalg.norm(random) + gradient / length
        direction /= np.linalg.norm(direction)
        values = []
        for sign in (1, -1):
            assign((value + sign * step * direction).astype(np.float32))
            values.append(loss())
        errors.append(abs((values[0] - values[1]) / (2 * step) - (gradient * direction).sum()) / length)
    assign(value.astype(np.float32))
    # One direction may cross the kink of a ReLU or of |x|.
    assert np.sort(errors)[-2] < 0.01, errors


@pytest.mark.parametrize(
    ("stage", "level"),
    [("coarse", "coarse"), ("middle", "middle"), ("fine", "fine"), ("color", "fine"), ("color", "color")],
)
def test_feature_rows(make, stage, level):
    """The change of the loss when the features of one level change.

    Middle rows also move the fine decoder's output, a path without gradient, so they are left to the middle stage.
    """
    run = make(stage)
    gradient = run.mapping()
    features = run.arrays.features[level]
    check(features.numpy(), gradient.rows[level], features.assign, lambda: loss_of(run), step=0.02)


def test_color_decoder(make, device):
    """The change of the loss when the colour decoder changes: all weights but B, and B alone."""
    run = make("color")
    gradient = run.mapping().color_decoder
    packed = run.arrays.decoders["color"]
    tensors = packed.unpack().tensors
    names = [name for name in tensors if name != "embedder._B"]

    def assign(**changed: np.ndarray) -> None:
        run.arrays.decoders["color"] = PackedDecoder(DecoderWeights("color", 32, {**tensors, **changed}), device)

    def assign_weights(flat: np.ndarray) -> None:
        parts = np.split(flat, np.cumsum([tensors[name].size for name in names])[:-1])
        assign(**{name: part.reshape(tensors[name].shape) for name, part in zip(names, parts, strict=True)})

    flat, flat_gradient = (np.concatenate([d[name].ravel() for name in names]) for d in (tensors, gradient))
    check(flat, flat_gradient, assign_weights, lambda: loss_of(run), step=0.01)
    name = "embedder._B"
    check(tensors[name], gradient[name], lambda B: assign(**{name: B}), lambda: loss_of(run), step=0.01)


@pytest.mark.parametrize("stage", ("coarse", "middle", "fine", "color"))
def test_poses_in_mapping(make, stage):
    """The change of the mapping loss when the cameras move, at fixed sample depths."""
    run = make(stage)
    gradient = run.mapping()
    check(run.poses.numpy(), gradient.poses, run.poses.assign, lambda: loss_of(run), step=5e-4)


def test_poses_in_tracking(make):
    """The change of the tracking loss when the cameras move, at fixed sample depths, inliers and variance."""
    run = make("color")
    gradient = run.tracking()
    check(run.poses.numpy(), gradient.poses, run.poses.assign, lambda: loss_of(run, "tracking"), step=5e-4)
