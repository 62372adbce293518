"""Readers of RGB-D sequences, one file a format. A reader is imported when a sequence of its format is opened."""

from __future__ import annotations

import importlib
import os
from pathlib import Path

from warpslam.errors import DatasetError
from warpslam.sequences.base import Frame, RgbdSequence

__all__ = ["DATASETS", "Frame", "RgbdSequence", "guess_dataset", "open_sequence"]

_READERS = {
    "replica": "ReplicaSequence",
    "tum_rgbd": "TumRgbdSequence",
    "scannet": "ScanNetSequence",
    "cofusion": "CoFusionSequence",
    "seven_scenes": "SevenScenesSequence",
    "icl_nuim": "IclNuimSequence",
    "sun3d": "Sun3dSequence",
    "stray": "StraySequence",
    "transforms": "TransformsSequence",
    "icl": "RedwoodSequence",
    "azure": "AzureSequence",
    "video": "VideoFolderSequence",
}
_MODULES = {"icl": "redwood", "video": "video_folder"}
_ALIASES = {
    "tum": "tum_rgbd",
    "tumrgbd": "tum_rgbd",
    "co_fusion": "cofusion",
    "7scenes": "seven_scenes",
    "7_scenes": "seven_scenes",
    "redwood": "icl",
    "apartment": "azure",
    "own": "azure",
    "folder": "azure",
}

DATASETS: tuple[str, ...] = tuple(_READERS)
"""Names that `open_sequence` takes as ``dataset``."""

# What tells a format from the others: every group needs one match. The order matters: a ScanNet or Replica folder may
# hold further files, while the last two formats are told by the names of two folders only.
_SIGNS: dict[str, tuple[tuple[str, ...], ...]] = {
    "icl_nuim": (("associat*.txt",), ("*.freiburg",)),
    "replica": (("results/frame*.jpg", "results/frame*.JPG", "results/frame*.png"), ("results/depth*.*",)),
    "tum_rgbd": (("rgb.txt", "associat*.txt"), ("depth.txt", "associat*.txt")),
    "scannet": (
        ("frames/color", "color"),
        ("frames/depth", "depth"),
        ("frames/color", "pose/*.txt", "intrinsic/intrinsic_depth.txt"),
    ),
    "cofusion": (("colour",), ("depth_noise",)),
    "seven_scenes": (("frame-*.color.png", "frame-*.color.jpg"), ("frame-*.depth.png",)),
    "sun3d": (("image",), ("depth",), ("intrinsics.txt",), ("extrinsics",)),
    "stray": (("camera_matrix.csv",), ("depth",), ("odometry.csv", "rgb.mp4")),
    "transforms": (("transforms.json",),),
    "icl": (("image",), ("depth",)),
    "azure": (("color",), ("depth",)),
    "video": (tuple(f"*{suffix}" for suffix in (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v")), ("depth",)),
}


def guess_dataset(path: str | os.PathLike[str]) -> str:
    """Name of the format of the sequence in the folder ``path``, told from its file names.

    Raises:
        DatasetError: If the folder is missing or no known layout fits; the message lists what was looked for.
    """
    path = _existing_folder(path)
    found = _match(path)
    if found is not None:
        return found
    looked_for = "\n".join(
        f"  {name}: " + " and ".join(" or ".join(group) for group in groups) for name, groups in _SIGNS.items()
    )
    hint = ""
    for child in sorted(child for child in path.iterdir() if child.is_dir()):
        inner = _match(child)
        if inner is not None:
            hint = f"\nThe folder {child} looks like {inner}: pass that one."
            break
    raise DatasetError(
        f"{path}: no known dataset layout. Name the format (one of {', '.join(DATASETS)}) or arrange the files as\n"
        f"{looked_for}{hint}"
    )


def open_sequence(path: str | os.PathLike[str], dataset: str = "auto", camera: str | None = None) -> RgbdSequence:
    """Open the RGB-D sequence in the folder ``path``; images are read when a frame is asked for.

    Args:
        path: Folder of one sequence.
        dataset: One of `DATASETS`, or "auto" to tell it from the file names.
        camera: Camera "fx,fy,cx,cy,width,height,depth_scale" of the stored images (pixels; depth_scale is stored depth
            units per metre). It replaces the file ``camera.yaml`` in the folder, which replaces the dataset's own.

    Raises:
        DatasetError: If the folder, a file in it or the camera can't be used.
        MissingDependencyError: If the format needs an optional package that is not installed.
    """
    path = _existing_folder(path)
    name = dataset.strip().lower().replace("-", "_")
    name = _ALIASES.get(name, name)
    if name == "auto":
        name = guess_dataset(path)
    if name not in _READERS:
        raise DatasetError(f"dataset = {dataset!r} is not a known format; use auto or one of {', '.join(DATASETS)}")
    module = importlib.import_module(f"warpslam.sequences.{_MODULES.get(name, name)}")
    return getattr(module, _READERS[name])(path, camera)


def _match(path: Path) -> str | None:
    for name, groups in _SIGNS.items():
        if all(any(next(path.glob(sign), None) is not None for sign in group) for group in groups):
            return name
    return None


def _existing_folder(path: str | os.PathLike[str]) -> Path:
    path = Path(path).expanduser()
    if not path.exists():
        raise DatasetError(f"{path}: no such folder; check the path of the sequence")
    if not path.is_dir():
        raise DatasetError(f"{path} is a file; pass the folder that holds the sequence")
    return path
