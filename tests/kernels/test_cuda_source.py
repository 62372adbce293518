"""The decoder kernels as they are built for CUDA, run on the CPU: the same values and gradients as the CPU's own."""

import numpy as np
import pytest
import warp as wp

from tests.kernels.iteration import Iteration, Rays
from warpslam.kernels.decoder import build


@pytest.fixture(scope="module")
def gradients(scene):
    """Mapping gradients of the colour stage by build, on the recorded scene."""
    result = {}
    for name, kernels in (("cpu", build.CPU), ("cuda", build.CUDA)):
        rays = Rays.from_pixels(
            scene.pose[None], np.zeros(len(scene.depth), np.int32), scene.column, scene.row, scene.depth, scene.rgb
            , scene.fx, scene.fy, scene.cx, scene.cy
        )  # fmt: skip
        iteration = Iteration(scene.field(), rays, "color", wp.get_device("cpu"))
        iteration.batch.kernels = kernels
        result[name] = iteration.mapping()
    return result


def test_loss_rows_and_poses_agree(gradients):
    """Rolled loops and one accumulation chain change the last bits only."""
    a, b = gradients["cpu"], gradients["cuda"]
    assert b.loss == pytest.approx(a.loss, rel=1e-5)
    for level, rows in a.rows.items():
        assert np.linalg.norm(b.rows[level] - rows) < 1e-4 * np.linalg.norm(rows)
    assert np.linalg.norm(b.poses - a.poses) < 1e-4 * np.linalg.norm(a.poses)


def test_color_weights_summed_apart_agree(gradients):
    """The kernel that sums the weight gradient over stored layers gives what the per-thread sums give, B included."""
    a, b = gradients["cpu"].color_decoder, gradients["cuda"].color_decoder
    assert set(a) == set(b) and len(a) == 23
    for name, weights in a.items():
        assert np.linalg.norm(b[name] - weights) <= 1e-4 * np.linalg.norm(weights) + 1e-12, name
