"""Rows of a grid that an iteration touches, and Adam on them alone.

    m = 0.9 m + 0.1 g;  v = b v + (1 - b) g^2;  x -= lr (m / (1 - 0.9^t)) / (sqrt(v / (1 - b^t)) + 1e-6),  b = 0.99

t counts the updates of the row, and moments are kept for good: a new vertex takes bias-corrected full steps while an
old one does not jump, and one without a gradient stands still. Rows that get a gradient are listed once each, and their
gradients lie side by side in the order of the list, so that they stay in the cache: ``place`` leads from a row to its
place there, -1 for all others. Moments of a row lie side by side, (rows, 2), m and v. Rows that are held get gradients
like any other, and stay what they are.
"""

import warp as wp

from warpslam.kernels.adam import warp_sum
from warpslam.kernels.grid import Lattice, Vec32, find_cell, row_of
from warpslam.kernels.samples import Rays, sample_point
from warpslam.kernels.supervision import MODULE

HELD = wp.constant(wp.uint8(2))
"""Of `RowState.changed`: a row that may not change."""
AHEAD = wp.constant(8)
"""Rows between the one that is updated and the one that is fetched (CPU)."""
BETA = wp.constant(0.99)
LOG_BETA_1 = wp.constant(-0.105360515657826)
LOG_BETA_2 = wp.constant(-0.010050335853501)


@wp.struct
class Touched:
    """Rows that are listed: the first ``count[0]`` of ``rows``; their place among them by row, and -1 for others."""

    count: wp.array[int]
    rows: wp.array[int]
    place: wp.array[int]


@wp.struct
class RowState:
    """What Adam keeps of each row: moments (rows, 2), number of updates (rows,), and whether the rows changed since the
    call began, or are `HELD`, (rows,).
    """

    moments: wp.array2d[Vec32]
    updates: wp.array[int]
    changed: wp.array[wp.uint8]


@wp.func
def touch(touched: Touched, lattice: Lattice, p: wp.vec3):
    """List the rows around a point that are not yet, and are not shared."""
    corner = find_cell(lattice, p).corner
    for di in range(2):
        for dj in range(2):
            for dk in range(2):
                row = row_of(lattice, corner[0] + di, corner[1] + dj, corner[2] + dk)
                if row >= lattice.shared and touched.place[row] < 0:
                    # Only one thread finds -1.
                    if wp.atomic_max(touched.place, row, 0) < 0:
                        n = wp.atomic_add(touched.count, 0, 1)
                        touched.rows[n] = row
                        touched.place[row] = n


@wp.kernel(module=MODULE)
def clear_touched(touched: Touched):
    touched.count[0] = 0


@wp.kernel(module=MODULE)
def touch_steep(touched: Touched, lattice: Lattice, rays: Rays, logit_grad: wp.array[float], min_gradient: float):
    """List the rows around the samples whose logit has a gradient beyond ``min_gradient``. On the CPU one thread must
    do all.
    """
    tid = wp.tid()
    for n in range(rays.sample_count):
        i = tid * rays.sample_count + n
        if wp.abs(logit_grad[i]) > min_gradient:
            touch(touched, lattice, sample_point(i, rays))


@wp.kernel(module=MODULE)
def touch_colored(touched: Touched, lattice: Lattice, rays: Rays, keep: wp.array[int], color_grad: wp.array[wp.vec3]):
    """The same for colour."""
    tid = wp.tid()
    if keep[tid] != 0:
        for n in range(rays.sample_count):
            i = tid * rays.sample_count + n
            if wp.length_sq(color_grad[i]) > 0.0:
                touch(touched, lattice, sample_point(i, rays))


@wp.func
def bias_scale(updates: int) -> wp.vec2:
    """(1 / (1 - beta1^t), 1 / (1 - beta2^t))."""
    t = float(updates)
    return wp.vec2(1.0 / (1.0 - wp.exp(t * LOG_BETA_1)), 1.0 / (1.0 - wp.exp(t * LOG_BETA_2)))


@wp.func_native("""
#if !defined(__CUDA_ARCH__)
    const char* m = (const char*)(state.moments.data + 2 * row);
    const char* v = (const char*)(x.data + row);
    for (int line = 0; line < 4; ++line) __builtin_prefetch(m + 64 * line, 1);
    for (int line = 0; line < 2; ++line) __builtin_prefetch(v + 64 * line, 1);
    __builtin_prefetch(state.updates.data + row, 1);
    __builtin_prefetch(state.changed.data + row, 1);
    __builtin_prefetch(touched.place.data + row, 1);
#endif
""")
def prefetch(touched: Touched, state: RowState, x: wp.array[Vec32], row: int):
    """Begin to bring to the cache what the update of a row reads (CPU)."""
    ...


@wp.kernel(module=MODULE)
def adam_touched(
    part: int,
    parts: int,
    learning_rate: float,
    touched: Touched,
    grad: wp.array2d[Vec32],
    state: RowState,
    x: wp.array[Vec32],
    rejected: wp.array[int],
):
    """One of ``parts`` threads (CPU): every so manieth row of the list. Clears gradients and places."""
    count = touched.count[0]
    for n in range(part, count, parts):
        # Rows lie anywhere in memory, and waiting for them one after the other takes longer than the arithmetic.
        prefetch(touched, state, x, touched.rows[wp.min(n + AHEAD * parts, count - 1)])
        row = touched.rows[n]
        touched.place[row] = -1
        g = grad[0, n]
        grad[0, n] = Vec32()
        for slot in range(1, grad.shape[0]):
            g += grad[slot, n]
            grad[slot, n] = Vec32()
        total = float(0.0)
        for k in range(32):
            total += wp.abs(g[k])
        if not wp.isfinite(total):
            # NaN never enters the map: the row keeps its value, and the count tells.
            rejected[0] = rejected[0] + 1
        elif state.changed[row] != HELD:
            t = state.updates[row] + 1
            m = 0.9 * state.moments[row, 0] + 0.1 * g
            v = BETA * state.moments[row, 1] + (1.0 - BETA) * wp.cw_mul(g, g)
            scale = bias_scale(t)
            change = Vec32()
            for k in range(32):
                change[k] = scale[0] * m[k] / (wp.sqrt(scale[1] * v[k]) + 1.0e-6)
            state.moments[row, 0] = m
            state.moments[row, 1] = v
            state.updates[row] = t
            state.changed[row] = wp.uint8(1)
            x[row] = x[row] - learning_rate * change


@wp.kernel(module=MODULE)
def adam_touched_entries(
    learning_rate: float,
    touched: Touched,
    grad: wp.array3d[float],
    moments: wp.array3d[float],
    state: RowState,
    x: wp.array2d[float],
    rejected: wp.array[int],
):
    """`adam_touched` for CUDA: a thread an entry of a listed row, 32 side by side."""
    n, k = wp.tid()
    if n >= touched.count[0]:
        return
    row = touched.rows[n]
    g = float(0.0)
    for slot in range(grad.shape[0]):
        g += grad[slot, n, k]
        grad[slot, n, k] = 0.0
    t = state.updates[row] + 1
    is_held = state.changed[row] == HELD
    is_finite = wp.isfinite(warp_sum(wp.abs(g)))  # and all 32 threads have read the count of updates, and that
    if k == 0:
        touched.place[row] = -1
        if not is_finite:
            wp.atomic_add(rejected, 0, 1)
        elif not is_held:
            state.updates[row] = t
            state.changed[row] = wp.uint8(1)
    if is_held or not is_finite:
        return
    m = 0.9 * moments[row, 0, k] + 0.1 * g
    v = BETA * moments[row, 1, k] + (1.0 - BETA) * g * g
    scale = bias_scale(t)
    moments[row, 0, k] = m
    moments[row, 1, k] = v
    x[row, k] = x[row, k] - learning_rate * (scale[0] * m / (wp.sqrt(scale[1] * v) + 1.0e-6))


@wp.kernel(module=MODULE)
def move_rows(
    layer: int,
    old_lattice: Lattice,
    shift: wp.vec3i,
    lattice: Lattice,
    old_moments: wp.array2d[Vec32],
    old_updates: wp.array[int],
    moments: wp.array2d[Vec32],
    updates: wp.array[int],
):
    """State of rows that were updated, from a layer along x on of a dense grid to the one that it grew to, by ``shift``
    vertices.
    """
    i, j, k = wp.tid()
    i += layer
    old = row_of(old_lattice, i, j, k)
    if old_updates[old] > 0:
        row = row_of(lattice, i + shift[0], j + shift[1], k + shift[2])
        updates[row] = old_updates[old]
        moments[row, 0] = old_moments[old, 0]
        moments[row, 1] = old_moments[old, 1]
