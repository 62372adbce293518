"""The layers of the decoders with coordinates on the CPU, whole blocks in one function.

What `warpslam.kernels.decoder.layers` composes of functions on blocks, which Warp hands on by value, works here in a
few arrays that stay in the first cache. Each number is the same sum in the same order.
"""

from typing import Any

import warp as wp

from warpslam.kernels.decoder import layout
from warpslam.kernels.decoder.embedding import EMBED
from warpslam.kernels.decoder.layout import WeightGradient, Weights
from warpslam.kernels.decoder.native import ADD_PRODUCT, VECTOR

_SIZE = """
    constexpr int size = sizeof(samples.c) / sizeof(samples.c[0]);
"""

_ACTIVE = """
    // a bit for each number that is positive
    auto active = [](vector x) {
        const vector zero = {};
#if defined(__AVX512F__) || !defined(__AVX__)
        wp::uint32 word = 0;
        for (int i = 0; i < lanes; ++i)
            word |= (wp::uint32)(x[i] > 0.0f) << i;
        return word;
#else
        return (wp::uint32)__builtin_ia32_movmskps256((decltype(x))(x > zero));
#endif
    };
"""

_FORWARD = """
    const float* weights = (const float*)decoder.W.data;
    alignas(64) float a_0[32 * size], a_3[32 * size], a_k[32 * size], e[32 * size];
    auto begin = [](float* a, const float* bias) {
        for (int p = 0; p < size; ++p)
            for (int i = 0; i < 32; i += lanes)
                *(vector*)(a + 32 * p + i) = *(const vector*)(bias + i);
    };
    begin(a_0, weights + 32 * BIAS);
    begin(a_3, weights + 32 * (BIAS + 3));
    for (int chunk = 0; chunk < 3; ++chunk) {
        embed(e, &positions.data[0][0], weights + 32 * (B + 3 * chunk));
        add_product(a_0, e, weights + 32 * (E0 + 32 * chunk));
        add_product(a_3, e, weights + 32 * (E3 + 32 * chunk));
    }
    auto h = c;
    for (int k = 0; k < 5; ++k) {
        float* a = k == 0 ? a_0 : k == 3 ? a_3 : a_k;
        if (k > 0) {
            if (k != 3)
                begin(a, weights + 32 * (BIAS + k));
            add_product(a, &h.data[0][0], weights + 32 * (W1 + 32 * (k - 1)));
        }
        const float* shift = weights + 32 * (FC_BIAS + k);
        for (int p = 0; p < size; ++p) {
            wp::uint32 word = 0;
            for (int i = 0; i < 32; i += lanes) {
                const vector x = *(const vector*)(a + 32 * p + i);
                const vector zero = {};
                word |= active(x) << i;
                *(vector*)(&h.data[p][i]) = (x < zero ? zero : x) + *(const vector*)(shift + i);
            }
            decoder.bits.data[samples.c[p] * decoder.bits.shape[1] + k] = word;
        }
        const float* through = weights + 32 * (V + ROWS * k);
        add_product(&h.data[0][0], &c.data[0][0], through);
        if (ROWS > 32)
            add_product(&h.data[0][0], &m.data[0][0], through + 32 * 32);
        if (KEEPS && kept.wanted)
            for (int p = 0; p < size; ++p)
                for (int i = 0; i < 32; i += lanes)
                    *(vector*)((float*)(kept.activations.data + samples.c[p] * kept.activations.shape[1] + k) + i) =
                        *(const vector*)(&h.data[p][i]);
    }
    return h;
"""

# Of an adjoint: the layers from the last to the first.
_BACKWARD = """
    const float* weights = (const float*)decoder.T.data;
    // what the gradients of W_k and V_k need; those of b_k and d_k at once
    auto store = [&](int column, const float* a) {
        for (int p = 0; p < size; ++p)
            for (int i = 0; i < 32; i += lanes)
                *(vector*)((float*)(kept.layer_grad.data + rows.c[p] * kept.layer_grad.shape[1] + column) + i) =
                    *(const vector*)(a + 32 * p + i);
    };
    auto add_sum = [&](int row, const float* a) {
        float* sum = (float*)(kept.rows.data + slot * kept.rows.shape[1] + row);
        for (int i = 0; i < 32; i += lanes) {
            vector total = {};
            for (int p = 0; p < size; ++p)
                total += *(const vector*)(a + 32 * p + i);
            *(vector*)(sum + i) = *(vector*)(sum + i) + total;
        }
    };
    // a bit a lane
    typedef int numbers __attribute__((vector_size(4 * lanes)));
    numbers bit;
    for (int i = 0; i < lanes; ++i)
        bit[i] = 1 << i;
    wp::mat_t<3 * size, 32, wp::float32> result;
    alignas(64) float g[32 * size], a_k[32 * size];
    for (int p = 0; p < size; ++p)
        for (int i = 0; i < 32; ++i)
            g[32 * p + i] = g4.data[p][i];
    for (int k = 4; k >= 0; --k) {
        float* a = k == 0 ? &result.data[size][0] : k == 3 ? &result.data[2 * size][0] : a_k;
        for (int p = 0; p < size; ++p) {
            const wp::uint32 word = decoder.bits.data[samples.c[p] * decoder.bits.shape[1] + k];
            for (int i = 0; i < 32; i += lanes) {
                const vector x = *(const vector*)(g + 32 * p + i), zero = {};
                const numbers none = {};
                *(vector*)(a + 32 * p + i) = ((bit & (int)(word >> i)) != none) ? x : zero;
            }
        }
        add_product(&result.data[0][0], g, weights + 32 * (V_T + 32 * k));
        if (KEEPS && kept.wanted) {
            store(5 + k, g);
            store(k, a);
            add_sum(BIAS + k, a);
            add_sum(FC_BIAS + k, g);
        }
        if (k > 0) {
            for (int i = 0; i < 32 * size; ++i)
                g[i] = 0.0f;
            add_product(g, a, weights + 32 * (W1_T + 32 * (k - 1)));
        }
    }
    return result;
"""


def cpu_forward_layers(build: Any, *, two_features: bool, keeps_activations: bool) -> Any:
    """`forward_layers` for the CPU."""
    code = VECTOR + _SIZE + ADD_PRODUCT + EMBED + _ACTIVE + _FORWARD
    others = {"ROWS": 64 if two_features else 32, "KEEPS": int(keeps_activations)}
    constants = _constants("B", "BIAS", "E0", "E3", "FC_BIAS", "V", "W1", **others)
    Block, Indices, Positions = build.Block, build.Indices, build.Positions

    @wp.func_native(constants + code)
    def layers(
        positions: Positions, c: Block, m: Block, decoder: Weights, samples: Indices, kept: WeightGradient
    ) -> Block: ...

    return layers


def cpu_backward_layers(build: Any, name: str, *, keeps_gradients: bool) -> Any:
    """`backward_layers` for the CPU."""
    code = VECTOR + _SIZE + ADD_PRODUCT + _BACKWARD
    constants = _constants("BIAS", "FC_BIAS", "V_T", "W1_T", KEEPS=int(keeps_gradients))
    Block, Indices, size = build.Block, build.Indices, build.size
    Layers = wp.types.matrix(shape=(3 * size, 32), dtype=wp.float32)

    @wp.func_native(constants + code)
    def layers(
        g4: Block, decoder: Weights, samples: Indices, slot: int, rows: Indices, kept: WeightGradient
    ) -> Layers: ...

    def layers_backward(
        g4: Block, decoder: Weights, samples: Indices, slot: int, rows: Indices, kept: WeightGradient
    ) -> tuple[Block, Block, Block]:
        r = layers(g4, decoder, samples, slot, rows, kept)
        dc = Block()
        a0 = Block()
        a3 = Block()
        for p in range(size):
            dc[p] += r[p]
            a0[p] += r[size + p]
            a3[p] += r[2 * size + p]
        return dc, a0, a3

    return build.func(layers_backward, f"{name}_layers_backward")


def _constants(*rows: str, **others: int) -> str:
    """Where rows of weights lie, by the names of `warpslam.kernels.decoder.layout`, and other numbers."""
    values = {name: getattr(layout, name) for name in rows} | others
    return "".join(f"    constexpr int {name} = {value};\n" for name, value in values.items())
