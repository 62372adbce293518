"""Images on the device."""

import warp as wp


@wp.kernel(enable_backward=False)
def to_metres(depth: wp.array2d[wp.uint16], scale: wp.array[float], metres: wp.array2d[float]):
    """Depth [m] of an image that is stored in units of ``scale[0]``."""
    v, u = wp.tid()
    metres[v, u] = float(depth[v, u]) * scale[0]
