"""The folder that a run leaves behind, and where in it everything lies."""

from __future__ import annotations

import contextlib
import tempfile
from dataclasses import asdict
from datetime import datetime
from pathlib import Path

from warpslam.config import Config
from warpslam.errors import ConfigError, DatasetError
from warpslam.runs.request import Source
from warpslam.storage.json_files import read_json, write_json

# Removed before a run writes into a folder that an earlier run used: a stale mesh beside a new trajectory misleads.
_WRITTEN_FILES = (
    "checkpoint.next.safetensors",
    "checkpoint.previous.safetensors",
    "checkpoint.safetensors",
    "config.yaml",
    "error_over_time.png",
    "frames.csv",
    "frames.json",
    "ground_truth.tum",
    "input.json",
    "log.txt",
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
_MARKS_OF_A_RUN = ("metrics.json", "checkpoint.safetensors", "checkpoint.previous.safetensors")
_KEPT_TO_RESUME = ("checkpoint.previous.safetensors", "checkpoint.safetensors", "config.yaml", "input.json", "log.txt")


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

    @classmethod
    def create(cls, path: str | Path | None, name: str, root: str | Path = "runs") -> RunFolder:
        """Make the folder of a new run.

        Args:
            path: Folder to write to; what an earlier run wrote there is removed. None makes ``root/name/<time>`` and
                points ``root/name/latest`` at it.
            name: Name of the sequence.
            root: Folder of all runs.

        Raises:
            ConfigError: The folder can't be made.
        """
        folder = Path(path) if path is not None else _free_name(Path(root) / as_file_name(name))
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if any((folder / name).exists() for name in _MARKS_OF_A_RUN):
                for file in _WRITTEN_FILES:
                    (folder / file).unlink(missing_ok=True)
            # Now, not after an hour of work: a folder that is there need not be one that can be written to.
            with tempfile.TemporaryFile(dir=folder) as probe:
                probe.write(bytes(4096))
        except OSError as error:
            reason = error.strerror or error
            raise ConfigError(f"output folder {folder} can't be used ({reason}); choose another one") from error
        if path is None:
            _point_latest(folder)
        return cls(folder)

    @classmethod
    def open(cls, path: str | Path) -> RunFolder:
        """The folder of an earlier run.

        Raises:
            DatasetError: There is no run in ``path``.
        """
        folder = cls(path)
        if not folder.metrics.is_file():
            raise DatasetError(f"{path} is no run folder: it has no metrics.json; pass what 'warpslam run -o' wrote")
        return folder

    def clear_results(self) -> None:
        """Remove what a run that stopped early wrote at its end, before it goes on."""
        for name in set(_WRITTEN_FILES) - set(_KEPT_TO_RESUME):
            (self.path / name).unlink(missing_ok=True)

    def remove_checkpoints(self) -> None:
        """Remove what a run could go on from; once it is over, its map holds all that they do."""
        for path in (self.checkpoint, self.previous_checkpoint):
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
        except TypeError as error:
            raise DatasetError(f"{self.source}: expected path, dataset, camera and command ({error})") from error

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
