"""Adam (Kingma & Ba 2015) on grid rows, decoder weights and pose vectors.

    m = 0.9 m + 0.1 g;  v = 0.999 v + 0.001 g^2;  x -= lr (m / (1 - 0.9^t)) / (sqrt(v / (1 - 0.999^t)) + 1e-8)

The step count t lives in a device array and is advanced by `advance_step`, so that a recorded iteration can be
replayed. Only selected rows are visited; a row whose gradient is not finite is left alone and counted; each kernel sums
the gradient buffers of all threads and clears them for the next iteration.
"""

import warp as wp

from warpslam.kernels.grid import Vec32

wp.set_module_options({"block_dim": 32})


@wp.func
def adam_scale(step: int) -> wp.vec2:
    """(1 / (1 - beta1^t), 1 / (1 - beta2^t))."""
    t = float(step)
    return wp.vec2(1.0 / (1.0 - wp.pow(0.9, t)), 1.0 / (1.0 - wp.pow(0.999, t)))


@wp.kernel(enable_backward=False)
def advance_step(step: wp.array[int]):
    step[0] = step[0] + 1


@wp.kernel(enable_backward=False)
def adam_rows(
    start: int,
    rows: wp.array[int],
    step: wp.array[int],
    learning_rate: float,
    x: wp.array[Vec32],
    grad: wp.array2d[Vec32],
    m: wp.array[Vec32],
    v: wp.array[Vec32],
    rejected: wp.array[int],
):
    row = rows[start + wp.tid()]
    g = grad[0, row]
    grad[0, row] = Vec32()
    for slot in range(1, grad.shape[0]):
        g += grad[slot, row]
        grad[slot, row] = Vec32()
    total = float(0.0)
    for k in range(32):
        total += wp.abs(g[k])
    if not wp.isfinite(total):
        # NaN never enters the map: the row keeps its value, and the count tells.
        rejected[0] = rejected[0] + 1
        return
    scale = adam_scale(step[0])
    m_new = 0.9 * m[row] + 0.1 * g
    v_new = 0.999 * v[row] + 0.001 * wp.cw_mul(g, g)
    m[row] = m_new
    v[row] = v_new
    change = Vec32()
    for k in range(32):
        change[k] = scale[0] * m_new[k] / (wp.sqrt(scale[1] * v_new[k]) + 1.0e-8)
    x[row] = x[row] - learning_rate * change


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    for (int offset = 16; offset > 0; offset >>= 1) x += __shfl_xor_sync(0xffffffff, x, offset);
#endif
    return x;
""")
def warp_sum(x: float) -> float:
    """Sum over the 32 threads of a warp (CUDA)."""
    ...


@wp.kernel(enable_backward=False)
def adam_entries(
    rows: wp.array[int],
    step: wp.array[int],
    learning_rate: float,
    x: wp.array2d[float],
    grad: wp.array3d[float],
    m: wp.array2d[float],
    v: wp.array2d[float],
    rejected: wp.array[int],
):
    """`adam_rows` for CUDA: a thread an entry of a row, so that a warp reads and writes 128 bytes in a row."""
    n, k = wp.tid()
    row = rows[n]
    g = float(0.0)
    for slot in range(grad.shape[0]):
        g += grad[slot, row, k]
    for slot in range(grad.shape[0]):
        grad[slot, row, k] = 0.0
    if not wp.isfinite(warp_sum(wp.abs(g))):
        if k == 0:
            wp.atomic_add(rejected, 0, 1)
        return
    scale = adam_scale(step[0])
    m_new = 0.9 * m[row, k] + 0.1 * g
    v_new = 0.999 * v[row, k] + 0.001 * g * g
    m[row, k] = m_new
    v[row, k] = v_new
    x[row, k] = x[row, k] - learning_rate * (scale[0] * m_new / (wp.sqrt(scale[1] * v_new) + 1.0e-8))


@wp.kernel(enable_backward=False)
def clear_moments(rows: wp.array[int], m: wp.array[Vec32], v: wp.array[Vec32]):
    row = rows[wp.tid()]
    m[row] = Vec32()
    v[row] = Vec32()


@wp.kernel(enable_backward=False)
def adam_poses(
    step: wp.array[int],
    rates: wp.array[wp.vec2],
    first: int,
    x: wp.array2d[float],
    grad: wp.array2d[float],
    m: wp.array2d[float],
    v: wp.array2d[float],
):
    """Pose vectors (qw, qx, qy, qz, tx, ty, tz); rows below ``first`` stay fixed. Clears the gradient.

    rates: of rotation and translation, one row a step; the last row holds from there on.
    """
    f, k = wp.tid()
    g = grad[f, k]
    grad[f, k] = 0.0
    if f < first:
        return
    scale = adam_scale(step[0])
    m[f, k] = 0.9 * m[f, k] + 0.1 * g
    v[f, k] = 0.999 * v[f, k] + 0.001 * g * g
    both = rates[wp.min(step[0], rates.shape[0]) - 1]
    rate = wp.where(k < 4, both[0], both[1])
    x[f, k] = x[f, k] - rate * scale[0] * m[f, k] / (wp.sqrt(scale[1] * v[f, k]) + 1.0e-8)


@wp.kernel(enable_backward=False)
def take_pose(iteration: wp.array[int], candidates: wp.array2d[float], poses: wp.array2d[float]):
    """The first pose vector becomes the candidate of this iteration."""
    k = wp.tid()
    poses[0, k] = candidates[iteration[0], k]


@wp.kernel(enable_backward=False)
def note_pose(iteration: wp.array[int], poses: wp.array2d[float], visited: wp.array2d[float]):
    """Keep the first pose vector of an iteration."""
    k = wp.tid()
    visited[iteration[0], k] = poses[0, k]
