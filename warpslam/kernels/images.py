"""Depth images in metres and in the units that are stored: D = units * scale, 0 where nothing was measured."""

import warp as wp

from warpslam.kernels.frustum import MODULE


@wp.kernel(module=MODULE, enable_backward=False)
def to_units(metres: wp.array2d[float], scale: wp.array[float], units: wp.array2d[wp.uint16]):
    v, u = wp.tid()
    units[v, u] = wp.uint16(wp.rint(metres[v, u] / scale[0]))


@wp.kernel(module=MODULE, enable_backward=False)
def to_metres(units: wp.array2d[wp.uint16], scale: wp.array[float], metres: wp.array2d[float]):
    v, u = wp.tid()
    metres[v, u] = float(units[v, u]) * scale[0]
