"""The five layers of the decoders with coordinates, written once: forward for middle, fine and colour, and the adjoint.
Here for CUDA; for the CPU in `warpslam.kernels.decoder.cpu_layers`.

    a_0 = W_0 e + b_0,  a_3 = W_3 [e, h_2] + b_3,  a_k = W_k h_{k-1} + b_k
    h_k = relu(a_k) + V_k c + d_k

Adjoint, for g_4 = d_h_4:  a_k = g_k where a_k > 0,  g_{k-1} = W_k^T a_k,  dc = sum over k of V_k^T g_k
"""

import warp as wp

from warpslam.kernels.decoder.blocks import Build
from warpslam.kernels.decoder.cpu_layers import cpu_backward_layers, cpu_forward_layers
from warpslam.kernels.decoder.layout import (
    BIAS,
    E0,
    E3,
    FC_BIAS,
    V_T,
    W1,
    W1_T,
    W2,
    W2_T,
    W3,
    W3_T,
    W4,
    W4_T,
    V,
    WeightGradient,
    Weights,
)


def forward_layers(
    build: Build, name: str, *, two_features: bool = False, keeps_activations: bool = False
) -> wp.Function:
    """h_4 of a block; the bits of its ReLUs are stored.

    two_features: c is the level's own feature and that of the middle level (fine).
    keeps_activations: h_0..h_4 are stored where they are wanted (colour).
    """
    if build.on_cpu:
        return cpu_forward_layers(build, two_features=two_features, keeps_activations=keeps_activations)
    Block, Indices, Positions = build.Block, build.Indices, build.Positions
    matvec, fill, relu, embed = build.matvec, build.fill, build.relu, build.embed
    store_bits, store_rows = build.store_bits, build.store_rows
    rows = 64 if two_features else 32

    def hidden(k: int, a: Block, c: Block, m: Block, decoder: Weights, samples: Indices, kept: WeightGradient) -> Block:
        store_bits(decoder.bits, samples, k, a)
        h = matvec(relu(a) + fill(decoder.W[FC_BIAS + k]), c, decoder.W, V + rows * k)
        if wp.static(two_features):
            h = matvec(h, m, decoder.W, V + rows * k + 32)
        if wp.static(keeps_activations):
            store_rows(kept.activations, samples, k, h, kept.wanted)
        return h

    hidden_k = build.func(hidden, f"{name}_hidden")

    def layers(
        positions: Positions, c: Block, m: Block, decoder: Weights, samples: Indices, kept: WeightGradient
    ) -> Block:
        a0 = fill(decoder.W[BIAS])
        a3 = fill(decoder.W[BIAS + 3])
        for chunk in range(3):
            e = embed(positions, decoder.W, chunk)
            a0 = matvec(a0, e, decoder.W, E0 + 32 * chunk)
            a3 = matvec(a3, e, decoder.W, E3 + 32 * chunk)
        h = hidden_k(0, a0, c, m, decoder, samples, kept)
        h = hidden_k(1, matvec(fill(decoder.W[BIAS + 1]), h, decoder.W, W1), c, m, decoder, samples, kept)
        h = hidden_k(2, matvec(fill(decoder.W[BIAS + 2]), h, decoder.W, W2), c, m, decoder, samples, kept)
        h = hidden_k(3, matvec(a3, h, decoder.W, W3), c, m, decoder, samples, kept)
        return hidden_k(4, matvec(fill(decoder.W[BIAS + 4]), h, decoder.W, W4), c, m, decoder, samples, kept)

    return build.func(layers, f"{name}_layers")


def backward_layers(build: Build, name: str, *, keeps_gradients: bool = False) -> wp.Function:
    """(dc, a_0, a_3) of a block from g_4; keeps_gradients: a_k and g_k are stored, too (colour)."""
    if build.on_cpu:
        return cpu_backward_layers(build, name, keeps_gradients=keeps_gradients)
    Block, Indices = build.Block, build.Indices
    matvec, keep_active, store_rows = build.matvec, build.keep_active, build.store_rows

    def note(k: int, g: Block, a: Block, rows: Indices, kept: WeightGradient):
        """What the gradients of W_k and V_k need."""
        store_rows(kept.layer_grad, rows, 5 + k, g, kept.wanted)
        store_rows(kept.layer_grad, rows, k, a, kept.wanted)

    note_k = build.func(note, f"{name}_note")

    def layers_backward(
        g4: Block, decoder: Weights, samples: Indices, slot: int, rows: Indices, kept: WeightGradient
    ) -> tuple[Block, Block, Block]:
        a4 = keep_active(g4, decoder.bits, samples, 4)
        dc = matvec(Block(), g4, decoder.T, V_T + 128)
        if wp.static(keeps_gradients):
            note_k(4, g4, a4, rows, kept)
        g3 = matvec(Block(), a4, decoder.T, W4_T)
        a3 = keep_active(g3, decoder.bits, samples, 3)
        dc = matvec(dc, g3, decoder.T, V_T + 96)
        if wp.static(keeps_gradients):
            note_k(3, g3, a3, rows, kept)
        g2 = matvec(Block(), a3, decoder.T, W3_T)
        a2 = keep_active(g2, decoder.bits, samples, 2)
        dc = matvec(dc, g2, decoder.T, V_T + 64)
        if wp.static(keeps_gradients):
            note_k(2, g2, a2, rows, kept)
        g1 = matvec(Block(), a2, decoder.T, W2_T)
        a1 = keep_active(g1, decoder.bits, samples, 1)
        dc = matvec(dc, g1, decoder.T, V_T + 32)
        if wp.static(keeps_gradients):
            note_k(1, g1, a1, rows, kept)
        g0 = matvec(Block(), a1, decoder.T, W1_T)
        a0 = keep_active(g0, decoder.bits, samples, 0)
        dc = matvec(dc, g0, decoder.T, V_T)
        if wp.static(keeps_gradients):
            note_k(0, g0, a0, rows, kept)
        return dc, a0, a3

    return build.func(layers_backward, f"{name}_layers_backward")
