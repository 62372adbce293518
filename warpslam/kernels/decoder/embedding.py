"""The Fourier embedding e = sin(p B), in chunks of 32 channels."""

import warp as wp

from warpslam.kernels.decoder.layout import B
from warpslam.kernels.grid import Vec32


@wp.func
def sine_cosine(x: float) -> wp.vec2:
    """(sin x, cos x) by range reduction to [-pi/2, pi/2] and polynomials; absolute error < 3e-7 for |x| < 1e4."""
    # Adding 1.5 * 2^23 rounds to the nearest integer without a library call, which keeps the loop over channels
    # vectorised.
    n = (x * 0.31830988618 + 12582912.0) - 12582912.0
    r = x - n * 3.140625
    r = r - n * 0.0009675025939941406
    r = r - n * 1.5099579909783765e-07
    half = (n * 0.5 + 12582912.0) - 12582912.0
    odd = n - 2.0 * half
    sign = 1.0 - 2.0 * odd * odd
    q = r * r
    s = r + r * q * (-0.16666667 + q * (0.0083333310 + q * (-0.00019840874 + q * (2.7525562e-06 - q * 2.3889859e-08))))
    c = 1.0 + q * (-0.5 + q * (0.041666642 + q * (-0.0013888397 + q * (2.4760495e-05 - q * 2.6051615e-07))))
    return wp.vec2(sign * s, sign * c)


@wp.func
def angles(p: wp.vec3, weights: wp.array[Vec32], chunk: int) -> Vec32:
    """p B of a chunk."""
    return p[0] * weights[B + 3 * chunk] + p[1] * weights[B + 3 * chunk + 1] + p[2] * weights[B + 3 * chunk + 2]
