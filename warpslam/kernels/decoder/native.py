"""Arithmetic on rows of 32 in the compilers' own words, where those that Warp writes are slow.

CUDA wants rows read and written 16 bytes at a time: Warp aligns a `Vec32` to 4 bytes, so that its own code loads one
number at a time, and the kernels wait for the loads. Rows of arrays lie at multiples of 128 bytes.

CPUs want sums that stay in their registers: 32 of 64 bytes with AVX-512, 16 of 32 bytes with AVX2.
"""

from typing import Any

import warp as wp

from warpslam.kernels.grid import Vec32

# Four rows a trip, in a rolled loop.
_MATVEC = """
    struct alignas(16) quad { float a, b, c, d; };
    wp::mat_t<1, 32, wp::float32> s = r;
    const quad* w = (const quad*)(W.data + row);
    #pragma unroll 1
    for (int k = 0; k < 32; k += 4) {
        #pragma unroll
        for (int n = 0; n < 4; ++n) {
            const wp::float32 x_n = x.data[0][k + n];
            #pragma unroll
            for (int i = 0; i < 8; ++i) {
                const quad q = w[8 * n + i];
                s.data[0][4 * i] += x_n * q.a;
                s.data[0][4 * i + 1] += x_n * q.b;
                s.data[0][4 * i + 2] += x_n * q.c;
                s.data[0][4 * i + 3] += x_n * q.d;
            }
        }
        w += 32;
    }
    return s;
"""

# As wide as a register of the CPU.
VECTOR = """
#ifdef __AVX512F__
    constexpr int lanes = 16;
#else
    constexpr int lanes = 8;
#endif
    typedef float vector __attribute__((vector_size(4 * lanes), aligned(4)));
"""

# Tiles of the result whose sums stay in registers while k runs, eight vectors each: all columns at once where vectors
# have 64 bytes, half of them where they have 32. Each number is the same sum in the same order. Called and not inlined,
# so that the code of a decoder stays in the cache of instructions.
ADD_PRODUCT = """
    constexpr int samples_of_tile = 4, columns_of_tile = 2 * lanes;
    static_assert(size % samples_of_tile == 0, "blocks are whole tiles");
    // s += x W of 32 rows
    auto add_product = [](float* s, const float* x, const float* rows) __attribute__((noinline)) {
        for (int p = 0; p < size; p += samples_of_tile) {
            for (int i = 0; i < 32; i += columns_of_tile) {
                vector t[samples_of_tile][2];
                #pragma unroll
                for (int q = 0; q < samples_of_tile; ++q)
                    for (int j = 0; j < 2; ++j)
                        t[q][j] = *(const vector*)(s + 32 * (p + q) + i + j * lanes);
                #pragma unroll 1
                for (int k = 0; k < 32; ++k) {
                    const vector w_0 = *(const vector*)(rows + 32 * k + i);
                    const vector w_1 = *(const vector*)(rows + 32 * k + i + lanes);
                    #pragma unroll
                    for (int q = 0; q < samples_of_tile; ++q) {
                        const float x_k = x[32 * (p + q) + k];
                        t[q][0] += x_k * w_0;
                        t[q][1] += x_k * w_1;
                    }
                }
                #pragma unroll
                for (int q = 0; q < samples_of_tile; ++q)
                    for (int j = 0; j < 2; ++j)
                        *(vector*)(s + 32 * (p + q) + i + j * lanes) = t[q][j];
            }
        }
    };
"""

_MATVEC_CPU = f"""
    constexpr int size = sizeof(r.data) / sizeof(r.data[0]);
{ADD_PRODUCT}
    auto s = r;
    add_product(&s.data[0][0], &x.data[0][0], (const float*)(W.data + row));
    return s;
"""

# The same tiles, of four rows of the result.
_ADD_OUTER = """
    const int stride = 32 * columns.shape[1];
    const float* left = (const float*)columns.data + first * stride + 32 * x;
    const float* right = (const float*)columns.data + first * stride + 32 * d;
    float* sum = (float*)(rows.data + slot * rows.shape[1] + row);
    for (int k = 0; k < 32; k += 4) {
        for (int i = 0; i < 32; i += 2 * lanes) {
            vector t[4][2] = {};
            #pragma unroll 1
            for (int q = 0; q < count; ++q) {
                const vector d_0 = *(const vector*)(right + q * stride + i);
                const vector d_1 = *(const vector*)(right + q * stride + i + lanes);
                #pragma unroll
                for (int n = 0; n < 4; ++n) {
                    const float x_k = left[q * stride + k + n];
                    t[n][0] += x_k * d_0;
                    t[n][1] += x_k * d_1;
                }
            }
            #pragma unroll
            for (int n = 0; n < 4; ++n)
                for (int j = 0; j < 2; ++j) {
                    vector* place = (vector*)(sum + 32 * (k + n) + i + j * lanes);
                    *place = *place + t[n][j];
                }
        }
    }
"""

_ADD_SCALED = """
    struct alignas(16) quad { float a, b, c, d; };
    wp::vec_t<32, wp::float32> t = r;
    const quad* w = (const quad*)(rows.data + AT);
    #pragma unroll
    for (int i = 0; i < 8; ++i) {
        const quad q = w[i];
        t.c[4 * i] += s * q.a;
        t.c[4 * i + 1] += s * q.b;
        t.c[4 * i + 2] += s * q.c;
        t.c[4 * i + 3] += s * q.d;
    }
    return t;
"""

_DOT_ROW = """
    struct alignas(16) quad { float a, b, c, d; };
    const quad* w = (const quad*)(rows.data + row);
    quad t = {0.0f, 0.0f, 0.0f, 0.0f};
    #pragma unroll
    for (int i = 0; i < 8; ++i) {
        const quad q = w[i];
        t.a += r.c[4 * i] * q.a;
        t.b += r.c[4 * i + 1] * q.b;
        t.c += r.c[4 * i + 2] * q.c;
        t.d += r.c[4 * i + 3] * q.d;
    }
    return (t.a + t.b) + (t.c + t.d);
"""

_PUT_ROW = """
    struct alignas(16) quad { float a, b, c, d; };
    quad* w = (quad*)(rows.data + row * rows.shape[1] + column);
    #pragma unroll
    for (int i = 0; i < 8; ++i) {
        quad q;
        q.a = r.c[4 * i];
        q.b = r.c[4 * i + 1];
        q.c = r.c[4 * i + 2];
        q.d = r.c[4 * i + 3];
        w[i] = q;
    }
"""


def native_matvec(Block: type, *, on_cpu: bool) -> Any:
    """r + x W[row:], for blocks of four samples and multiples (CPU) and for one (CUDA)."""
    code = VECTOR + _MATVEC_CPU if on_cpu else _MATVEC

    # Warp takes the type of the result from a decorator that is spelt like this.
    @wp.func_native(code)
    def matvec(r: Block, x: Block, W: wp.array[Vec32], row: int) -> Block: ...

    return matvec


@wp.func_native(VECTOR + _ADD_OUTER)
def add_outer(
    rows: wp.array2d[Vec32], slot: int, row: int, columns: wp.array2d[Vec32], first: int, count: int, x: int, d: int
):
    """rows[slot, row + k] += sum over q < count of columns[first + q, x][k] columns[first + q, d] (CPU)."""
    ...


@wp.func_native(_ADD_SCALED.replace("AT", "row"))
def add_scaled(r: Vec32, s: float, rows: wp.array[Vec32], row: int) -> Vec32:
    """r + s * rows[row]."""
    ...


@wp.func_native(_ADD_SCALED.replace("AT", "row * rows.shape[1] + column"))
def add_scaled_column(r: Vec32, s: float, rows: wp.array2d[Vec32], row: int, column: int) -> Vec32:
    """r + s * rows[row, column]."""
    ...


@wp.func_native(_DOT_ROW)
def dot_row(r: Vec32, rows: wp.array[Vec32], row: int) -> float:
    """Product of a vector and a row."""
    ...


@wp.func_native(_PUT_ROW)
def put_row(rows: wp.array2d[Vec32], row: int, column: int, r: Vec32):
    """rows[row, column] = r."""
    ...


@wp.func_native("return ((const float*)(rows.data + row * rows.shape[1] + column))[k];")
def entry(rows: wp.array2d[Vec32], row: int, column: int, k: int) -> float:
    """rows[row, column][k], and nothing else of the row."""
    ...
