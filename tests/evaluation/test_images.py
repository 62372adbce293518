"""Image metrics on cases worked by hand."""

from __future__ import annotations

import numpy as np
import pytest

from warpslam.errors import InputError
from warpslam.evaluation import depth_l1, psnr, ssim


def test_depth_l1_over_valid_or_all_pixels():
    """Pixels without truth count only in the all-pixel protocol, where a miss is depth 0."""
    truth = np.array([[1.0, 2.0], [0.0, 0.0]])
    depth = np.array([[1.1, 0.0], [0.4, 0.0]])
    assert depth_l1(depth, truth) == pytest.approx((0.1 + 2.0) / 2)
    assert depth_l1(depth, truth, all_pixels=True) == pytest.approx((0.1 + 2.0 + 0.4) / 4)
    assert np.isnan(depth_l1(depth, np.zeros((2, 2))))
    with pytest.raises(InputError, match="same shape"):
        depth_l1(depth, truth[:1])


def test_psnr_by_hand():
    """An error of 0.1 everywhere is 20 dB; colours beyond 0..1 are clipped first."""
    rgb = np.full((4, 4, 3), 51, np.uint8)  # 0.2
    assert psnr(np.full((4, 4, 3), 0.3), rgb) == pytest.approx(20.0)
    assert psnr(np.full((4, 4, 3), 7.0), np.full((4, 4, 3), 255, np.uint8)) == pytest.approx(120.0)


def test_ssim_of_flat_images_by_hand():
    """Without structure only the means count: (2 * 0.2 * 0.6 + C1) / (0.2^2 + 0.6^2 + C1); an image is like itself."""
    rgb = np.full((20, 16, 3), 51, np.uint8)
    expected = (2 * 0.2 * 0.6 + 1e-4) / (0.04 + 0.36 + 1e-4)
    assert ssim(np.full(rgb.shape, 0.6), rgb) == pytest.approx(expected)
    assert ssim(rgb / 255.0, rgb) == pytest.approx(1.0)


def test_ssim_of_one_window_by_hand():
    """In an 11 x 11 image there is one window: its sums written out, a channel at a time."""
    rng = np.random.default_rng(0)
    a, rgb = rng.random((11, 11, 3)), rng.integers(0, 256, (11, 11, 3)).astype(np.uint8)
    weights = np.array([[np.exp(-(i * i + j * j) / (2 * 1.5**2)) for i in range(-5, 6)] for j in range(-5, 6)])
    weights /= weights.sum()
    values = []
    for c in range(3):
        x, y = a[..., c], rgb[..., c] / 255.0
        mx, my = (weights * x).sum(), (weights * y).sum()
        vx, vy = (weights * (x - mx) ** 2).sum(), (weights * (y - my) ** 2).sum()
        xy = (weights * (x - mx) * (y - my)).sum()
        values.append((2 * mx * my + 1e-4) * (2 * xy + 9e-4) / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4)))
    assert ssim(a, rgb) == pytest.approx(np.mean(values), abs=1e-9)


def test_ssim_of_what_can_not_be_compared():
    """Images smaller than the window have none; different shapes are an error."""
    assert np.isnan(ssim(np.zeros((10, 40, 3)), np.zeros((10, 40, 3), np.uint8)))
    with pytest.raises(InputError, match="same shape"):
        ssim(np.zeros((20, 20, 3)), np.zeros((20, 21, 3), np.uint8))
