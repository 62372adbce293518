"""What a query costs: floating-point operations and weights of each decoder, counted from its layer sizes.

The convention is that of the paper's Table 4: two operations a weight (multiply, add) and one a bias. The product p B
in front of the Fourier embedding is left out, as are sine, ReLU, interpolation and compositing.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from warpslam.field.decoders import EMBEDDING_SIZE, LEVELS, MAX_HIDDEN, expected_shapes

IMAP_HIDDEN = 256
IMAP_LAYERS = 4
IMAP_OUTPUTS = 4  # red, green, blue, density


def imap_shapes() -> dict[str, tuple[int, ...]]:
    """Name and shape, (out, in), of every tensor of the network of iMAP*."""
    shapes: dict[str, tuple[int, ...]] = {"embedder._B": (3, EMBEDDING_SIZE)}
    for k in range(IMAP_LAYERS):
        shapes[f"pts_linears.{k}.weight"] = (IMAP_HIDDEN, EMBEDDING_SIZE if k == 0 else IMAP_HIDDEN)
        shapes[f"pts_linears.{k}.bias"] = (IMAP_HIDDEN,)
    shapes["output_linear.weight"] = (IMAP_OUTPUTS, IMAP_HIDDEN)
    shapes["output_linear.bias"] = (IMAP_OUTPUTS,)
    return shapes


def decoder_shapes(level: str, hidden: int = MAX_HIDDEN) -> dict[str, tuple[int, ...]]:
    """Tensors of a decoder of `warpslam.field.decoders.LEVELS`, or of the network of "imap" (which has one width)."""
    return imap_shapes() if level == "imap" else expected_shapes(level, hidden)


def flops_per_point(level: str, hidden: int = MAX_HIDDEN) -> int:
    """Operations of one forward pass at one point (see the convention above); with gradients it is about three times
    as many.
    """
    return _flops(decoder_shapes(level, hidden))


def embedding_flops(level: str) -> int:
    """Operations of the product p B, which `flops_per_point` leaves out; 0 for the coarse level."""
    return 2 * math.prod(decoder_shapes(level).get("embedder._B", (0,)))


def weight_count(level: str, hidden: int = MAX_HIDDEN) -> int:
    """Numbers in all tensors, the embedding's B included."""
    return sum(math.prod(shape) for shape in decoder_shapes(level, hidden).values())


def field_flops(widths: Mapping[str, int] | None = None) -> dict[str, int]:
    """Operations a point by level, and their sum over what the colour stage evaluates ("field": all but coarse).

    widths: Hidden width by level; 32 by default.
    """
    counts = {level: flops_per_point(level, (widths or {}).get(level, MAX_HIDDEN)) for level in LEVELS}
    return {**counts, "field": sum(counts[level] for level in LEVELS if level != "coarse")}


def _flops(shapes: Mapping[str, tuple[int, ...]]) -> int:
    return sum(
        math.prod(shape) * (2 if name.endswith("weight") else 1)
        for name, shape in shapes.items()
        if not name.startswith("embedder")
    )
