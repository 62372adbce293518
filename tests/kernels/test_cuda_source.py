"""The decoder kernels as they are built for CUDA, run on the CPU: the same values and gradients as the CPU's own."""

import numpy as np
import pytest
import warp as wp

from tests.kernels.iteration import Iteration, Rays
from warpslam.field.arrays import Thresholds
from warpslam.field.objectives import choose_inliers, gauss_newton_step
from warpslam.field.passes import render
from warpslam.kernels.decoder import build

BUILDS = {target: build.KERNELS[target, "dense"] for target in ("cpu", "cuda")}


def iterations(scene, stage: str = "color") -> dict[str, Iteration]:
    """An iteration on the recorded scene by build."""
    result = {}
    for name, kernels in BUILDS.items():
        frame = np.zeros(len(scene.depth), np.int32)
        pixels = scene.column, scene.row, scene.depth, scene.rgb
        rays = Rays.from_pixels(scene.pose[None], frame, *pixels, scene.fx, scene.fy, scene.cx, scene.cy)
        result[name] = Iteration(scene.field(), rays, stage, wp.get_device("cpu"))
        result[name].batch.kernels = kernels
    return result


@pytest.fixture(scope="module")
def gradients(scene):
    """Mapping gradients of the colour stage by build."""
    return {name: iteration.mapping() for name, iteration in iterations(scene).items()}


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


@pytest.mark.parametrize("stage", ["coarse", "color"])
@pytest.mark.parametrize("jitter", [False, True])
def test_samples_lie_where_a_thread_a_ray_puts_them(scene, stage, jitter):
    """Ranking the samples of two sequences is merging them: the depths are the same bytes."""
    z = []
    for iteration in iterations(scene, stage).values():
        batch = iteration.batch
        batch.set_seeds([7])
        batch.cast(iteration.poses)
        batch.bound(iteration.arrays)
        batch.place_samples(32, 16, use_depth=stage == "color", jitter=jitter)
        z.append(iteration.array("z"))
    assert (np.diff(z[0], axis=1) >= 0).all()
    np.testing.assert_array_equal(*z)


def test_renderings_agree(scene):
    """Weights, depth, variance and colour of a thread a sample and of a thread a ray; the same samples get colour."""
    arrays = {}
    for name, iteration in iterations(scene).items():
        iteration.cast_and_sample()
        render(iteration.batch, iteration.arrays, "color", thresholds=Thresholds(min_weight=1e-3))
        arrays[name] = {key: iteration.array(key) for key in ("weight", "depth", "variance", "rgb", "color")}
    for key, a in arrays["cpu"].items():
        np.testing.assert_allclose(arrays["cuda"][key], a, rtol=1e-4, atol=2e-5, err_msg=key)
    black = [(part["color"] == 0).all(axis=-1) for part in arrays.values()]
    assert black[0].any() and not black[0].all() and (black[0] != black[1]).mean() < 1e-3


def test_tracking_gradients_agree(scene):
    """Adam's gradient of the pose, through the samples' positions alone."""
    a, b = (iteration.tracking() for iteration in iterations(scene).values())
    assert b.loss == pytest.approx(a.loss, rel=1e-5)
    assert np.linalg.norm(b.poses - a.poses) < 1e-4 * np.linalg.norm(a.poses)


def test_coarse_gradients_agree(scene):
    """Of the coarse level's rows, and of the pose, which the coarse term of tracking asks for."""
    a, b = (iteration.mapping() for iteration in iterations(scene, "coarse").values())
    assert np.linalg.norm(b.rows["coarse"] - a.rows["coarse"]) < 1e-4 * np.linalg.norm(a.rows["coarse"])
    assert np.linalg.norm(b.poses - a.poses) < 1e-4 * np.linalg.norm(a.poses)


def test_gauss_newton_steps_agree(scene):
    """The step from sums of parts is that of one thread; it goes somewhere, and again from where it came to."""
    poses = []
    for iteration in iterations(scene).values():
        for _ in range(2):
            iteration.cast_and_sample()
            render(iteration.batch, iteration.arrays, "color")
            choose_inliers(iteration.batch, 10.0)
            gauss_newton_step(iteration.batch, iteration.arrays, iteration.poses, 0.5)
        poses.append(iteration.poses.numpy()[0])
    assert np.abs(poses[0] - scene.pose).max() > 1e-4
    np.testing.assert_allclose(poses[1], poses[0], atol=2e-5)
