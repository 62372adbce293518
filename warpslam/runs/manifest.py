"""Check sums of what lies in a run folder: whether it still is what the run wrote."""

from __future__ import annotations

import hashlib
from pathlib import Path

from warpslam.errors import DatasetError
from warpslam.runs.folder import WRITTEN_FILES, RunFolder
from warpslam.storage.json_files import read_json, write_json

_CHUNK = 1 << 20
# Of these the size of a moment is known only while the run goes on, and others write them, too.
_NOT_LISTED = ("log.txt", "manifest.json", "report.html", "mesh_forecast.ply")


def write_manifest(folder: RunFolder) -> None:
    """List all files of a run with their sizes and SHA-256."""
    files = {
        name: {"bytes": (folder.path / name).stat().st_size, "sha256": file_digest(folder.path / name)}
        for name in WRITTEN_FILES
        if name not in _NOT_LISTED and "checkpoint" not in name and (folder.path / name).is_file()
    }
    write_json(folder.manifest, {"files": files})


def check_manifest(folder: RunFolder) -> list[str]:
    """What is not as the run left it, one line each; empty if all is.

    Raises:
        DatasetError: The run has no list of its files, or it is damaged.
    """
    folder.require(
        folder.manifest, "so its files can't be checked: it did not come to its end, or is of an early version"
    )
    content = read_json(folder.manifest)
    problems = []
    try:
        for name, entry in content["files"].items():
            if name not in WRITTEN_FILES:
                raise ValueError(f"{name!r} is no file of a run")
            path = folder.path / name
            if not path.is_file():
                problems.append(f"{name} is missing")
            elif path.stat().st_size != int(entry["bytes"]):
                problems.append(f"{name} has {path.stat().st_size} bytes, was written with {int(entry['bytes'])}")
            elif file_digest(path) != str(entry["sha256"]):
                problems.append(f"{name} has changed")
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise DatasetError(f"{folder.manifest}: is damaged ({error!r})") from error
    except OSError as error:
        raise DatasetError(f"{error.filename}: can't be read ({error.strerror})") from error
    return problems


def note_changed(folder: RunFolder, path: Path) -> None:
    """A command has written a file of the run anew: the list follows, where there is one."""
    if path.parent.resolve() != folder.path.resolve() or not folder.manifest.is_file():
        return
    content = read_json(folder.manifest)
    files = content.get("files")
    if isinstance(files, dict) and path.name in files:
        files[path.name] = {"bytes": path.stat().st_size, "sha256": file_digest(path)}
        write_json(folder.manifest, content)


def file_digest(path: Path) -> str:
    """SHA-256 of a file."""
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while chunk := file.read(_CHUNK):
            digest.update(chunk)
    return digest.hexdigest()
