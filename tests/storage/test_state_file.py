"""State files: what comes back, what is refused, and what a crash leaves."""

from __future__ import annotations

import errno
import json
import os
import pickle
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import safetensors.numpy
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from warpslam.errors import CheckpointError
from warpslam.storage.state_file import StateFormat, read_state, write_state

FORM = StateFormat("warpslam-test", 3)
HEADER = {"numbers": [1, 2.5, None], "text": "å", "infinite": float("inf")}
ARRAYS = {
    "bytes": np.arange(7, dtype=np.uint8),
    "depth": np.arange(12, dtype=np.uint16).reshape(3, 4),
    "features": np.linspace(-1, 1, 96, dtype=np.float32).reshape(3, 32),
    "poses": np.linspace(0, 1, 14).reshape(2, 7),
    "shape": np.array([2, 3, 4]),
    "nothing": np.zeros((0, 7)),
    "number": np.array(2.5),
}


@pytest.fixture(scope="module")
def content(tmp_path_factory) -> bytes:
    """Bytes of a small file."""
    path = tmp_path_factory.mktemp("state") / "a.safetensors"
    assert write_state(path, FORM, HEADER, ARRAYS) == path.stat().st_size
    return path.read_bytes()


def assert_content(path: Path) -> None:
    header, arrays = read_state(path, FORM)
    assert header == HEADER and arrays.keys() == ARRAYS.keys()
    for name, array in ARRAYS.items():
        assert arrays[name].dtype == array.dtype and arrays[name].shape == array.shape, name
        np.testing.assert_array_equal(arrays[name], array)


def test_comes_back_as_it_was(content, tmp_path):
    """Values, types, shapes and the header; the same content gives the same bytes, wherever it is written."""
    path = tmp_path / "new folder" / "b.safetensors"
    turned = {**ARRAYS, "depth": np.asfortranarray(ARRAYS["depth"]), "poses": ARRAYS["poses"].astype(">f8")}
    write_state(path, FORM, HEADER, turned)
    assert_content(path)
    assert path.read_bytes() == content
    assert [file.name for file in path.parent.iterdir()] == ["b.safetensors"]


def test_others_may_read_what_they_may_read_elsewhere(tmp_path):
    """The permissions are those of any new file here."""
    write_state(tmp_path / "a.safetensors", FORM, HEADER, ARRAYS)
    (tmp_path / "b").write_bytes(b"")
    assert (tmp_path / "a.safetensors").stat().st_mode == (tmp_path / "b").stat().st_mode


def test_safetensors_reads_the_same(content):
    """The published package finds every array."""
    arrays = safetensors.numpy.load(content)
    assert arrays.keys() == ARRAYS.keys()
    for name, array in ARRAYS.items():
        assert arrays[name].dtype == array.dtype and arrays[name].shape == array.shape, name
        np.testing.assert_array_equal(arrays[name], array)


def test_layout_is_that_of_safetensors(content):
    """Read with nothing but the published layout: length, table, data."""
    (size,) = struct.unpack("<Q", content[:8])
    table = json.loads(content[8 : 8 + size])
    first, end = table["features"]["data_offsets"]
    data = content[8 + size :][first:end]
    assert table["features"]["dtype"] == "F32" and table["features"]["shape"] == [3, 32]
    np.testing.assert_array_equal(np.frombuffer(data, "<f4").reshape(3, 32), ARRAYS["features"])
    assert all(isinstance(value, str) for value in table["__metadata__"].values())


@given(data=st.data())
@settings(max_examples=400, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_damage_is_an_error_or_nothing_changes(content, tmp_path, data):
    """Flipped bits, cut or added bytes, overwritten stretches, noise: `CheckpointError` with the path, or the content
    as it was.
    """
    kind = data.draw(st.sampled_from(["flip", "cut", "append", "overwrite", "insert", "noise"]))
    place = data.draw(st.integers(0, len(content) - 1))
    noise = data.draw(st.binary(min_size=1, max_size=40))
    if kind == "flip":
        bit = data.draw(st.integers(0, 7))
        damaged = content[:place] + bytes([content[place] ^ (1 << bit)]) + content[place + 1 :]
    elif kind == "cut":
        damaged = content[:place]
    elif kind == "append":
        damaged = content + noise
    elif kind == "overwrite":
        damaged = content[:place] + noise + content[place + len(noise) :]
    elif kind == "insert":
        damaged = content[:place] + noise + content[place:]
    else:
        damaged = data.draw(st.binary(max_size=200))
    path = tmp_path / "damaged.safetensors"
    path.write_bytes(damaged)
    try:
        assert_content(path)
    except CheckpointError as error:
        assert str(path) in str(error)
    else:
        assert damaged == content, "altered, and nobody noticed"


def resealed(content: bytes, change) -> bytes:
    """The file with an altered table and a digest that agrees, as someone who means harm would write it."""
    import hashlib

    (size,) = struct.unpack("<Q", content[:8])
    table = json.loads(content[8 : 8 + size])
    table["__metadata__"] = json.loads(table["__metadata__"]["warpslam"])
    change(table)
    table["__metadata__"] = {"warpslam": json.dumps({**table["__metadata__"], "sha256": "0" * 64})}
    blank = json.dumps(table).encode()
    length = struct.pack("<Q", len(blank))
    digest = hashlib.sha256(length + blank + content[8 + size :]).hexdigest()
    return length + blank.replace(b"0" * 64, digest.encode()) + content[8 + size :]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda table: table["__metadata__"].update(version=4), "field version is 4.* update warpslam"),
        (lambda table: table["__metadata__"].update(version=2), "field version is 2.* warpslam that wrote it"),
        (lambda table: table["__metadata__"].update(version="x" * 9), "field version"),
        (lambda table: table["__metadata__"].update(format="other"), "field format is 'other'"),
        (lambda table: table["__metadata__"].update(header="[]"), "field header"),
        (lambda table: table["__metadata__"].update(header="[" * 10**5), "field header"),
        (lambda table: table["features"].update(shape=[10**9, 10**9]), "field features"),
        (lambda table: table["features"].update(shape=[-3, -32]), "field features"),
        (lambda table: table["features"].update(shape=[True, 96]), "field features"),
        (lambda table: table["features"].update(dtype="O"), "field features"),
        (lambda table: table["features"].update(data_offsets=[0, 10**12]), "field features"),
        (lambda table: table["features"].pop("shape"), "field features"),
        (lambda table: table.update(features=3), "field features"),
    ],
)
def test_forged_table_is_refused(content, tmp_path, change, message):
    """Another version or kind, sizes beyond the file, unknown types: each named, even where the digest agrees."""
    path = tmp_path / "forged.safetensors"
    path.write_bytes(resealed(content, change))
    with pytest.raises(CheckpointError, match=message):
        read_state(path, FORM)


class Trap:
    """Runs code when it is unpickled."""

    def __reduce__(self):
        return os.mkdir, ("trapped",)


def test_no_code_runs(tmp_path, monkeypatch):
    """Pickles, plain, compressed or as an .npy or .npz file with objects, are refused and never executed."""
    monkeypatch.chdir(tmp_path)
    trap = np.array([Trap()], object)
    np.save("trap.npy", trap, allow_pickle=True)
    np.savez("trap.npz", header=trap)
    Path("trap.pkl").write_bytes(pickle.dumps(Trap()))
    Path("trap.z").write_bytes(zlib.compress(pickle.dumps(Trap())))
    for name in ("trap.npy", "trap.npz", "trap.pkl", "trap.z"):
        with pytest.raises(CheckpointError, match=name):
            read_state(Path(name), FORM)
    assert not Path("trapped").exists()


def test_missing_file_and_folder_are_named(tmp_path):
    """No file, or a folder in its place."""
    for path in (tmp_path / "none.safetensors", tmp_path):
        with pytest.raises(CheckpointError, match=str(path)):
            read_state(path, FORM)


def test_full_disk_leaves_the_old_file(content, tmp_path, monkeypatch):
    """A write that fails says how much it needs, leaves what was there, and nothing beside it."""
    path = tmp_path / "a.safetensors"
    path.write_bytes(content)

    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(CheckpointError, match="No space left.*0.0 MB are needed"):
        write_state(path, FORM, {}, {"large": np.zeros(10)})
    assert path.read_bytes() == content
    assert list(tmp_path.iterdir()) == [path]


def test_file_is_on_the_disk_before_it_has_its_name(tmp_path, monkeypatch):
    """Content is synced before the rename, and the folder after it: a power cut leaves the old file or the new one."""
    calls = []
    fsync, replace = os.fsync, Path.replace
    monkeypatch.setattr(os, "fsync", lambda descriptor: (calls.append("sync"), fsync(descriptor)))
    monkeypatch.setattr(Path, "replace", lambda path, to: (calls.append("rename"), replace(path, to)))
    write_state(tmp_path / "a.safetensors", FORM, HEADER, ARRAYS)
    assert calls == ["sync", "rename", "sync"]
