"""`warpslam.field.feature_fit`: the feature of free space (A.2)."""

import numpy as np
import pytest

from warpslam.errors import CheckpointError
from warpslam.field.decoder_files import load_decoders
from warpslam.field.decoders import random_decoders
from warpslam.field.feature_fit import FREE_LOGIT, MAX_FREE_LOGIT, double_tensors, free_feature, logit_and_derivative


def test_free_space_is_free_everywhere():
    """The package's middle decoder reads the feature as free at points that were not fitted, and far from them; a
    feature of noise it does not.
    """
    weights = load_decoders().middle
    feature = free_feature(weights)
    assert feature.shape == (32,) and feature.dtype == np.float32
    points = np.random.default_rng(1).uniform(-30, 30, (4000, 3))
    logits = {
        name: logit_and_derivative(double_tensors(weights), points, np.broadcast_to(value, (len(points), 32)))[0]
        for name, value in (("free", feature.astype(np.float64)), ("noise", np.zeros(32)))
    }
    assert logits["free"].max() < MAX_FREE_LOGIT
    assert abs(logits["free"].mean() - FREE_LOGIT) < 0.2 and logits["free"].std() < 0.1
    assert logits["noise"].max() > MAX_FREE_LOGIT
    np.testing.assert_array_equal(free_feature(weights), feature)


def test_decoder_without_free_space_is_refused():
    """An untrained decoder has no such feature; the error names the setting."""
    with pytest.raises(CheckpointError, match="middle_start"):
        free_feature(random_decoders(0).middle)
