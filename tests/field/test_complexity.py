"""Operations and weights counted from layer sizes, against the published figures."""

from __future__ import annotations

import numpy as np
import pytest

from warpslam.baselines.imap_network import imap_shapes
from warpslam.field.complexity import embedding_flops, field_flops, flops_per_point, weight_count
from warpslam.field.decoders import LEVELS, random_decoders


@pytest.mark.parametrize(
    ("level", "flops", "weights"),
    [
        ("coarse", 12_513, 6_337),
        ("middle", 30_721, 15_800),
        ("fine", 40_961, 20_920),
        ("color", 30_916, 15_899),
        ("imap", 443_908, 222_747),
    ],
)
def test_counts_are_those_of_the_architecture(level, flops, weights):
    """Two operations a weight, one a bias, the embedding's product left out; iMAP's is Table 4's 443.91e3."""
    assert flops_per_point(level) == flops
    assert weight_count(level) == weights


def test_the_field_is_within_a_permille_of_the_published_count():
    """Middle, fine and colour, with their three embedding products, against Table 4's 104.16e3."""
    total = field_flops()["field"] + sum(embedding_flops(level) for level in LEVELS)
    assert total == 102_598 + 3 * 2 * 279
    assert total == pytest.approx(104.16e3, rel=2e-3)


def test_counts_follow_the_width():
    """A narrower decoder costs less, and the weights counted are those that a decoder of that width has."""
    for weights in random_decoders(0, hidden=20):
        assert weight_count(weights.level, 20) == sum(array.size for array in weights.tensors.values())
        assert flops_per_point(weights.level, 20) < flops_per_point(weights.level)
    assert field_flops({"fine": 20})["fine"] == flops_per_point("fine", 20)


def test_imap_layers_fit_together():
    """Each layer takes what the one before gives."""
    shapes = imap_shapes()
    sizes = [93, *(shapes[f"pts_linears.{k}.weight"][0] for k in range(4))]
    assert [shapes[f"pts_linears.{k}.weight"][1] for k in range(4)] == sizes[:-1]
    assert shapes["output_linear.weight"] == (4, sizes[-1]) and np.prod(shapes["embedder._B"]) == 279
