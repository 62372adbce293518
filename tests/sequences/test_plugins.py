"""Readers that other packages bring as entry points."""

from __future__ import annotations

from importlib.metadata import EntryPoint

import numpy as np
import pytest

from warpslam import sequences
from warpslam.errors import DatasetError
from warpslam.examples.own_reader import NpzSequence
from warpslam.sequences import GROUP, guess_dataset, open_sequence
from warpslam.sequences.checking import check_folder


@pytest.fixture
def plugins(monkeypatch):
    """Two packages: one brings the example, the other is broken."""
    entries = [
        EntryPoint("npz", "warpslam.examples.own_reader:NpzSequence", GROUP),
        EntryPoint("broken", "no_such_package:Reader", GROUP),
    ]
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: entries if group == GROUP else [])
    sequences._plugins.cache_clear()
    yield
    sequences._plugins.cache_clear()


def write(path):
    rng = np.random.default_rng(0)
    arrays = {"rgb": rng.integers(0, 255, (4, 60, 80, 3), np.uint8), "depth": np.full((4, 60, 80), 2.0)}
    np.savez(path, **arrays, camera=[60, 60, 39.5, 29.5])
    return path


@pytest.mark.usefixtures("plugins")
def test_a_reader_of_another_package(tmp_path):
    """It is told by its own sign or by name, opened, and checked; a broken one stands in nobody's way."""
    path = write(tmp_path / "kitchen.rgbd.npz")
    assert guess_dataset(path) == "npz"
    for dataset in ("auto", "NPZ"):
        sequence = open_sequence(path, dataset)
        assert isinstance(sequence, NpzSequence) and (sequence.name, len(sequence)) == ("kitchen", 4)
    assert not check_folder(path).errors
    with pytest.raises(DatasetError, match="is not a known format; use auto or one of replica.*npz, broken"):
        open_sequence(path, "kitti")


@pytest.mark.usefixtures("plugins")
def test_a_broken_reader_is_named(tmp_path, caplog):
    """In a warning, where a folder is of no known layout."""
    with pytest.raises(DatasetError, match="no known dataset layout"):
        open_sequence(tmp_path)
    assert "the reader broken (no_such_package:Reader) fails to load" in caplog.text
    with pytest.raises(DatasetError, match="the reader broken .*no_such_package.*; install"):
        open_sequence(tmp_path, "broken")


def test_without_plugins_no_reader_is_imported(tmp_path):
    """The example is no part of the formats by itself."""
    with pytest.raises(DatasetError, match=r"is a file; pass the folder"):
        open_sequence(write(tmp_path / "kitchen.rgbd.npz"))
