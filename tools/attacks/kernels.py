"""Kernels that turn numbers into places of an array, given numbers that no caller of ours would give them.

A debug build of Warp (`wp.config.mode`) ends the process at the first access outside an array, on the CPU; without one
only accesses far outside do.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from tools.attacks.isolation import Attempt
from tools.attacks.values import numbers
from warpslam.camera import Intrinsics
from warpslam.field.arrays import camera_struct, struct
from warpslam.kernels import frustum, grid, pixels, rectify, rejection, seen, visibility
from warpslam.kernels.features.agreement import depth_agreement
from warpslam.kernels.grid import Cell, Lattice, Vec32
from warpslam.kernels.samples import Rays

SHAPE = (3, 2, 4)
WIDTH, HEIGHT = 12, 9
COUNT = 64
CPU = "cpu"


@wp.kernel(enable_backward=False, module="attacks")
def look_up(level: grid.Level, points: wp.array[wp.vec3], cells: wp.array[Cell], values: wp.array[Vec32]):
    """Cell and features of a point."""
    tid = wp.tid()
    cells[tid] = grid.find_cell(level.lattice, points[tid])
    values[tid] = grid.interpolate(level, cells[tid])


@wp.kernel(enable_backward=False, module="attacks")
def scatter(
    level: grid.Level, points: wp.array[wp.vec3], place: wp.array[int], grad: wp.array2d[Vec32],
    back: wp.array[wp.vec3],
):  # fmt: skip
    """Both adjoints of a lookup."""
    tid = wp.tid()
    cell = grid.find_cell(level.lattice, points[tid])
    ones = Vec32(1.0)
    grid.interpolate_adjoint_features(grad, 0, place, level.lattice, cell, ones)
    back[tid] = grid.interpolate_adjoint_point(level, cell, ones)


def prepare(name: str) -> Attempt:
    """The first launch compiles, which takes longer than a try may."""
    attempt(np.random.default_rng(0))
    return attempt


def lattice() -> Lattice:
    """A small one."""
    value = Lattice()
    value.origin, value.inverse_spacing, value.shape = wp.vec3(-1.0, 0.0, 2.0), wp.vec3(2.0, 2.0, 2.0), wp.vec3i(*SHAPE)
    return value


def attempt(rng: np.random.Generator) -> str:
    """One launch of every kernel."""
    camera = Intrinsics(10.0, 10.0, 5.5, 4.0, WIDTH, HEIGHT)
    rows = int(np.prod(SHAPE))
    level = struct(grid.Level, lattice=lattice(), features=wp.ones(rows, dtype=Vec32, device=CPU))

    def vectors(count: int = COUNT) -> wp.array:
        return wp.array(numbers(rng, (count, 3)).astype(np.float32), dtype=wp.vec3, device=CPU)

    def matrix() -> wp.mat44:
        return wp.mat44(*numbers(rng, (16,), 0.2).astype(np.float32).tolist())

    def image() -> wp.array:
        return wp.array(numbers(rng, (HEIGHT, WIDTH), 0.2).astype(np.float32), dtype=float, device=CPU)

    points = vectors()
    cells, values = wp.zeros(COUNT, dtype=Cell, device=CPU), wp.zeros(COUNT, dtype=Vec32, device=CPU)
    wp.launch(look_up, COUNT, [level, points], [cells, values], device=CPU)
    found = cells.numpy()
    assert (found["corner"] >= 0).all() and (found["corner"] <= np.array(SHAPE) - 2).all(), "a cell outside the grid"
    assert (found["offset"] >= 0).all() and (found["offset"] <= 1).all(), "a place outside its cell"
    grad = wp.zeros((1, rows), dtype=Vec32, device=CPU)
    place, back = wp.array(np.arange(rows), dtype=int, device=CPU), wp.zeros(COUNT, dtype=wp.vec3, device=CPU)
    wp.launch(scatter, COUNT, [level, points, place], [grad, back], device=CPU)
    assert np.isfinite(grad.numpy()).all(), "a gradient that is not finite"

    rays = struct(
        Rays, sample_count=1, origin=vectors(), direction=vectors(), z=wp.zeros(COUNT, dtype=float, device=CPU)
    )
    depth = wp.array(numbers(rng, (COUNT,)).astype(np.float32), dtype=float, device=CPU)
    chosen = wp.ones(rows, dtype=wp.uint8, device=CPU)
    keep, frame = wp.ones(COUNT, dtype=int, device=CPU), wp.ones(COUNT, dtype=int, device=CPU)
    wp.launch(rejection.drop_unseen, COUNT, [level.lattice, chosen, rays, depth, keep], device=CPU)
    images = struct(
        pixels.Images,
        rgb=wp.zeros((1, HEIGHT, WIDTH, 3), dtype=wp.uint8, device=CPU),
        depth=wp.ones((1, HEIGHT, WIDTH), dtype=wp.uint16, device=CPU),
        scale=wp.array(numbers(rng, (1,)).astype(np.float32), dtype=float, device=CPU),
    )
    view = camera_struct(camera)
    arguments = [0, 0.1, matrix(), view, images, frame, rays, depth, keep]
    wp.launch(rejection.drop_contradicted, COUNT, arguments, device=CPU)

    looked_up, vertex_depth = wp.zeros(rows, dtype=float, device=CPU), wp.zeros(rows, dtype=float, device=CPU)
    largest = wp.zeros(1, dtype=float, device=CPU)
    arguments = [level.lattice, matrix(), view, image(), looked_up, vertex_depth, largest]
    wp.launch(frustum.project_vertices, rows, arguments, device=CPU)
    wp.launch(seen.mark_seen, rows, [0, level.lattice, matrix(), view, image(), 0.1, chosen], device=CPU)

    views = struct(
        visibility.Views,
        T_camera_world=wp.array([matrix()], dtype=wp.mat44, device=CPU),
        pinhole=wp.array(numbers(rng, (1, 4), 0.2).astype(np.float32), dtype=wp.vec4, device=CPU),
        image=wp.array([[0, WIDTH, HEIGHT]], dtype=wp.vec3i, device=CPU),
        depth=wp.array(numbers(rng, (WIDTH * HEIGHT,), 0.2).astype(np.float32), dtype=float, device=CPU),
        max_behind=float(rng.choice([0.3, np.inf, 1e38])),
        max_front=float(rng.choice([0.3, np.inf, 1e38])),
    )
    facing = wp.zeros(COUNT, dtype=wp.uint8, device=CPU)
    wp.launch(visibility.find_facing, COUNT, [0, points, vectors(), vectors(1), views, -1.0, 1.0, facing], device=CPU)

    counts = wp.zeros((2, 2), dtype=int, device=CPU)
    focal, center = (wp.vec2(*numbers(rng, (2,), 0.2).astype(np.float32).tolist()) for _ in range(2))
    arguments = [image(), image(), matrix(), matrix(), focal, center, 1, counts]
    wp.launch(depth_agreement, (HEIGHT, WIDTH), arguments, device=CPU)

    sweep = struct(
        rectify.Sweep,
        **{name: _hostile_field(kind.type, rng) for name, kind in rectify.Sweep.vars.items()},
    )
    new = (
        wp.zeros((HEIGHT, WIDTH, 3), dtype=wp.uint8, device=CPU),
        wp.zeros((HEIGHT, WIDTH), dtype=wp.uint16, device=CPU),
    )
    arguments = [images.rgb[0], images.depth[0], images.scale, view, sweep, *new, wp.zeros(1, dtype=float, device=CPU)]
    wp.launch(rectify.rectify, (HEIGHT, WIDTH), arguments, device=CPU)
    return "ok"


def _hostile_field(kind: type, rng: np.random.Generator) -> object:
    size = {wp.mat44: 16, wp.vec3: 3}.get(kind, 1)
    values = numbers(rng, (size,), 0.2).astype(np.float32).tolist()
    return kind(*values) if size > 1 else values[0]
