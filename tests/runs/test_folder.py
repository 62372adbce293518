"""Run folders: nothing that was computed goes before its successor is whole, and one writer at a time."""

import hashlib
import json
import multiprocessing
import os
import shutil
from pathlib import Path

import pytest

from warpslam.errors import ConfigError, DatasetError
from warpslam.runs.folder import NEXT, WRITTEN_FILES, RunFolder
from warpslam.runs.manifest import check_manifest, note_changed, write_manifest
from warpslam.storage.locked_folder import OWNER_FILE, locked

OLD = ("config.yaml", "trajectory.tum", "mesh.ply", "map.safetensors", "metrics.json", "report.html", "notes.txt")
NEW = ("config.yaml", "trajectory.tum", "map.safetensors", "metrics.json", "frames.csv")


class Stop(Exception):
    """The process ends here."""


def make_run(folder: Path, names=OLD, text="old") -> RunFolder:
    folder.mkdir(exist_ok=True)
    for name in names:
        (folder / name).write_text(text)
    return RunFolder(folder)


def content(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in folder.iterdir() if path.is_file()}


def counted(function, left: list[int]):
    """The function, which stops the process when ``left[0]`` calls are used up."""

    def call(*arguments, **keywords):
        left[0] -= 1
        if left[0] < 0:
            raise Stop
        return function(*arguments, **keywords)

    return call


@pytest.mark.parametrize("name", ["trajectory.tum", "mesh.ply", "map.safetensors", "checkpoint.safetensors"])
def test_a_folder_with_results_is_not_taken_without_a_word(name, tmp_path):
    """Each kind of result alone is reason enough; the message names what to type, and nothing has changed."""
    make_run(tmp_path / "run", [name, "log.txt"])
    before = content(tmp_path / "run")
    with pytest.raises(ConfigError, match=r"--overwrite") as caught:
        RunFolder.create(tmp_path / "run", "x")
    assert ("--resume" in str(caught.value)) == name.startswith("checkpoint")
    assert content(tmp_path / "run") == before


def test_a_new_run_grows_beside_the_old_one(tmp_path):
    """With overwrite the old results stay as they are until the new run takes its place, which leaves foreign files."""
    old = make_run(tmp_path / "run")
    new = RunFolder.create(old.path, "x", overwrite=True)
    assert new.path == old.path / NEXT and content(old.path)["mesh.ply"] == "old"
    make_run(new.path, NEW, "new")
    assert new.take_place().path == old.path
    assert content(old.path) == {**{name: "new" for name in NEW}, "notes.txt": "old"}
    assert not new.path.exists()


def test_a_stop_at_any_moment_of_the_exchange_loses_nothing(tmp_path, monkeypatch):
    """The exchange is stopped before each of its file operations in turn: at every moment each file is old or new and
    whole, and the next one who opens the folder ends the exchange.
    """
    operations = [(Path, "replace"), (Path, "unlink"), (Path, "touch"), (shutil, "rmtree")]
    for stop_at in range(100):
        old = make_run(tmp_path / f"run{stop_at}")
        new = make_run(old.path / NEXT, NEW, "new")
        with monkeypatch.context() as patch:
            left = [stop_at]
            for owner, name in operations:
                patch.setattr(owner, name, counted(getattr(owner, name), left))
            try:
                new.take_place()
            except Stop:
                stopped = True
            else:
                stopped = False
        whole = (new.path / "whole").exists() or not stopped
        for name in WRITTEN_FILES:
            for path in (old.path / name, new.path / name):
                assert not path.exists() or path.read_text() in ("old", "new")
        RunFolder.open(old.path)
        expected = {**{name: "new" for name in NEW}, "notes.txt": "old"}
        assert content(old.path) == (expected if whole else dict.fromkeys(OLD, "old"))
        if not stopped:
            assert stop_at > 8
            return
    pytest.fail("it never comes to its end")


def test_a_stopped_successor_is_not_given_up_silently(tmp_path):
    """The same command typed again after a crash: the checkpoint of the successor stays, and the message says where."""
    old = make_run(tmp_path / "run")
    make_run(old.path / NEXT, ["checkpoint.safetensors"])
    with pytest.raises(ConfigError, match="--resume .*next_run"):
        RunFolder.create(old.path, "x", overwrite=True)
    assert (old.path / NEXT / "checkpoint.safetensors").exists()
    assert RunFolder.create(old.path, "x", overwrite=True, discard=True).path == old.path / NEXT


def test_stale_results_of_an_earlier_stop_go_at_the_end(tmp_path):
    """Files that the run did not write again go, with what it goes on from staying; rewritten ones stay."""
    folder = make_run(tmp_path / "run", ["mesh.ply", "map.safetensors", "checkpoint.safetensors", "config.yaml"])
    marks = folder.marks()
    os.utime(folder.map, ns=(1, 1))
    folder.remove_stale(marks)
    assert set(content(folder.path)) == {"map.safetensors", "checkpoint.safetensors", "config.yaml"}


def _hold(folder: str, ready, go) -> None:
    with locked(Path(folder)):
        ready.set()
        go.wait(30)
        os._exit(1)  # as a process that is killed: nothing is given back


def test_two_runs_do_not_write_into_one_folder(tmp_path):
    """The second is refused, and told which process has it; when that dies, its lock is none any more."""
    context = multiprocessing.get_context("spawn")
    ready, go = context.Event(), context.Event()
    process = context.Process(target=_hold, args=(str(tmp_path), ready, go))
    process.start()
    assert ready.wait(60)
    with pytest.raises(ConfigError, match=f"process {process.pid} on "), locked(tmp_path):
        pass
    go.set()
    process.join(30)
    assert (tmp_path / OWNER_FILE).exists()
    with locked(tmp_path):
        assert json.loads((tmp_path / OWNER_FILE).read_text())["pid"] == os.getpid()
    assert not list(tmp_path.iterdir())


def test_manifest_tells_every_change(tmp_path):
    """Each file of a run that is altered by a byte, cut, or missing is named, and no other; a mesh made anew is not."""
    names = [name for name in OLD if name not in ("notes.txt", "report.html")]
    folder = make_run(tmp_path / "run", names, "some content")
    write_manifest(folder)
    assert set(json.loads(folder.manifest.read_text())["files"]) == set(names)
    assert check_manifest(folder) == []
    for name in names:
        path = folder.path / name
        for text in ("some c0ntent", "some", None):
            path.unlink() if text is None else path.write_text(text)
            (problem,) = check_manifest(folder)
            assert problem.startswith(name)
        path.write_text("some content")
    folder.mesh.write_text("another mesh")
    note_changed(folder, folder.mesh)
    assert check_manifest(folder) == []
    entry = json.loads(folder.manifest.read_text())["files"]["mesh.ply"]
    assert entry["sha256"] == hashlib.sha256(b"another mesh").hexdigest()
    for text in ("{", "[]", '{"files": 3}', '{"files": {"../x": {}}}', '{"files": {"mesh.ply": 3}}'):
        folder.manifest.write_text(text)
        with pytest.raises(DatasetError, match="manifest"):
            check_manifest(folder)
