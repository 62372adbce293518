"""Losses of mapping (Eq. 8-10) and tracking (Eq. 11-12), as sums over rays like the released code, or as means.

    mapping:   L = sum_{kept, D > 0} |D - D^|  +  lambda_p sum_kept |I - I^|_1      Eq. 8, 9, 10
    tracking:  r = |D - D^| / sqrt(V + 1e-10), V detached                           Eq. 11
               inlier: D > 0 and (s < 10 median(s) where the dynamic filter is on),
                       s = r, or (Sec. 3.3) s = r + lambda_pt |I - I^|_1
               L = sum_inlier r  +  lambda_pt sum_inlier |I - I^|_1                 Eq. 12

|.|_1 sums the three channels. The loss kernels are differentiated by the tape; residuals and the choice of inliers
have no gradient.
"""

import warp as wp

wp.set_module_options({"block_dim": 32})


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


@wp.kernel(enable_backward=False)
def add_color_residuals(
    measured_rgb: wp.array[wp.vec3],
    rgb: wp.array[wp.vec3],
    color_weight: float,
    residual: wp.array[float],
):
    """After `tracking_residuals`: a ray's whole loss of Eq. 12, by which the dynamic filter goes in Sec. 3.3."""
    tid = wp.tid()
    if residual[tid] >= 0.0:
        residual[tid] = residual[tid] + color_weight * l1(measured_rgb[tid], rgb[tid])


@wp.func
def ranks_before(other: float, n: int, r: float, index: int) -> int:
    """1 if residual n comes before that of ``index``; every one has a rank of its own: equal ones go by index."""
    return wp.where(other >= 0.0 and (other < r or (other == r and n < index)), 1, 0)


@wp.func
def rank_of(residual: wp.array[float], index: int) -> int:
    r = residual[index]
    rank = int(0)
    whole = residual.shape[0] // 4
    # Four at a time, so that a thread waits for four loads at once.
    for m in range(whole):
        a = residual[4 * m]
        b = residual[4 * m + 1]
        c = residual[4 * m + 2]
        d = residual[4 * m + 3]
        rank += ranks_before(a, 4 * m, r, index) + ranks_before(b, 4 * m + 1, r, index)
        rank += ranks_before(c, 4 * m + 2, r, index) + ranks_before(d, 4 * m + 3, r, index)
    for n in range(4 * whole, residual.shape[0]):
        rank += ranks_before(residual[n], n, r, index)
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


@wp.kernel(enable_backward=False)
def note_rays(
    iteration: wp.array[int],
    keep: wp.array[int],
    inlier: wp.array[int],
    measured_depth: wp.array[float],
    depth: wp.array[float],
    loss: wp.array[float],
    noted: wp.array3d[float],
):
    """Keep what the rays of an iteration came to, one row a ray, and the loss in the row behind them."""
    tid = wp.tid()
    n = iteration[0]
    noted[n, tid, 0] = float(keep[tid])
    noted[n, tid, 1] = float(inlier[tid])
    noted[n, tid, 2] = measured_depth[tid]
    noted[n, tid, 3] = depth[tid]
    if tid == 0:
        noted[n, noted.shape[1] - 1, 0] = loss[0]


@wp.kernel(enable_backward=False)
def note_forecast(iteration: wp.array[int], counts: wp.array[int], noted: wp.array3d[float]):
    """Beside the loss that `note_rays` keeps: how many rays of the coarse term are in it."""
    noted[iteration[0], noted.shape[1] - 1, 1] = float(counts[1])
