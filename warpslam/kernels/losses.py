"""Losses of mapping (Eq. 8-10) and tracking (Eq. 11-12), as sums over rays like the released code, or as means.

    mapping:   L = sum_{kept, D > 0} |D - D^|  +  lambda_p sum_kept |I - I^|_1      Eq. 8, 9, 10
    tracking:  r = |D - D^| / sqrt(V + 1e-10), V detached                           Eq. 11
               inlier: D > 0 and (r < 10 median(r) where the dynamic filter is on)
               L = sum_inlier r  +  lambda_pt sum_inlier |I - I^|_1                 Eq. 12

|.|_1 sums the three channels. The loss kernels are differentiated by the tape; residuals and the choice of inliers
have no gradient.
"""

import warp as wp


@wp.func
def l1(a: wp.vec3, b: wp.vec3) -> float:
    return wp.abs(a[0] - b[0]) + wp.abs(a[1] - b[1]) + wp.abs(a[2] - b[2])


@wp.kernel
def mapping_loss(
    keep: wp.array[int],
    measured_depth: wp.array[float],
    measured_rgb: wp.array[wp.vec3],
    depth_weight: float,
    color_weight: float,
    depth: wp.array[float],
    rgb: wp.array[wp.vec3],
    loss: wp.array[float],
):
    tid = wp.tid()
    if keep[tid] != 0:
        value = float(0.0)
        if measured_depth[tid] > 0.0:
            value += depth_weight * wp.abs(measured_depth[tid] - depth[tid])
        if color_weight > 0.0:
            value += color_weight * l1(measured_rgb[tid], rgb[tid])
        wp.atomic_add(loss, 0, value)


@wp.kernel(enable_backward=False)
def tracking_residuals(
    keep: wp.array[int],
    measured_depth: wp.array[float],
    depth: wp.array[float],
    variance: wp.array[float],
    include_missing: int,
    normalize: int,
    sigma: wp.array[float],
    residual: wp.array[float],
    candidate_count: wp.array[int],
):
    """Depth residuals, in metres or in standard deviations; those the median runs over are >= 0, the others -1 (rays
    without depth: an option).
    """
    tid = wp.tid()
    s = wp.sqrt(variance[tid] + 1.0e-10)
    sigma[tid] = s
    r = float(-1.0)
    if keep[tid] != 0 and (include_missing != 0 or measured_depth[tid] > 0.0):
        r = wp.abs(measured_depth[tid] - depth[tid])
        if normalize != 0:
            r /= s
        wp.atomic_add(candidate_count, 0, 1)
    residual[tid] = r


@wp.func
def rank_of(residual: wp.array[float], index: int) -> int:
    r = residual[index]
    rank = int(0)
    for n in range(residual.shape[0]):
        other = residual[n]
        # Every residual gets a rank of its own: equal values are ranked by index.
        if other >= 0.0 and (other < r or (other == r and n < index)):
            rank += 1
    return rank


@wp.kernel(enable_backward=False)
def lower_median(residual: wp.array[float], candidate_count: wp.array[int], median: wp.array[float]):
    """The lower median of the residuals that are >= 0: each thread ranks its own value."""
    tid = wp.tid()
    if residual[tid] >= 0.0:
        if rank_of(residual, tid) == (candidate_count[0] - 1) // 2:
            median[0] = residual[tid]


@wp.kernel(enable_backward=False)
def choose_inliers(
    keep: wp.array[int],
    measured_depth: wp.array[float],
    residual: wp.array[float],
    median: wp.array[float],
    factor: float,
    inlier: wp.array[int],
    inlier_count: wp.array[int],
):
    """``factor`` x the median bounds an inlier's residual; a factor of 0 turns the filter off."""
    tid = wp.tid()
    chosen = int(0)
    if keep[tid] != 0 and measured_depth[tid] > 0.0:
        if factor == 0.0 or residual[tid] < factor * median[0]:
            chosen = 1
            wp.atomic_add(inlier_count, 0, 1)
    inlier[tid] = chosen


@wp.kernel
def tracking_loss(
    inlier: wp.array[int],
    measured_depth: wp.array[float],
    measured_rgb: wp.array[wp.vec3],
    sigma: wp.array[float],
    depth_weight: float,
    color_weight: float,
    depth: wp.array[float],
    rgb: wp.array[wp.vec3],
    loss: wp.array[float],
):
    tid = wp.tid()
    if inlier[tid] != 0:
        value = depth_weight * wp.abs(measured_depth[tid] - depth[tid]) / sigma[tid]
        if color_weight > 0.0:
            value += color_weight * l1(measured_rgb[tid], rgb[tid])
        wp.atomic_add(loss, 0, value)
