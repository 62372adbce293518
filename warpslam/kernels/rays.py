"""Pixels, rays and samples (Sec. 3.3, "stratified and near-surface sampling"; constants of the released code).

    d_camera = ((u - cx) / fx, (v - cy) / fy, 1)      OpenCV axes, not normalised, so that the ray parameter is z-depth
    o, d     = t, R(q) d_camera                       pose vector (qw, qx, qy, qz, tx, ty, tz), q of any length
    t_exit   = min over axes of max over the two planes of (plane - o) / d
    kept     : t_exit >= D                            D = 0 (no measurement) passes; `drop_unseen` and
                                                      `drop_contradicted` are ours

Samples along a kept ray, with s in [0, 1] evenly spaced and D_max the largest D of the kept rays of the batch:

    32 over [near, far]: near = 0.01 D, far = clamp(t_exit + 0.01, 0, 1.2 D_max); without depth near = 0.01, far =
    t_exit + 0.01
    16 near the surface: D > 0: [0.95 D, 1.05 D]; D = 0: [0.001, D_max]

merged in ascending order into ``z``, shape (ray_count * sample_count,). Gradients reach o and d, never z: `cast_rays`
is differentiated by the tape, the other kernels have no gradient.
"""

import warp as wp

from warpslam.kernels.grid import Lattice, find_cell, row_of

wp.set_module_options({"max_unroll": 16})


@wp.func
def rotation_from_quaternion(w: float, x: float, y: float, z: float) -> wp.mat33:
    s = 2.0 / (w * w + x * x + y * y + z * z)
    return wp.mat33(
        1.0 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w),
        s * (x * y + z * w), 1.0 - s * (x * x + z * z), s * (y * z - x * w),
        s * (x * z - y * w), s * (y * z + x * w), 1.0 - s * (x * x + y * y),
    )  # fmt: skip


@wp.func
def pixel_direction(u: int, v: int, focal: wp.vec2, center: wp.vec2) -> wp.vec3:
    return wp.vec3((float(u) - center[0]) / focal[0], (float(v) - center[1]) / focal[1], 1.0)


@wp.func
def nearest_pixel(q: wp.vec3, focal: wp.vec2, center: wp.vec2) -> wp.vec2i:
    """The pixel that a point in front of the camera, in its coordinates, falls on; it may lie outside the image."""
    return wp.vec2i(int(wp.rint(focal[0] * q[0] / q[2] + center[0])), int(wp.rint(focal[1] * q[1] / q[2] + center[1])))


@wp.func
def cell_pixel(cell: int, cells: wp.vec2i, width: int, height: int, x: float, y: float) -> wp.vec2i:
    """The pixel at (x, y), each in [0, 1), of a cell; cells[0] x cells[1] of them cover the image, row by row."""
    u = (float(cell % cells[0]) + x) * float(width) / float(cells[0])
    v = (float(cell // cells[0]) + y) * float(height) / float(cells[1])
    return wp.vec2i(wp.min(int(u), width - 1), wp.min(int(v), height - 1))


@wp.kernel(enable_backward=False)
def draw_pixels(
    seeds: wp.array[int],
    iteration: wp.array[int],
    rays_per_frame: int,
    window: wp.array[int],
    edge_u: int,
    edge_v: int,
    focal: wp.vec2,
    center: wp.vec2,
    rgb_images: wp.array4d[wp.uint8],
    depth_images: wp.array3d[wp.uint16],
    depth_scales: wp.array[float],
    active_share: float,
    cells: wp.vec2i,
    cumulative_error: wp.array2d[float],
    frame: wp.array[int],
    direction_camera: wp.array[wp.vec3],
    depth: wp.array[float],
    rgb: wp.array[wp.vec3],
):
    """Random pixels, with replacement; ``window[f]`` is the image slot of frame f of the window.

    Uniform inside the border, but for ``active_share`` of them, which fall on the image's cells in proportion to their
    error. Seeds lie on the device, one an iteration, so that a recorded iteration draws other pixels when it is
    replayed.
    """
    tid = wp.tid()
    f = tid // rays_per_frame
    slot = window[f]
    height = depth_images.shape[1]
    width = depth_images.shape[2]
    state = wp.rand_init(seeds[iteration[0]], tid)
    u = wp.randi(state, edge_u, width - edge_u)
    v = wp.randi(state, edge_v, height - edge_v)
    if active_share > 0.0 and wp.randf(state) < active_share:
        last = cells[0] * cells[1] - 1
        wanted = wp.randf(state) * cumulative_error[f, last]
        low = int(0)
        high = int(last)
        while low < high:
            middle = (low + high) // 2
            if cumulative_error[f, middle] > wanted:
                high = middle
            else:
                low = middle + 1
        x = wp.randf(state)
        y = wp.randf(state)
        pixel = cell_pixel(low, cells, width, height, x, y)
        u = pixel[0]
        v = pixel[1]
    frame[tid] = f
    direction_camera[tid] = pixel_direction(u, v, focal, center)
    depth[tid] = float(depth_images[slot, v, u]) * depth_scales[slot]
    rgb[tid] = (
        wp.vec3(float(rgb_images[slot, v, u, 0]), float(rgb_images[slot, v, u, 1]), float(rgb_images[slot, v, u, 2]))
        / 255.0
    )


@wp.kernel(enable_backward=False)
def probe_pixels(
    seeds: wp.array[int],
    iteration: wp.array[int],
    window: wp.array[int],
    cells: wp.vec2i,
    focal: wp.vec2,
    center: wp.vec2,
    depth_images: wp.array3d[wp.uint16],
    depth_scales: wp.array[float],
    frame: wp.array[int],
    direction_camera: wp.array[wp.vec3],
    depth: wp.array[float],
):
    """One random pixel in each cell of each image of the window: where to look for the error of the cell."""
    tid = wp.tid()
    f = tid // (cells[0] * cells[1])
    slot = window[f]
    state = wp.rand_init(seeds[iteration[0]], tid)
    x = wp.randf(state)
    y = wp.randf(state)
    pixel = cell_pixel(tid % (cells[0] * cells[1]), cells, depth_images.shape[2], depth_images.shape[1], x, y)
    frame[tid] = f
    direction_camera[tid] = pixel_direction(pixel[0], pixel[1], focal, center)
    depth[tid] = float(depth_images[slot, pixel[1], pixel[0]]) * depth_scales[slot]


@wp.func
def least_and_largest_depth(image: wp.array3d[wp.uint16], slot: int, scale: float, pixel: wp.vec2i) -> wp.vec2:
    """Of a pixel and its eight neighbours; (0, 0) if one of them is missing or outside."""
    least = float(1.0e30)
    largest = float(0.0)
    for dv in range(-1, 2):
        for du in range(-1, 2):
            x = pixel[0] + du
            y = pixel[1] + dv
            if x < 0 or x >= image.shape[2] or y < 0 or y >= image.shape[1]:
                return wp.vec2(0.0, 0.0)
            depth = float(image[slot, y, x]) * scale
            if depth <= 0.0:
                return wp.vec2(0.0, 0.0)
            least = wp.min(least, depth)
            largest = wp.max(largest, depth)
    return wp.vec2(least, largest)


@wp.kernel(enable_backward=False)
def drop_unseen(
    lattice: Lattice,
    seen: wp.array[wp.uint8],
    ray_origin: wp.array[wp.vec3],
    ray_direction: wp.array[wp.vec3],
    depth: wp.array[float],
    keep: wp.array[int],
):
    """Leave out rays that end in a cell with a vertex that no mapped frame has seen."""
    tid = wp.tid()
    if keep[tid] == 0 or depth[tid] <= 0.0:
        return
    corner = find_cell(lattice, ray_origin[tid] + depth[tid] * ray_direction[tid]).corner
    for di in range(2):
        for dj in range(2):
            for dk in range(2):
                if seen[row_of(lattice, corner[0] + di, corner[1] + dj, corner[2] + dk)] == wp.uint8(0):
                    keep[tid] = 0


@wp.kernel(enable_backward=False)
def drop_contradicted(
    current: int,
    margin: float,
    T_camera_world: wp.mat44,
    focal: wp.vec2,
    center: wp.vec2,
    depth_images: wp.array3d[wp.uint16],
    depth_scales: wp.array[float],
    frame: wp.array[int],
    origin: wp.array[wp.vec3],
    direction: wp.array[wp.vec3],
    depth: wp.array[float],
    keep: wp.array[int],
):
    """Leave out the rays of earlier frames that the current depth image, in slot 0, contradicts by ``margin``: it sees
    through the point they measured, or measures a surface that they pass through.

    A ray is looked at every half ``margin``. A pixel speaks only where its neighbours agree, so that outlines, where a
    little shift of the camera changes everything, contradict nothing.
    """
    tid = wp.tid()
    if keep[tid] == 0 or frame[tid] == current or depth[tid] <= 0.0:
        return
    count = int(depth[tid] / (0.5 * margin)) + 1
    for n in range(count):
        # The last one is the point that was measured.
        z = depth[tid] * float(n + 1) / float(count)
        q = wp.transform_point(T_camera_world, origin[tid] + z * direction[tid])
        if q[2] > 0.0:
            seen = least_and_largest_depth(depth_images, 0, depth_scales[0], nearest_pixel(q, focal, center))
            sees_through = n + 1 == count and q[2] < seen[0] - margin
            is_behind = q[2] > seen[1] + 0.5 * margin and q[2] < seen[0] + 1.5 * margin
            if seen[0] > 0.0 and (sees_through or (z < depth[tid] - margin and is_behind)):
                keep[tid] = 0
                return


@wp.kernel(enable_backward=False)
def accumulate_errors(
    cell_count: int,
    largest: float,
    keep: wp.array[int],
    measured_depth: wp.array[float],
    depth: wp.array[float],
    cumulative_error: wp.array2d[float],
):
    """Running sums of |D - D^|, at most ``largest``, over the cells of an image, one image a thread."""
    f = wp.tid()
    total = float(0.0)
    for c in range(cell_count):
        n = f * cell_count + c
        # Where nothing errs, all cells are alike.
        total += 1.0e-6
        if keep[n] != 0 and measured_depth[n] > 0.0:
            total += wp.min(wp.abs(measured_depth[n] - depth[n]), largest)
        cumulative_error[f, c] = total


@wp.kernel(enable_backward=False)
def grid_pixels(
    first_row: int,
    width: int,
    stride: int,
    focal: wp.vec2,
    center: wp.vec2,
    frame: wp.array[int],
    direction_camera: wp.array[wp.vec3],
):
    """Rays of consecutive pixels, row by row, every ``stride``-th pixel: for whole images."""
    tid = wp.tid()
    u = stride * (tid % width)
    v = stride * (first_row + tid // width)
    frame[tid] = 0
    direction_camera[tid] = pixel_direction(u, v, focal, center)


@wp.kernel
def cast_rays(
    poses: wp.array2d[float],
    frame: wp.array[int],
    direction_camera: wp.array[wp.vec3],
    ray_origin: wp.array[wp.vec3],
    ray_direction: wp.array[wp.vec3],
):
    tid = wp.tid()
    f = frame[tid]
    R = rotation_from_quaternion(poses[f, 0], poses[f, 1], poses[f, 2], poses[f, 3])
    ray_direction[tid] = R * direction_camera[tid]
    ray_origin[tid] = wp.vec3(poses[f, 4], poses[f, 5], poses[f, 6])


@wp.kernel(enable_backward=False)
def bound_rays(
    low: wp.vec3,
    high: wp.vec3,
    ray_origin: wp.array[wp.vec3],
    ray_direction: wp.array[wp.vec3],
    depth: wp.array[float],
    use_depth: int,
    t_exit: wp.array[float],
    keep: wp.array[int],
    max_depth: wp.array[float],
):
    """Exit distance from the map's bound, whether the ray is kept, and the largest depth of the kept rays."""
    tid = wp.tid()
    o = ray_origin[tid]
    d = ray_direction[tid]
    t = float(1.0e10)
    for axis in range(3):
        if d[axis] != 0.0:
            t = wp.min(t, wp.max((low[axis] - o[axis]) / d[axis], (high[axis] - o[axis]) / d[axis]))
    t_exit[tid] = t
    kept = int(1)
    if use_depth != 0:
        kept = wp.where(t >= depth[tid], 1, 0)
        if kept == 1:
            wp.atomic_max(max_depth, 0, depth[tid])
    keep[tid] = kept


@wp.func
def fraction(k: int, count: int, jitter: int, state: wp.uint32) -> float:
    """s of sample k of ``count``: even, or (Sec. 3.3) uniform between the midpoints to its neighbours."""
    s = float(k) / float(count - 1)
    if jitter != 0:
        step = 1.0 / float(count - 1)
        low = wp.max(s - 0.5 * step, 0.0)
        high = wp.min(s + 0.5 * step, 1.0)
        random = wp.rand_init(int(state), k)
        s = low + (high - low) * wp.randf(random)
    return s


@wp.func
def stratum(k: int, count: int, near: float, far: float, jitter: int, state: wp.uint32) -> float:
    s = fraction(k, count, jitter, state)
    return near * (1.0 - s) + far * s


@wp.func
def surface_sample(k: int, count: int, depth: float, max_depth: float, jitter: int, state: wp.uint32) -> float:
    # Other random numbers than those of the strata.
    s = fraction(k, count, jitter, state + wp.uint32(1000003))
    if depth > 0.0:
        return 0.95 * depth * (1.0 - s) + 1.05 * depth * s
    return 0.001 * (1.0 - s) + max_depth * s


@wp.func
def place_ray(
    tid: int,
    count: int,
    surface_count: int,
    near: float,
    far: float,
    depth: float,
    max_depth: float,
    jitter: int,
    state: wp.uint32,
    z: wp.array[float],
):
    # Both sequences ascend, so that sorting is one merge.
    total = count + surface_count
    a = int(0)
    b = int(0)
    za = stratum(0, count, near, far, jitter, state)
    zb = float(0.0)
    if surface_count > 0:
        zb = surface_sample(0, surface_count, depth, max_depth, jitter, state)
    for n in range(total):
        take_a = a < count
        if take_a and b < surface_count:
            take_a = za <= zb
        if take_a:
            z[tid * total + n] = za
            a += 1
            if a < count:
                za = stratum(a, count, near, far, jitter, state)
        else:
            z[tid * total + n] = zb
            b += 1
            if b < surface_count:
                zb = surface_sample(b, surface_count, depth, max_depth, jitter, state)


@wp.kernel(enable_backward=False)
def place_samples(
    start: int,
    seeds: wp.array[int],
    iteration: wp.array[int],
    jitter: int,
    count: int,
    surface_count: int,
    use_depth: int,
    depth: wp.array[float],
    t_exit: wp.array[float],
    keep: wp.array[int],
    max_depth: wp.array[float],
    z: wp.array[float],
):
    tid = start + wp.tid()
    if keep[tid] == 0:
        return
    near = float(0.01)
    far = t_exit[tid] + 0.01
    largest = float(0.0)
    measured = float(0.0)
    if use_depth != 0:
        measured = depth[tid]
        largest = max_depth[0]
        near = 0.01 * measured
        far = wp.clamp(far, 0.0, 1.2 * largest)
    state = wp.rand_init(seeds[iteration[0]] ^ 0x5BD1E995, tid)
    place_ray(tid, count, surface_count, near, far, measured, largest, jitter, state, z)


@wp.kernel(enable_backward=False)
def collect_ray_gradients(
    start: int,
    sample_count: int,
    keep: wp.array[int],
    counts: wp.array[int],
    z: wp.array[float],
    point_grad: wp.array[wp.vec3],
    origin_grad: wp.array[wp.vec3],
    direction_grad: wp.array[wp.vec3],
):
    """Adjoint of p = o + z d, summed over the samples of a ray that ``counts``; clears ``point_grad`` for the next
    iteration.
    """
    tid = start + wp.tid()
    if keep[tid] == 0:
        return
    do = wp.vec3()
    dd = wp.vec3()
    for n in range(sample_count):
        g = point_grad[tid * sample_count + n]
        do += g
        dd += z[tid * sample_count + n] * g
        point_grad[tid * sample_count + n] = wp.vec3()
    if counts[tid] != 0:
        origin_grad[tid] = origin_grad[tid] + do
        direction_grad[tid] = direction_grad[tid] + dd
