"""Dense RGB-D SLAM with a neural implicit map (NICE-SLAM), in NVIDIA Warp.

The names below are the public interface. Each is imported on first use, so that ``import warpslam`` loads neither torch
nor Warp.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from warpslam.camera import Intrinsics as Intrinsics
    from warpslam.camera import SensorTiming as SensorTiming
    from warpslam.config import PRESETS as PRESETS
    from warpslam.config import Config as Config
    from warpslam.errors import CheckpointError as CheckpointError
    from warpslam.errors import ConfigError as ConfigError
    from warpslam.errors import DatasetError as DatasetError
    from warpslam.errors import FrameError as FrameError
    from warpslam.errors import InputError as InputError
    from warpslam.errors import MapSizeError as MapSizeError
    from warpslam.errors import MemoryBudgetError as MemoryBudgetError
    from warpslam.errors import MeshError as MeshError
    from warpslam.errors import MissingDependencyError as MissingDependencyError
    from warpslam.errors import OutputError as OutputError
    from warpslam.errors import WarpSlamError as WarpSlamError
    from warpslam.evaluation import ate as ate
    from warpslam.evaluation import rpe as rpe
    from warpslam.field.decoder_files import load_decoders as load_decoders
    from warpslam.field.decoders import Decoders as Decoders
    from warpslam.field.rendering import RenderedImage as RenderedImage
    from warpslam.frames import FrameResult as FrameResult
    from warpslam.pipeline.observer import Observer as Observer
    from warpslam.pipeline.program import run as run
    from warpslam.profiling import profile as profile
    from warpslam.sequences import open_sequence as open_sequence
    from warpslam.sequences.base import Frame as Frame
    from warpslam.sequences.base import RgbdSequence as RgbdSequence
    from warpslam.sequences.checking import check_folder as check_folder
    from warpslam.slam import Slam as Slam
    from warpslam.trajectory import Trajectory as Trajectory

_MODULE_OF = {
    "CheckpointError": "warpslam.errors",
    "Config": "warpslam.config",
    "ConfigError": "warpslam.errors",
    "DatasetError": "warpslam.errors",
    "Decoders": "warpslam.field.decoders",
    "Frame": "warpslam.sequences.base",
    "FrameError": "warpslam.errors",
    "FrameResult": "warpslam.frames",
    "InputError": "warpslam.errors",
    "Intrinsics": "warpslam.camera",
    "MapSizeError": "warpslam.errors",
    "MemoryBudgetError": "warpslam.errors",
    "MeshError": "warpslam.errors",
    "MissingDependencyError": "warpslam.errors",
    "Observer": "warpslam.pipeline.observer",
    "OutputError": "warpslam.errors",
    "PRESETS": "warpslam.config",
    "RenderedImage": "warpslam.field.rendering",
    "RgbdSequence": "warpslam.sequences.base",
    "SensorTiming": "warpslam.camera",
    "Slam": "warpslam.slam",
    "Trajectory": "warpslam.trajectory",
    "WarpSlamError": "warpslam.errors",
    "ate": "warpslam.evaluation",
    "check_folder": "warpslam.sequences.checking",
    "load_decoders": "warpslam.field.decoder_files",
    "open_sequence": "warpslam.sequences",
    "profile": "warpslam.profiling",
    "rpe": "warpslam.evaluation",
    "run": "warpslam.pipeline.program",
}

__all__ = [*_MODULE_OF, "__version__"]


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'warpslam' has no attribute {name!r}")
    value = getattr(importlib.import_module(_MODULE_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
