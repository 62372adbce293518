"""The folder that a run leaves behind, and where in it everything lies."""

from __future__ import annotations

import contextlib
import shutil
import tempfile
from dataclasses import asdict
from datetime import datetime
from pathlib import Path

from warpslam.config import Config
from warpslam.errors import ConfigError, DatasetError
from warpslam.reading import read_text
from warpslam.runs.request import Source
from warpslam.storage.atomic import sync_folder
from warpslam.storage.json_files import read_json, write_json

WRITTEN_FILES = (
    "checkpoint.next.safetensors",
    "checkpoint.other.safetensors",
    "checkpoint.previous.safetensors",
    "checkpoint.safetensors",
    "config.yaml",
    "error_over_time.png",
    "frames.csv",
    "frames.json",
    "ground_truth.tum",
    "input.json",
    "log.txt",
    "manifest.json",
    "map.safetensors",
    "mesh.ply",
    "mesh_forecast.ply",
    "metrics.json",
    "panels.npz",
    "panels.png",
    "report.html",
    "timing.json",
    "trajectory.tum",
    "trajectory_top_view.png",
)
"""All that a run writes into its folder."""

_MARKS_OF_A_RUN = ("metrics.json", "checkpoint.safetensors", "checkpoint.previous.safetensors")
# A folder without any of these holds nothing that took time to compute.
_RESULTS = (
    "checkpoint.other.safetensors",
    "checkpoint.previous.safetensors",
    "checkpoint.safetensors",
    "map.safetensors",
    "mesh.ply",
    "trajectory.tum",
)
_KEPT_TO_RESUME = ("checkpoint.previous.safetensors", "checkpoint.safetensors", "config.yaml", "input.json", "log.txt")
NEXT = "next_run"
"""Folder in that of a run in which its successor grows."""
_WHOLE = "whole"  # file in NEXT: the successor is whole, and takes the place of the run


class RunFolder:
    """Paths of one run."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.config = self.path / "config.yaml"
        """Settings in effect."""
        self.trajectory = self.path / "trajectory.tum"
        """Estimated poses in the TUM format."""
        self.ground_truth = self.path / "ground_truth.tum"
        """True poses of the same frames."""
        self.mesh = self.path / "mesh.ply"
        self.forecast_mesh = self.path / "mesh_forecast.ply"
        """Mesh with what the coarse level suggests where nothing was seen."""
        self.map = self.path / "map.safetensors"
        """Map, for renderings and meshes later."""
        self.checkpoint = self.path / "checkpoint.safetensors"
        """While a run is under way; see `warpslam.pipeline.checkpoints`."""
        self.previous_checkpoint = self.path / "checkpoint.previous.safetensors"
        self.frames = self.path / "frames.csv"
        """Status of each frame."""
        self.metrics = self.path / "metrics.json"
        """Figures; see `warpslam.runs.metrics`."""
        self.timing = self.path / "timing.json"
        """Seconds by stage, phase and frame."""
        self.frame_records = self.path / "frames.json"
        """Status of each frame with its losses, for the report; see `warpslam.runs.record.RunRecord.to_rows`."""
        self.source = self.path / "input.json"
        """How to open the input again."""
        self.log = self.path / "log.txt"
        self.top_view = self.path / "trajectory_top_view.png"
        self.error_plot = self.path / "error_over_time.png"
        self.panels = self.path / "panels.png"
        """Frames beside what the map renders from their poses."""
        self.panel_images = self.path / "panels.npz"
        """The images of that figure as arrays."""
        self.report = self.path / "report.html"
        self.manifest = self.path / "manifest.json"
        """Sizes and check sums of the others; see `warpslam.runs.manifest`."""

    @classmethod
    def create(
        cls,
        path: str | Path | None,
        name: str,
        root: str | Path = "runs",
        *,
        overwrite: bool = False,
        discard: bool = False,
    ) -> RunFolder:
        """Make the folder of a new run. Nothing that an earlier run computed is removed here, but what `discard` names.

        Args:
            path: Folder to write to. None makes ``root/name/<time>`` and points ``root/name/latest`` at it.
            name: Name of the sequence.
            root: Folder of all runs.
            overwrite: Where ``path`` holds a run, the new one grows in a folder within, and takes its place by
                `take_place` when it is whole.
            discard: A successor that grew there before, and was stopped, is given up.

        Raises:
            ConfigError: The folder can't be made, or holds a run that is not to be overwritten.
        """
        folder = cls(path if path is not None else _free_name(Path(root) / as_file_name(name)))
        try:
            folder.path.mkdir(parents=True, exist_ok=True)
            folder.finish_taking_place()
            if folder.has_results:
                if not overwrite:
                    raise ConfigError(folder._what_to_do())
                folder = folder.successor
                if folder.is_unfinished and not discard:
                    raise ConfigError(folder._what_to_do())
                folder.path.mkdir(exist_ok=True)
            if any((folder.path / name).exists() for name in _MARKS_OF_A_RUN):
                for file in WRITTEN_FILES:
                    (folder.path / file).unlink(missing_ok=True)
            # Now, not after an hour of work: a folder that is there need not be one that can be written to.
            with tempfile.TemporaryFile(dir=folder.path) as probe:
                probe.write(bytes(4096))
        except OSError as error:
            reason = error.strerror or error
            raise ConfigError(f"output folder {folder.path} can't be used ({reason}); choose another one") from error
        if path is None:
            _point_latest(folder.path)
        return folder

    @property
    def has_results(self) -> bool:
        """Whether a run has computed something that lies here."""
        return any((self.path / name).exists() for name in _RESULTS)

    @property
    def successor(self) -> RunFolder:
        """Where the run grows that is to take this one's place."""
        return RunFolder(self.path / NEXT)

    @property
    def is_unfinished(self) -> bool:
        """Whether there is a checkpoint to go on from."""
        return self.checkpoint.exists() or self.previous_checkpoint.exists()

    def _what_to_do(self) -> str:
        if self.is_unfinished:
            other = "replace it, when the new one is whole, by --overwrite"
            if self.path.name == NEXT:
                other = "remove that folder"
            return f"{self.path} holds an unfinished run: go on with it by --resume {self.path}, or {other}"
        return f"{self.path} holds the results of a run: choose another folder, or replace them by --overwrite"

    def take_place(self) -> RunFolder:
        """Where this is the successor of a run, and whole: have it take the run's place; returns where it is then.

        A stop at any moment loses nothing: what is left to do is done by `finish_taking_place`.
        """
        if self.path.name != NEXT or not self.path.parent.is_dir():
            return self
        (self.path / _WHOLE).touch()
        sync_folder(self.path)
        folder = RunFolder(self.path.parent)
        folder.finish_taking_place()
        return folder

    def finish_taking_place(self) -> None:
        """Move a whole successor here, if there is one."""
        new = self.path / NEXT
        if not (new / _WHOLE).is_file():
            return
        # What came with the one before goes only when all of the new one is here.
        moved = [name for name in WRITTEN_FILES if (new / name).is_file()]
        stale = new / "stale.json"
        if not stale.is_file():
            write_json(stale, {"files": [name for name in WRITTEN_FILES if name not in moved]})
        for name in moved:
            (new / name).replace(self.path / name)
        listed = read_json(stale).get("files")
        for name in listed if isinstance(listed, list) else ():
            if name in WRITTEN_FILES:
                (self.path / name).unlink(missing_ok=True)
        shutil.rmtree(new)

    @classmethod
    def open(cls, path: str | Path) -> RunFolder:
        """The folder of an earlier run.

        Raises:
            DatasetError: There is no run in ``path``.
        """
        folder = cls(path)
        try:
            folder.finish_taking_place()
        except OSError as error:
            raise DatasetError(f"{error.filename or path}: can't be moved ({error.strerror or error})") from error
        if not (folder.metrics.is_file() or folder.trajectory.is_file()):
            raise DatasetError(
                f"{path} is no run folder: it has neither metrics.json nor trajectory.tum; pass what 'warpslam run -o' "
                "wrote"
            )
        return folder

    def marks(self) -> dict[str, tuple[int, int]]:
        """By which `remove_stale` knows the files that were not written anew."""
        found = {}
        for name in WRITTEN_FILES:
            with contextlib.suppress(OSError):
                stat = (self.path / name).stat()
                found[name] = stat.st_ino, stat.st_mtime_ns
        return found

    def remove_stale(self, marks: dict[str, tuple[int, int]]) -> None:
        """Remove results of before that a run did not write again: they belong to an earlier stop of it."""
        now = self.marks()
        for name in set(now) - set(_KEPT_TO_RESUME):
            if now[name] == marks.get(name):
                (self.path / name).unlink(missing_ok=True)

    def set_checkpoints_aside(self) -> None:
        """No run goes on from what lies here, but it stays until another run is whole."""
        other = self.path / "checkpoint.other.safetensors"
        for path in (self.previous_checkpoint, self.checkpoint):
            if path.exists():
                path.replace(other)
        self.successor.remove_checkpoints()

    def remove_checkpoints(self) -> None:
        """Remove what a run could go on from; once it is over, its map holds all that they do."""
        names = ("checkpoint.next.safetensors", "checkpoint.other.safetensors")
        for path in (*(self.path / name for name in names), self.previous_checkpoint, self.checkpoint):
            path.unlink(missing_ok=True)

    def require(self, file: Path, remedy: str) -> Path:
        """Return ``file``, or raise `DatasetError` with ``remedy`` if the run did not write it."""
        if not file.is_file():
            raise DatasetError(f"{self.path} has no {file.name}; {remedy}")
        return file

    def write_source(self, source: Source) -> None:
        """Record how to open the input again."""
        write_json(self.source, asdict(source))

    def read_source(self) -> Source:
        """How to open the input again.

        Raises:
            DatasetError: The run did not record it, or the file is damaged.
        """
        self.require(self.source, "so its input frames are unknown")
        fields = read_json(self.source)
        try:
            return Source.from_dict(fields)
        except ValueError as error:
            raise DatasetError(f"{self.source}: expected path, dataset, camera and command ({error})") from error

    def read_config_text(self) -> str | None:
        """Settings of the run as they are written; None without.

        Raises:
            DatasetError: The file can't be read as text.
        """
        if not self.config.is_file():
            return None
        try:
            return read_text(self.config)
        except OSError as error:
            raise DatasetError(f"{self.config}: {error.strerror or error}; run again to write it anew") from error

    def read_config(self) -> Config:
        """Settings of the run.

        Raises:
            DatasetError: The run did not record them.
            ConfigError: The file is damaged.
        """
        return Config.load(self.require(self.config, "so its settings are unknown"))


def as_file_name(name: str) -> str:
    """``name`` with everything replaced that does not belong into the name of a folder."""
    return "".join(c if c.isalnum() or c in "-_." else "_" for c in name).strip(".") or "run"


def _free_name(parent: Path) -> Path:
    stamp = datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    folder, number = parent / stamp, 1
    while folder.exists():
        number += 1
        folder = parent / f"{stamp}_{number}"
    return folder


def _point_latest(folder: Path) -> None:
    """Make ``latest`` beside ``folder`` lead to it. Only a convenience: some file systems have no symbolic links."""
    link = folder.parent / "latest"
    with contextlib.suppress(OSError):
        link.unlink(missing_ok=True)
        link.symlink_to(folder.name, target_is_directory=True)
