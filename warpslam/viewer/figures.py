"""Figures of a run for TensorBoard or Weights & Biases: by frame, and those of the end."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from warpslam.errors import ConfigError, MissingDependencyError
from warpslam.pipeline.observer import Observer

if TYPE_CHECKING:
    from warpslam.runs.record import Progress, RunResult

TARGETS = ("tensorboard", "wandb")


class Sink(Protocol):
    """Where figures go."""

    def write(self, figures: Mapping[str, float], frame: int) -> None:
        """Figures of a frame, by name."""

    def close(self) -> None:
        """No more will come."""


class FigureLog(Observer):
    """Passes figures on: errors, inliers, losses and the rate by frame, and in the end those of the whole run.

    Args:
        target: "tensorboard:FOLDER" or "wandb:PROJECT".
        name: Of the run there; None for that of the sequence.

    Raises:
        ConfigError: The target is another one.
        MissingDependencyError: Its package is not installed.
    """

    def __init__(self, target: str, name: str | None = None) -> None:
        kind, _, place = target.partition(":")
        if kind not in TARGETS or not place:
            raise ConfigError(f"--log {target}: give tensorboard:FOLDER or wandb:PROJECT")
        sinks: dict[str, Any] = {"tensorboard": _TensorBoard, "wandb": _WeightsAndBiases}
        self._open = sinks[kind]
        self._place, self._name = place, name
        self._open.require()
        self._sink: Sink | None = None
        self._last = 0

    def begin(self, name: str) -> None:
        """Open it."""
        self._sink = self._open(self._place, self._name or name)

    def frame(self, progress: Progress) -> None:
        """Figures of a frame."""
        assert self._sink is not None
        result = progress.result
        self._last = progress.done
        figures = {"frames_per_second": progress.fps, "inliers": result.inliers, "depth_error_m": result.depth_error}
        figures |= {f"loss/{name}": value for name, value in result.losses.items()}
        figures |= {f"seconds/{name}": value for name, value in result.timings.items()}
        if progress.ate_rmse is not None:
            figures["ate_rmse_m"] = progress.ate_rmse
        self._sink.write(_known(figures), progress.done)

    def done(self, result: RunResult) -> None:
        """Figures of the end."""
        assert self._sink is not None
        metrics = result.metrics
        figures = {
            "ate_rmse_m": metrics.ate_m.aligned.rmse, "frames_per_second": metrics.fps,
            "accuracy_m": metrics.reconstruction.accuracy_m, "completion_m": metrics.reconstruction.completion_m,
            "psnr_db": metrics.rendering.psnr_db, "depth_l1_m": metrics.rendering.depth_l1_m,
            "map_bytes": metrics.map.bytes, "seconds": metrics.seconds.run,
        }  # fmt: skip
        self._sink.write(_known({f"end/{name}": value for name, value in figures.items()}), self._last)

    def close(self) -> None:
        """Write what is still in memory."""
        if self._sink is not None:
            self._sink.close()
            self._sink = None


def _known(figures: Mapping[str, float | None]) -> dict[str, float]:
    """Those that were measured."""
    return {name: float(value) for name, value in figures.items() if value is not None and np.isfinite(value)}


class _TensorBoard:
    def __init__(self, folder: str, name: str) -> None:
        self._writer = self.require()(f"{folder}/{name}")

    @staticmethod
    def require() -> Any:
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError as error:
            message = "--log tensorboard needs the package tensorboard; type: pip install tensorboard"
            raise MissingDependencyError(message) from error
        return SummaryWriter

    def write(self, figures: Mapping[str, float], frame: int) -> None:
        for name, value in figures.items():
            self._writer.add_scalar(name, value, frame)

    def close(self) -> None:
        self._writer.close()


class _WeightsAndBiases:
    def __init__(self, project: str, name: str) -> None:
        self._run = self.require().init(project=project, name=name)

    @staticmethod
    def require() -> Any:
        try:
            import wandb
        except ImportError as error:
            raise MissingDependencyError("--log wandb needs the package wandb; type: pip install wandb") from error
        return wandb

    def write(self, figures: Mapping[str, float], frame: int) -> None:
        self._run.log(dict(figures), step=frame)

    def close(self) -> None:
        self._run.finish()
