"""Space that a look at the map found free: samples of pictures are left out there (ours, not the paper's).

A look takes samples along some rays of a picture. The cell of a lattice in which one was taken was looked at; where its
logit is beyond a limit, its cell and the 26 about it may be occupied. What was looked at and is not that is free.
"""

import warp as wp

from warpslam.kernels.grid import Lattice, find_cell, row_of
from warpslam.kernels.pixels import MODULE
from warpslam.kernels.samples import Rays, sample_point


@wp.struct
class Looks:
    """By the row of a cell's lowest corner: whether it was looked at, and whether it may be occupied."""

    looked: wp.array[wp.uint8]
    occupied: wp.array[wp.uint8]


@wp.kernel(module=MODULE, enable_backward=False)
def look(
    first: int,
    lattice: Lattice,
    rays: Rays,
    keep: wp.array[int],
    logit: wp.array[float],
    limit: float,
    looks: Looks,
):
    """Note what the samples of some rays say of their cells."""
    ray = first + wp.tid()
    if keep[ray] == 0:
        return
    for n in range(rays.sample_count):
        sample = ray * rays.sample_count + n
        corner = find_cell(lattice, sample_point(sample, rays)).corner
        looks.looked[row_of(lattice, corner[0], corner[1], corner[2])] = wp.uint8(1)
        if not (logit[sample] <= limit):
            for i in range(wp.max(corner[0] - 1, 0), wp.min(corner[0] + 2, lattice.shape[0])):
                for j in range(wp.max(corner[1] - 1, 0), wp.min(corner[1] + 2, lattice.shape[1])):
                    for k in range(wp.max(corner[2] - 1, 0), wp.min(corner[2] + 2, lattice.shape[2])):
                        looks.occupied[row_of(lattice, i, j, k)] = wp.uint8(1)


@wp.func
def is_wanted(sample: int, lattice: Lattice, rays: Rays, looks: Looks) -> bool:
    """Whether a sample does not lie in free space, or is the last of its ray."""
    if sample % rays.sample_count == rays.sample_count - 1:
        return True
    corner = find_cell(lattice, sample_point(sample, rays)).corner
    row = row_of(lattice, corner[0], corner[1], corner[2])
    return looks.looked[row] == wp.uint8(0) or looks.occupied[row] != wp.uint8(0)


@wp.kernel(module=MODULE, enable_backward=False)
def take_wanted(first: int, lattice: Lattice, rays: Rays, keep: wp.array[int], looks: Looks, counts: wp.array[int]):
    """Bring the samples of each ray that are not in free space to its front; the last one again in place of the others.

    counts: Gets how many they are; 1 where a ray is not kept.
    """
    ray = first + wp.tid()
    counts[ray] = 1
    if keep[ray] == 0:
        return
    start = ray * rays.sample_count
    count = int(0)
    for n in range(rays.sample_count):
        if is_wanted(start + n, lattice, rays, looks):
            rays.z[start + count] = rays.z[start + n]
            count += 1
    counts[ray] = count
    for n in range(count, rays.sample_count):
        rays.z[start + n] = rays.z[start + count - 1]
