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


# The sines of both above for a block on the CPU, a register of channels at a time, to the bit.
EMBED = """
    // e = sin(p B) of 32 channels
    auto embed = [](float* e, const float* positions, const float* angles) __attribute__((noinline)) {
        for (int p = 0; p < size; ++p) {
            const float p_0 = positions[3 * p], p_1 = positions[3 * p + 1], p_2 = positions[3 * p + 2];
            #pragma unroll
            for (int i = 0; i < 32; i += lanes) {
                const vector b_0 = *(const vector*)(angles + i);
                const vector b_1 = *(const vector*)(angles + 32 + i);
                const vector b_2 = *(const vector*)(angles + 64 + i);
                const vector x = p_0 * b_0 + p_1 * b_1 + p_2 * b_2;
                const vector n = (x * 0.31830988618f + 12582912.0f) - 12582912.0f;
                vector r = x - n * 3.140625f;
                r = r - n * 0.0009675025939941406f;
                r = r - n * 1.5099579909783765e-07f;
                const vector half = (n * 0.5f + 12582912.0f) - 12582912.0f;
                const vector odd = n - 2.0f * half;
                const vector sign = 1.0f - 2.0f * odd * odd;
                const vector q = r * r;
                const vector s = r + r * q * (-0.16666667f + q * (0.0083333310f + q * (-0.00019840874f
                    + q * (2.7525562e-06f - q * 2.3889859e-08f))));
                *(vector*)(e + 32 * p + i) = sign * s;
            }
        }
    };
"""
