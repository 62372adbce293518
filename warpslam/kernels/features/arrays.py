"""Features of a frame and matches between frames, as the kernels see them."""

import warp as wp

MODULE = "warpslam.features"
"""All kernels of features compile as one Warp module."""

wp.get_module(MODULE).options.update({"max_unroll": 1, "block_dim": 32, "enable_backward": False})

NO_OWNER = wp.constant(2**30)
KEY_UNIT = wp.constant(65536)
"""A key of a match is distance of descriptors x this + number of the point: its least value has one owner."""


@wp.struct
class Feature:
    """What is measured at one feature."""

    pixel: wp.vec2
    """Column and row [px]."""
    pixel_sigma: float
    """Standard deviation of the position [px]."""
    inverse_depth: float
    """[1/m]; 0 where depth is missing."""
    on_edge: int
    """1 where depth steps beside the feature."""
    octave: int
    row_time: float
    """When the feature's row was seen, against the middle row [s]."""
    point: wp.vec3
    """Camera axes at the time of the middle row [m]; (0, 0, 0) where depth is missing."""


@wp.struct
class Features:
    """Features of one frame, n of them, ordered by cell of the image (row by row)."""

    count: int
    feature: wp.array[Feature]
    descriptor: wp.array2d[wp.uint64]
    """(n, 4): 256 bits."""
    starts: wp.array[int]
    """First feature of each cell, and the count."""


@wp.struct
class View:
    """Camera, its image [px], and the cells that features are ordered by."""

    focal: wp.vec2
    center: wp.vec2
    size: wp.vec2
    cell: float
    columns: int
    rows: int
    octave_factor: float
    """Scale between octaves."""
    octaves: int


@wp.struct
class Motion:
    """Twist of the camera in its own axes: T_world_camera(t + dt) = T_world_camera(t) exp(dt twist)."""

    translation: wp.vec3
    """[m/s]."""
    rotation: wp.vec3
    """[rad/s]."""


@wp.struct
class Matches:
    """Pairs of a point and a feature, one a row; row slot * stride + i is point i of the slot's frame."""

    row_count: int
    stride: int
    slot_count: int
    point: wp.array[wp.vec3]
    """Reference axes [m]."""
    feature: wp.array[int]
    """Feature of the frame, -1 = none."""
    key: wp.array[int]
    owner: wp.array2d[int]
    """(slots, features): least key among the points of a slot."""
    weight: wp.array[float]
    """1 / number of slots that a feature is matched in: it is one measurement."""
    inlier: wp.array[int]
    depth_error: wp.array[float]
    """1/z - 1/d of the row at the pose found [1/m]; 0 where there is none."""
