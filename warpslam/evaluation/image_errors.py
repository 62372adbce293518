"""How near a rendered image is to a taken one: PSNR, SSIM, depth L1.

    PSNR    -10 log10 mean (a - b)^2                                       [dB], colours 0..1
    SSIM    mean over windows of  (2 m_a m_b + C1)(2 s_ab + C2) / ((m_a^2 + m_b^2 + C1)(s_a^2 + s_b^2 + C2))
            m, s^2, s_ab: mean, variance, covariance under an 11 x 11 Gaussian of 1.5 px; C1 = 0.01^2, C2 = 0.03^2
    L1      mean |rendered - true depth|                                    [m]

Wang et al., Image Quality Assessment: From Error Visibility to Structural Similarity, IEEE TIP 2004. Each colour
channel counts alike, and only windows inside the image count.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

from warpslam.errors import InputError

SSIM_WINDOW = 11
SSIM_SIGMA = 1.5


class RenderedFrame(Protocol):
    """A frame and what a map renders at its pose.

    index: Number of the frame. rgb: uint8 (H, W, 3). depth: [m] (H, W), 0 = missing. rendered_rgb: (H, W, 3), 0..1.
    rendered_depth: [m] (H, W).
    """

    @property
    def index(self) -> int: ...  # noqa: D102
    @property
    def rgb(self) -> np.ndarray: ...  # noqa: D102
    @property
    def depth(self) -> np.ndarray: ...  # noqa: D102
    @property
    def rendered_rgb(self) -> np.ndarray: ...  # noqa: D102
    @property
    def rendered_depth(self) -> np.ndarray: ...  # noqa: D102


def rendering_metrics(frames: Sequence[RenderedFrame]) -> dict[str, Any]:
    """Means over frames, named with their units, and which frames they are."""
    return {
        "frames": [frame.index for frame in frames],
        "depth_l1_m": float(np.mean([depth_l1(frame.rendered_depth, frame.depth) for frame in frames])),
        "psnr_db": float(np.mean([psnr(frame.rendered_rgb, frame.rgb) for frame in frames])),
        "ssim": float(np.mean([ssim(frame.rendered_rgb, frame.rgb) for frame in frames])),
    }


def psnr(rendered: np.ndarray, rgb: np.ndarray) -> float:
    """Peak signal-to-noise ratio [dB] of a rendering (H, W, 3), 0..1, against a uint8 image (H, W, 3)."""
    mean_square = float(np.mean((np.clip(rendered, 0, 1) - rgb / 255.0) ** 2))
    return float(-10 * np.log10(max(mean_square, 1e-12)))


def ssim(rendered: np.ndarray, rgb: np.ndarray) -> float:
    """Structural similarity, at most 1, of a rendering (H, W, 3), 0..1, and a uint8 image (H, W, 3).

    NaN where the images are smaller than the window.

    Raises:
        InputError: Shapes differ.
    """
    a, b = np.clip(np.asarray(rendered, dtype=np.float64), 0, 1), np.asarray(rgb, dtype=np.float64) / 255.0
    if a.shape != b.shape or a.ndim != 3:
        raise InputError(f"ssim: rendered {a.shape} and rgb {b.shape} must have the same shape (H, W, 3)")
    if min(a.shape[:2]) < SSIM_WINDOW:
        return float("nan")
    mean_a, mean_b = _windowed(a), _windowed(b)
    variance_a, variance_b = _windowed(a * a) - mean_a**2, _windowed(b * b) - mean_b**2
    covariance = _windowed(a * b) - mean_a * mean_b
    c1, c2 = 0.01**2, 0.03**2
    luminance = (2 * mean_a * mean_b + c1) / (mean_a**2 + mean_b**2 + c1)
    structure = (2 * covariance + c2) / (variance_a + variance_b + c2)
    return float((luminance * structure).mean())


def depth_l1(depth: np.ndarray, truth: np.ndarray, *, all_pixels: bool = False) -> float:
    """Mean |depth - truth| [m] of two depth images (H, W), 0 = no surface.

    Args:
        depth: Rendered depth [m].
        truth: True or measured depth [m].
        all_pixels: Average over all pixels, a miss counting as depth 0 (the paper's protocol on meshes); else over the
            pixels where ``truth`` has a value. NaN then if it has none.

    Raises:
        InputError: Shapes differ.
    """
    depth, truth = np.asarray(depth, dtype=np.float64), np.asarray(truth, dtype=np.float64)
    if depth.shape != truth.shape:
        raise InputError(f"depth {depth.shape} and truth {truth.shape} must have the same shape")
    counted = np.ones(truth.shape, dtype=bool) if all_pixels else truth > 0
    return float(np.abs(depth - truth)[counted].mean()) if counted.any() else float("nan")


def _windowed(image: np.ndarray) -> np.ndarray:
    """Gaussian-weighted means (H - 10, W - 10, C) of all windows inside an image (H, W, C)."""
    from scipy.ndimage import correlate1d

    reach = SSIM_WINDOW // 2
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / SSIM_SIGMA) ** 2)
    weights /= weights.sum()
    smooth = correlate1d(correlate1d(image, weights, axis=0), weights, axis=1)
    return smooth[reach:-reach, reach:-reach]
