"""The kernels against the numbers recorded from the authors' implementation."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from tests.kernels.iteration import Iteration, Rays, field_on_device, relative_error
from tests.reference.oracle import STAGES
from warpslam.camera import Intrinsics
from warpslam.field.passes import query
from warpslam.field.ray_batch import RayBatch
from warpslam.kernels import adam
from warpslam.mapping.frustum import select_in_frustum


@pytest.fixture(scope="module")
def iteration(scene, device):
    """Function that makes an iteration of a stage on the recorded rays."""
    rays = Rays.from_pixels(
        scene.pose[None], np.zeros(len(scene.depth), np.int32), scene.column, scene.row, scene.depth, scene.rgb,
        scene.fx, scene.fy, scene.cx, scene.cy,
    )  # fmt: skip
    return lambda stage: Iteration(scene.field(), rays, stage, device)


@pytest.mark.parametrize("stage", STAGES)
def test_field_at_points(scene, device, stage):
    """Logit and colour at points agree within 1e-4 of the largest value, clamped lookups beyond the border included."""
    batch = RayBatch(len(scene.points), 1, device)
    batch.set_points(scene.points)
    query(batch, field_on_device(scene.field(), device), stage)
    expected = scene.point_values[stage]
    inside = ((scene.points > scene.lo) & (scene.points < scene.hi)).all(axis=1)
    assert relative_error(batch.logit.numpy()[inside], expected[inside, 3]) < 1e-4
    if stage == "color":
        assert relative_error(batch.color.numpy(), expected[:, :3]) < 1e-4


@pytest.mark.parametrize("stage", STAGES)
def test_rendering(scene, iteration, stage):
    """Samples, weights, depth, colour and variance of every ray agree with the authors'."""
    run = iteration(stage)
    run.cast_and_sample()
    run.render()
    expected = scene.renderings[stage]
    assert run.array("keep").all()
    np.testing.assert_allclose(run.array("z"), expected.z, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(run.array("weight"), expected.weights, atol=1e-4)
    assert relative_error(run.array("depth"), expected.depth) < 1e-4
    # Ray by ray, with 1 um to spare: the authors' float32 weights are themselves 1.1e-4 off the exact value at 1.6 mm.
    np.testing.assert_allclose(run.array("depth"), expected.depth, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(run.array("variance"), expected.variance, rtol=1e-3)
    if stage == "color":
        assert (
            np.linalg.norm(run.array("rgb") - expected.rgb, axis=1) < 1e-4 * np.linalg.norm(expected.rgb, axis=1)
        ).all()
        assert relative_error(run.array("color"), expected.raw[..., :3]) < 1e-4
    else:
        assert not run.array("rgb").any()
    logit = expected.raw[..., 3]
    outside = logit == 100
    assert np.array_equal(run.array("logit") == 100, outside)
    assert relative_error(run.array("logit")[~outside], logit[~outside]) < 1e-4


@pytest.mark.parametrize("stage", STAGES)
def test_mapping(scene, iteration, stage):
    """Mapping loss and its gradients agree to 1e-3: feature rows of each level, every colour weight and B, pose."""
    gradient = iteration(stage).mapping()
    expected = scene.mapping[stage]
    assert gradient.loss == pytest.approx(expected.loss, rel=1e-4)
    assert set(gradient.rows) == set(expected.rows)
    for level, rows in expected.rows.items():
        assert relative_error(gradient.rows[level], rows) < 1e-3, level
    assert set(gradient.color_decoder) == set(expected.color_decoder)
    for name, weights in expected.color_decoder.items():
        assert relative_error(gradient.color_decoder[name], weights) < 1e-3, name
    if expected.pose is not None:
        assert relative_error(gradient.poses[0], expected.pose) < 1e-3


def test_tracking(scene, iteration):
    """Residuals, the choice of inliers, loss and pose gradient of tracking agree with the authors'."""
    run = iteration("color")
    gradient = run.tracking()
    expected = scene.tracking
    assert np.array_equal(run.array("inlier") != 0, expected.keep)
    np.testing.assert_allclose(run.array("residual")[expected.keep], expected.residual[expected.keep], rtol=1e-3)
    assert gradient.loss == pytest.approx(expected.loss, rel=1e-3)
    assert relative_error(gradient.poses[0], expected.gradient) < 1e-3


def test_pose_after_one_adam_step(scene, iteration, device):
    """The pose vector after the first Adam step of tracking is the authors', to float32 rounding."""
    run = iteration("color")
    run.tracking()
    step = wp.zeros(1, dtype=int, device=device)
    first, second = (wp.zeros((1, 7), dtype=float, device=device) for _ in range(2))
    rate = scene.tracking.learning_rate
    wp.launch(adam.advance_step, dim=1, inputs=[step], device=device)
    rates = wp.array([[rate, rate]], dtype=wp.vec2, device=device)
    inputs = [step, rates, 0, run.poses, run.poses.grad, first, second]
    wp.launch(adam.adam_poses, dim=(1, 7), inputs=inputs, device=device)
    np.testing.assert_allclose(run.poses.numpy()[0], scene.tracking.pose_after_adam, atol=5e-7)
    assert not run.poses.grad.numpy().any()


@pytest.mark.parametrize("level", ("middle", "fine"))
def test_frustum_mask(scene, device, level):
    """The vertices that a frame may change are the authors', vertex for vertex."""
    lattice = field_on_device(scene.field(), device).lattices[level]
    camera = Intrinsics(scene.fx, scene.fy, scene.cx, scene.cy, scene.width, scene.height)
    depth = wp.array(scene.depth_image, dtype=float, device=device)
    rows = int(np.prod(scene.lattices[level].shape))
    mask = select_in_frustum(lattice, rows, camera, scene.frustum_pose, depth, 0.5)
    assert np.array_equal(mask, scene.frustum[level])


def test_iterations_do_not_leak_into_each_other(iteration):
    """A second, equal iteration on the same buffers gives the same bytes: nothing accumulates from one to the next."""
    run = iteration("color")
    first = run.mapping()
    run.tracking()
    second = run.mapping()
    assert first.loss == second.loss
    assert np.array_equal(first.poses, second.poses)
    for level, rows in first.rows.items():
        assert np.array_equal(rows, second.rows[level]), level
    for name, weights in first.color_decoder.items():
        assert np.array_equal(weights, second.color_decoder[name]), name


def test_only_selected_rows_get_a_gradient(scene, iteration):
    """Rows outside the frustum mask keep a zero gradient, and the mask changes nothing for the others."""
    run = iteration("fine")
    everything = run.mapping().rows
    for level, mask in scene.frustum.items():
        run.places[level].assign(np.where(mask, np.arange(len(mask)), -1).astype(np.int32))
    selected = run.mapping().rows
    for level, mask in scene.frustum.items():
        assert everything[level][~mask].any()
        assert not selected[level][~mask].any()
        assert np.array_equal(selected[level][mask], everything[level][mask])
