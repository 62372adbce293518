"""Files that are replaced whole: what a failure leaves, and in which order things happen."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from warpslam.errors import CheckpointError
from warpslam.storage.atomic import replacing
from warpslam.storage.state_file import StateFormat, write_state


@pytest.mark.parametrize("error", [OSError("full"), KeyboardInterrupt()])
def test_a_failure_leaves_the_old_file_and_nothing_beside_it(tmp_path, error):
    """Whatever ends the block: the file is as it was, and the partial one is gone."""
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(type(error)), replacing(path) as partial:
        partial.write_text("half of the n")
        raise error
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]
    with replacing(path) as partial:
        partial.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new" and list(tmp_path.iterdir()) == [path]


def test_a_folder_that_is_missing_is_the_caller_s_error(tmp_path):
    """Nothing is made on the way."""
    with pytest.raises(FileNotFoundError), replacing(tmp_path / "none" / "a.txt") as partial:
        partial.write_text("new")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("durable", "order"), [(False, ["rename"]), (True, ["sync", "rename", "sync"])])
def test_durable_content_is_on_the_disk_before_it_has_its_name(tmp_path, monkeypatch, durable, order):
    """Content, name, folder; without need the disk is not waited for."""
    calls = []
    fsync, replace = os.fsync, Path.replace
    monkeypatch.setattr(os, "fsync", lambda descriptor: (calls.append("sync"), fsync(descriptor)))
    monkeypatch.setattr(Path, "replace", lambda path, to: (calls.append("rename"), replace(path, to)))
    with replacing(tmp_path / "a.txt", durable=durable) as partial:
        partial.write_text("new")
    assert calls == order


@pytest.mark.parametrize("name", ["", ".", "/", "a\0b", "\0/a", "\ud800"])
def test_what_can_be_no_file_is_an_error_of_the_system(tmp_path, monkeypatch, name):
    """Empty names, zeros, what is no letter: an `OSError`, which callers make a line of, not a `ValueError`."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(OSError, match="no name of a file"), replacing(Path(name)):
        pass
    with pytest.raises(CheckpointError, match="can't be written"):
        write_state(Path(name), StateFormat("test", 1), {}, {})
