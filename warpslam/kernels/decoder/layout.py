"""Where the weights of a decoder lie among its rows of 32, and the structs that hand them to the kernels."""

import warp as wp

from warpslam.kernels.grid import Vec32

# Rows of the packed weights of a decoder with coordinates (`warpslam.field.packing` packs them).
B = 0  # 3 chunks x 3 axes
E0 = 9  # embedding -> layer 0, 96 rows (93 used)
E3 = 105  # embedding -> layer 3
W1 = 201  # W_1..W_4 lie one after the other
W2 = W1 + 32
W3 = W2 + 32
W4 = W3 + 32
BIAS = 329  # b_0..b_4
FC_BIAS = 334  # d_0..d_4
V = 339  # V_0..V_4, 32 rows each (fine: 64)
OUT_32 = V + 160  # output weights, then one row of output biases
OUT_64 = V + 320

# Rows of the transposed weights.
E0_T = 0
E3_T = 96
W1_T = 192
W2_T = W1_T + 32
W3_T = W2_T + 32
W4_T = W3_T + 32
V_T = 320  # V_k^T, only the part of the level's own feature

# Rows of the packed and of the transposed weights of the coarse decoder.
C_W0 = 0
C_W1 = 32
C_W2 = 64
C_C3 = 96
C_W3 = 128
C_W4 = 160
C_BIAS = 192
C_OUT = 197

COLOR_WEIGHT_ROWS = OUT_32 + 4
STORED_COLUMNS = 17
WEIGHT_SECTIONS = 16
"""Groups of 32 rows, each of one matrix, in which `color_weights` takes the weights; the last has the single rows."""

MASK_WORDS = 5

BLOCK_SIZE = {"cpu": 4, "cuda": 1}
"""Samples of a block."""

GROUP_SIZE = {"cpu": 8, "cuda": 1 << 30}
"""Samples of a ray between two looks at its transmittance. On CUDA a second look costs more than it spares: a launch
over a third of the samples takes as long as one over all.
"""

RUN = 8
"""Samples of a list whose gradients a thread of `scatter_features` adds up before it goes to memory."""

WEIGHT_SLOTS = 128
"""Buffers of the colour decoder's weight gradient on CUDA."""

WEIGHT_GROUP = 16
"""Samples that a CPU thread of `color_backward` sums weight gradients over before it adds them to memory."""

WEIGHT_GROUP_COLUMNS = 18
"""Vectors that each of them stores for that."""


@wp.struct
class Weights:
    """A decoder: packed rows, rows of the transposed matrices, and for each sample which ReLUs let through, a bit each.

    The bits are what forward leaves for the adjoint, (samples, `MASK_WORDS`).
    """

    W: wp.array[Vec32]
    T: wp.array[Vec32]
    bits: wp.array2d[wp.uint32]


@wp.struct
class RowGradient:
    """Gradient of a grid.

    wanted: Whether it is.
    place: Where in the buffers that of a row goes; -1: the row gets none.
    rows: The buffers (slices, places) it goes to.
    by_sample: Gradient of the feature of each sample (samples, 1), which `scatter_features` brings there (CUDA).
    entries, entries_by_sample: The same memory as of both, one number an element (CUDA).
    """

    wanted: int
    place: wp.array[int]
    rows: wp.array2d[Vec32]
    by_sample: wp.array2d[Vec32]
    entries: wp.array3d[float]
    entries_by_sample: wp.array2d[float]


@wp.struct
class WeightGradient:
    """Gradient of the colour decoder's weights, and what the samples store for it.

    wanted: Whether it is.
    rows: The buffers (slices, `COLOR_WEIGHT_ROWS`) it goes to.
    activations: h_0..h_4 of each sample, which forward stores.
    layer_grad: On the CPU a slice has the rows of one group, with a_0..a_4, g_0..g_4, the embedding (3 columns), the
        feature and h_0..h_3 of its samples: the gradient of the weights is twice as large as a CPU's first cache, so
        that a row of it is fetched once a group and not once a block. On CUDA thousands of threads would queue for the
        same rows: all samples store `STORED_COLUMNS`, a_0..a_4, g_0..g_4, the gradients of the angles (3), the feature
        and the embedding (3), and `color_weights` sums.
    """

    wanted: int
    rows: wp.array2d[Vec32]
    activations: wp.array2d[Vec32]
    layer_grad: wp.array2d[Vec32]
