"""Which pixels are looked at, and what they measure.

    d_camera = ((u - cx) / fx, (v - cy) / fy, 1)      OpenCV axes, not normalised, so that the ray parameter is z-depth

Pixels are drawn uniformly, or in proportion to the error of the image's cells (ours; see
`warpslam.mapping.active_sampling`). Nothing here has a gradient.
"""

import warp as wp

MODULE = "warpslam.rays"
"""Pixels, rays, samples and what rejects rays compile as one Warp module."""

wp.get_module(MODULE).options.update({"max_unroll": 16, "block_dim": 32})


@wp.struct
class Camera:
    """Focal lengths and principal point [px]."""

    focal: wp.vec2
    center: wp.vec2


@wp.struct
class Images:
    """Images in slots: colour (slots, H, W, 3), depth (slots, H, W), and metres a unit of depth (slots,)."""

    rgb: wp.array4d[wp.uint8]
    depth: wp.array3d[wp.uint16]
    scale: wp.array[float]


@wp.struct
class Draw:
    """Seeds on the device, one an iteration, so that a recorded iteration draws other numbers when it is replayed."""

    seeds: wp.array[int]
    iteration: wp.array[int]


@wp.struct
class ErrorCells:
    """Which share of the pixels follows the error of the cells[0] x cells[1] cells of an image, and running sums of
    that, (frames, cells).
    """

    share: float
    cells: wp.vec2i
    cumulative_error: wp.array2d[float]


@wp.struct
class Pixels:
    """Pixels of a batch: frame of the window, direction in camera axes, depth [m] (0 = missing), colour in [0, 1]."""

    frame: wp.array[int]
    direction: wp.array[wp.vec3]
    depth: wp.array[float]
    rgb: wp.array[wp.vec3]


@wp.func
def pixel_direction(u: int, v: int, camera: Camera) -> wp.vec3:
    return wp.vec3(
        (float(u) - camera.center[0]) / camera.focal[0], (float(v) - camera.center[1]) / camera.focal[1], 1.0
    )


@wp.func
def place_of(x: float) -> int:
    """A coordinate as a whole number. Far outside every image it is no farther than there: converted as they are, huge
    numbers become the largest integer on CUDA, to which nothing can be added, and NaN becomes anything.
    """
    return int(wp.clamp(x, -2.0, 32768.0))


@wp.func
def nearest_pixel(q: wp.vec3, camera: Camera) -> wp.vec2i:
    """The pixel that a point in front of the camera, in its coordinates, falls on; it may lie outside the image."""
    return wp.vec2i(
        place_of(wp.rint(camera.focal[0] * q[0] / q[2] + camera.center[0])),
        place_of(wp.rint(camera.focal[1] * q[1] / q[2] + camera.center[1])),
    )


@wp.func
def measured(images: Images, slot: int, u: int, v: int) -> float:
    """Depth of a pixel [m]."""
    return float(images.depth[slot, v, u]) * images.scale[slot]


@wp.func
def cell_pixel(cell: int, cells: wp.vec2i, width: int, height: int, x: float, y: float) -> wp.vec2i:
    """The pixel at (x, y), each in [0, 1), of a cell; cells[0] x cells[1] of them cover the image, row by row."""
    u = (float(cell % cells[0]) + x) * float(width) / float(cells[0])
    v = (float(cell // cells[0]) + y) * float(height) / float(cells[1])
    return wp.vec2i(wp.min(int(u), width - 1), wp.min(int(v), height - 1))


@wp.kernel(module=MODULE, enable_backward=False)
def draw_pixels(
    draw: Draw,
    rays_per_frame: int,
    window: wp.array[int],
    edges: wp.vec2i,
    camera: Camera,
    images: Images,
    active: ErrorCells,
    pixels: Pixels,
):
    """Random pixels, with replacement; ``window[f]`` is the image slot of frame f of the window.

    Uniform inside the border of ``edges`` columns and rows, but for a share of them, which fall on the image's cells in
    proportion to their error.
    """
    tid = wp.tid()
    f = tid // rays_per_frame
    slot = window[f]
    height = images.depth.shape[1]
    width = images.depth.shape[2]
    state = wp.rand_init(draw.seeds[draw.iteration[0]], tid)
    u = wp.randi(state, edges[0], width - edges[0])
    v = wp.randi(state, edges[1], height - edges[1])
    if active.share > 0.0 and wp.randf(state) < active.share:
        last = active.cells[0] * active.cells[1] - 1
        wanted = wp.randf(state) * active.cumulative_error[f, last]
        low = int(0)
        high = int(last)
        while low < high:
            middle = (low + high) // 2
            if active.cumulative_error[f, middle] > wanted:
                high = middle
            else:
                low = middle + 1
        x = wp.randf(state)
        y = wp.randf(state)
        pixel = cell_pixel(low, active.cells, width, height, x, y)
        u = pixel[0]
        v = pixel[1]
    pixels.frame[tid] = f
    pixels.direction[tid] = pixel_direction(u, v, camera)
    pixels.depth[tid] = measured(images, slot, u, v)
    pixels.rgb[tid] = (
        wp.vec3(float(images.rgb[slot, v, u, 0]), float(images.rgb[slot, v, u, 1]), float(images.rgb[slot, v, u, 2]))
        / 255.0
    )


@wp.kernel(module=MODULE, enable_backward=False)
def probe_pixels(draw: Draw, window: wp.array[int], cells: wp.vec2i, camera: Camera, images: Images, pixels: Pixels):
    """One random pixel in each cell of each image of the window: where to look for the error of the cell. Colour is not
    looked at.
    """
    tid = wp.tid()
    f = tid // (cells[0] * cells[1])
    slot = window[f]
    state = wp.rand_init(draw.seeds[draw.iteration[0]], tid)
    x = wp.randf(state)
    y = wp.randf(state)
    pixel = cell_pixel(tid % (cells[0] * cells[1]), cells, images.depth.shape[2], images.depth.shape[1], x, y)
    pixels.frame[tid] = f
    pixels.direction[tid] = pixel_direction(pixel[0], pixel[1], camera)
    pixels.depth[tid] = measured(images, slot, pixel[0], pixel[1])


@wp.kernel(module=MODULE, enable_backward=False)
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


@wp.kernel(module=MODULE, enable_backward=False)
def grid_pixels(
    first_row: int, width: int, stride: int, camera: Camera, frame: wp.array[int], direction: wp.array[wp.vec3]
):
    """Rays of consecutive pixels, row by row, every ``stride``-th pixel: for whole images."""
    tid = wp.tid()
    u = stride * (tid % width)
    v = stride * (first_row + tid // width)
    frame[tid] = 0
    direction[tid] = pixel_direction(u, v, camera)
