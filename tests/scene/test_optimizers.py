"""Adam on rows and poses against torch.optim.Adam."""

import numpy as np
import pytest
import torch
import warp as wp

from warpslam.kernels.grid import Vec32
from warpslam.runtime.launching import Launcher
from warpslam.scene.optimizers import PoseOptimizer, RowOptimizer

DEVICES = ["cpu", *(str(d) for d in wp.get_cuda_devices())]


@pytest.mark.parametrize("device", DEVICES)
def test_rows_follow_torch_adam(device):
    """Ten steps with a changing rate agree with torch; the gradient buffers end at zero; other rows keep their bits."""
    rng = np.random.default_rng(0)
    device = wp.get_device(device)
    start = rng.normal(size=(20, 32)).astype(np.float32)
    rows = np.array([1, 4, 5, 19])
    x = wp.array(start, dtype=Vec32, device=device)
    optimizer = RowOptimizer(Launcher(device))
    optimizer.start(20, rows)
    expected = torch.tensor(start[rows], requires_grad=True)
    reference = torch.optim.Adam([expected], lr=1.0)
    for step in range(10):
        slices = rng.normal(size=(*optimizer.gradient.shape, 32)).astype(np.float32)
        optimizer.gradient.assign(slices)
        rate = 0.1 / (1 + step)
        optimizer.update(x, rate)
        reference.param_groups[0]["lr"] = rate
        expected.grad = torch.tensor(slices.sum(axis=0)[rows])
        reference.step()
        assert not optimizer.gradient.numpy()[:, rows].any()
    result = x.numpy()
    np.testing.assert_allclose(result[rows], expected.detach().numpy(), rtol=1e-4, atol=1e-5)
    others = np.setdiff1d(np.arange(20), rows)
    np.testing.assert_array_equal(result[others], start[others])


@pytest.mark.parametrize("device", DEVICES)
def test_poses_follow_torch_adam_and_the_first_stays(device):
    """Separate rates for quaternion and translation; a fixed row does not move."""
    rng = np.random.default_rng(1)
    start = rng.normal(size=(3, 7)).astype(np.float32)
    optimizer = PoseOptimizer(4, Launcher(wp.get_device(device)))
    optimizer.begin(start, np.array([[0.002, 0.01]]))
    q, t = (torch.tensor(start[1:, part], requires_grad=True) for part in (slice(0, 4), slice(4, 7)))
    reference = torch.optim.Adam([{"params": [q], "lr": 0.002}, {"params": [t], "lr": 0.01}])
    for _ in range(5):
        gradient = rng.normal(size=(3, 7)).astype(np.float32)
        optimizer.poses.grad.assign(gradient)
        optimizer.update(first=1)
        q.grad, t.grad = torch.tensor(gradient[1:, :4]), torch.tensor(gradient[1:, 4:])
        reference.step()
    expected = np.concatenate([q.detach().numpy(), t.detach().numpy()], axis=1)
    np.testing.assert_array_equal(optimizer.vectors()[0].astype(np.float32), start[0])
    np.testing.assert_allclose(optimizer.vectors()[1:], expected, rtol=1e-5, atol=1e-6)
    assert not optimizer.poses.grad.numpy().any()


def test_a_gradient_that_is_not_finite_is_left_out():
    """Its row keeps its bits and the optimiser says so; the other rows move, and the next step is clean."""
    device = wp.get_device("cpu")
    x = wp.array(np.ones((3, 32), np.float32), dtype=Vec32, device=device)
    optimizer = RowOptimizer(Launcher(device))
    optimizer.start(3, np.arange(3))
    assert not optimizer.has_rejected
    gradient = np.ones((*optimizer.gradient.shape, 32), np.float32)
    gradient[0, 1, 5], gradient[0, 2, 7] = np.nan, np.inf
    optimizer.gradient.assign(gradient)
    optimizer.update(x, 0.1)
    assert optimizer.has_rejected
    np.testing.assert_array_equal(x.numpy()[1:], 1.0)
    assert (x.numpy()[0] < 1.0).all()
    optimizer.gradient.fill_(1.0)
    optimizer.update(x, 0.1)
    assert np.isfinite(x.numpy()).all() and (x.numpy() < 1.0).all()


def test_a_new_call_starts_with_fresh_moments():
    """The first step of every call moves by the rate in the direction of the gradient's sign, whatever came before."""
    device = wp.get_device("cpu")
    x = wp.zeros(2, dtype=Vec32, device=device)
    optimizer = RowOptimizer(Launcher(device))
    for _ in range(2):
        optimizer.start(2, np.array([0]))
        before = x.numpy()[0, 0]
        optimizer.gradient.fill_(3.0)
        optimizer.update(x, 0.01)
        assert x.numpy()[0, 0] - before == pytest.approx(-0.01, rel=1e-4)
