"""Do two depth images agree? Pixels of each are warped into the other and their depth is compared.

    |z - D(pi(x))| < 2 cm + 2 % of z        x = T_b_a D_a(p) K^-1 p,  z its depth

Pixels without depth in either image do not count.
"""

import warp as wp

from warpslam.kernels.features.arrays import MODULE

BAND = wp.constant(wp.vec2(0.02, 0.02))
"""Constant [m] and share of depth within which two depths agree."""
NEAREST = wp.constant(0.1)


@wp.func
def compare_pixel(
    u: int,
    v: int,
    a: wp.array2d[float],
    b: wp.array2d[float],
    T_b_a: wp.mat44,
    focal: wp.vec2,
    center: wp.vec2,
) -> int:
    """0 = not to be compared, 1 = differs, 2 = agrees."""
    depth = a[v, u]
    if depth <= NEAREST:
        return 0
    X = depth * wp.vec3((float(u) - center[0]) / focal[0], (float(v) - center[1]) / focal[1], 1.0)
    x = wp.transform_point(T_b_a, X)
    if x[2] < NEAREST:
        return 0
    column = wp.rint(focal[0] * x[0] / x[2] + center[0])
    line = wp.rint(focal[1] * x[1] / x[2] + center[1])
    # So that NaN is outside.
    if not (column >= 0.0 and line >= 0.0 and column < float(b.shape[1]) and line < float(b.shape[0])):
        return 0
    other = b[int(line), int(column)]
    if other <= NEAREST:
        return 0
    return wp.where(wp.abs(other - x[2]) < BAND[0] + BAND[1] * x[2], 2, 1)


@wp.kernel(module=MODULE)
def depth_agreement(
    a: wp.array2d[float],
    b: wp.array2d[float],
    T_b_a: wp.mat44,
    T_a_b: wp.mat44,
    focal: wp.vec2,
    center: wp.vec2,
    step: int,
    counts: wp.array2d[int],
):
    """One thread a pixel of every ``step``-th row and column; adds up compared and agreeing ones, (2, 2): a, then b."""
    line, column = wp.tid()
    u = column * step + step / 2
    v = line * step + step / 2
    if u >= a.shape[1] or v >= a.shape[0]:
        return
    seen = compare_pixel(u, v, a, b, T_b_a, focal, center)
    if seen > 0:
        wp.atomic_add(counts, 0, 0, 1)
        wp.atomic_add(counts, 0, 1, seen - 1)
    seen = compare_pixel(u, v, b, a, T_a_b, focal, center)
    if seen > 0:
        wp.atomic_add(counts, 1, 0, 1)
        wp.atomic_add(counts, 1, 1, seen - 1)
