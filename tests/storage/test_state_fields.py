"""Fields of a state: each is checked when it is taken, and an error names it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from tools.attacks.values import mutated_array
from warpslam.errors import CheckpointError
from warpslam.storage.json_files import Index
from warpslam.storage.state_file import StateFields


@dataclass(frozen=True)
class Part:
    number: Index
    share: float | None = None


def test_nested_values_are_of_their_kinds():
    """A mapping as a data class: what is missing, unknown, or of another kind is named."""
    fields = StateFields("file", {"part": {"number": 3}}, {})
    assert fields.checked("part", Part) == Part(3)
    for value in (
        {}, {"number": -1}, {"number": float("inf")}, {"number": 10**40}, {"number": [1]}, {"number": 1, "share": "x"},
        {"number": 1, "more": 2}, [], "part", 3, None,
    ):  # fmt: skip
        with pytest.raises(CheckpointError, match="file: field part "):
            StateFields("file", {"part": value}, {}).checked("part", Part)


def test_names_are_known_and_there_once():
    """What can't be hashed is no name either."""
    assert StateFields("file", {"levels": ["b", "a"]}, {}).names("levels", ("a", "b")) == ["b", "a"]
    for value in (["c"], ["a", "a"], [["a"]], [{}], [None], "a", 3, None, {"a": 1}):
        with pytest.raises(CheckpointError, match="field levels "):
            StateFields("file", {"levels": value}, {}).names("levels", ("a", "b"))


def test_whole_numbers_fit_where_they_are_used():
    """From 0 on, in 63 bits."""
    assert StateFields("file", {"seed": 7}, {}).integer("seed") == 7
    for value in (-1, True, 1.0, "1", None, [1], 1 << 63, 10**40):
        with pytest.raises(CheckpointError, match="field seed "):
            StateFields("file", {"seed": value}, {}).integer("seed")


def test_covariances_are_symmetric_and_can_be_inverted():
    """Of some directions little may be known, or of all. Any other array is refused."""
    rng = np.random.default_rng(0)
    J = rng.normal(size=(4, 6, 6))
    J[1, :, 3:] *= 1e3
    J[2, :, 0] = 0.0
    J[3] = 0.0
    good = J.swapaxes(1, 2) @ J + 1e-6 * np.eye(6)
    fields = StateFields("file", {}, {"c": good})
    np.testing.assert_array_equal(fields.covariances("c", 4), good)
    lopsided = good.copy()
    lopsided[0, 1, 0] += 1.0
    for wrong in (lopsided, 1e12 * good, 0.0 * good, np.ones((4, 6, 6)), good[:3], good.astype(np.float32)):
        with pytest.raises(CheckpointError, match="field c "):
            StateFields("file", {}, {"c": wrong}).covariances("c", 4)
    for seed in range(300):
        wrong = mutated_array(good, np.random.default_rng(seed))
        try:
            found = StateFields("file", {}, {"c": wrong}).covariances("c", 4)
        except CheckpointError:
            continue
        assert np.isfinite(np.linalg.solve(found, np.ones((4, 6, 1)))).all(), f"seed {seed}"
