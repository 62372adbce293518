"""Readers of RGB-D sequences, one file a format. A reader is imported when a sequence of its format is opened."""

from __future__ import annotations

import importlib
import logging
import os
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from warpslam.errors import DatasetError, brief
from warpslam.reading import check_regular
from warpslam.sequences.base import Frame, RgbdSequence

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

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
    "bag": "BagSequence",
    "sens": "SensSequence",
    "record3d": "Record3dSequence",
    "polycam": "PolycamSequence",
    "scanner_app": "ScannerAppSequence",
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
    "rosbag": "bag",
    "realsense": "bag",
    "stray_scanner": "stray",
    "nerfstudio": "transforms",
    "nerfcapture": "transforms",
    "bundlefusion": "seven_scenes",
    "3d_scanner_app": "scanner_app",
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
    "bag": (("metadata.yaml",), ("*.db3", "*.mcap", "*.db3.zstd", "*.mcap.zstd")),
    "record3d": (("rgbd/0.depth", "metadata"), ("rgbd", "metadata"), ("metadata", "metadata.json")),
    "polycam": (
        ("keyframes/depth", "depth"),
        ("keyframes/cameras", "keyframes/corrected_cameras", "corrected_cameras"),
    ),
    "scanner_app": (("frame_*.json",), ("depth_*.png",)),
    "video": (tuple(f"*{suffix}" for suffix in (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v")), ("depth",)),
}


_SUFFIXES = {
    ".bag": "bag", ".db3": "bag", ".mcap": "bag", ".sens": "sens", ".r3d": "record3d",
}  # fmt: skip
_NOT_READ = {
    ".mkv": "is a video, or a recording of Azure Kinect; type: python azure_kinect_mkv_reader.py --input {path} "
    "--output FOLDER (an example of Open3D), then pass that folder; a video goes into a folder beside depth/",
    ".mp4": "is a video; put it into a folder beside depth/, and pass the folder",
    ".zip": "is an archive; unpack it and pass the folder inside",
    ".tgz": "is an archive; unpack it and pass the folder inside",
    ".gz": "is an archive; unpack it and pass the folder inside",
    ".svo": "is a recording of ZED; export it as images and depth with its SDK, and pass the folder",
    ".klg": "is a log of ElasticFusion; convert it to images, and pass the folder",
    ".oni": "is a recording of OpenNI; convert it to images, and pass the folder",
}
GROUP = "warpslam.sequences"
"""Group of the entry points of readers that other packages bring."""


def guess_dataset(path: str | os.PathLike[str]) -> str:
    """Name of the format of the sequence in the folder or file ``path``, told from its file names.

    Raises:
        DatasetError: If it is missing or no known layout fits; the message lists what was looked for.
    """
    try:
        return _guess(_existing(path))
    except OSError as error:
        raise DatasetError(f"{error.filename or path}: can't be read ({error.strerror or error})") from error


def _guess(path: Path) -> str:
    found = _match(path)
    if found is not None:
        return found
    if path.is_file():
        known = ", ".join(_SUFFIXES)
        what = _NOT_READ.get(
            path.suffix.lower(), f"is a file; pass the folder that holds the sequence, or one of {known}"
        )
        raise DatasetError(f"{path} {what.format(path=path)}")
    looked_for = "\n".join(
        f"  {name}: " + " and ".join(" or ".join(group) for group in groups) for name, groups in _SIGNS.items()
    )
    hint = ""
    for child in sorted(path.iterdir()):
        inner = _match(child)
        if inner is not None:
            hint = f"\nThe {'folder' if child.is_dir() else 'file'} {child} looks like {inner}: pass that one."
            break
    raise DatasetError(
        f"{path}: no known dataset layout. Name the format (one of {', '.join(DATASETS)}) or arrange the files as\n"
        f"{looked_for}{hint}"
    )


def open_sequence(
    path: str | os.PathLike[str], dataset: str = "auto", camera: str | None = None, topics: str | None = None
) -> RgbdSequence:
    """Open the RGB-D sequence in the folder or file ``path``; images are read when a frame is asked for.

    Args:
        path: Folder or file of one sequence.
        dataset: One of `DATASETS`, or of a reader that another package brings, or "auto" to tell it from file names.
        camera: Camera "fx,fy,cx,cy,width,height,depth_scale" of the stored images (pixels; depth_scale is stored depth
            units per metre). It replaces the file ``camera.yaml`` in the folder, which replaces the dataset's own.
        topics: Of a bag, names of the topics of colour and depth and, where wanted, poses, parted by commas.

    Raises:
        DatasetError: If the folder, a file in it or the camera can't be used.
        MissingDependencyError: If the format needs an optional package that is not installed.
    """
    try:
        return _open(path, dataset, camera, topics)
    except OSError as error:
        raise DatasetError(f"{error.filename or path}: can't be read ({error.strerror or error})") from error
    except MemoryError:
        raise DatasetError(f"{path}: its lists do not fit into memory; are they of this sequence?") from None


def _open(path: str | os.PathLike[str], dataset: str, camera: str | None, topics: str | None) -> RgbdSequence:
    path = _existing(path)
    if not isinstance(dataset, str):
        raise DatasetError(f"dataset = {dataset!r} must be the name of a format, or auto")
    name = dataset.strip().lower().replace("-", "_")
    name = _ALIASES.get(name, name)
    if name == "auto":
        name = guess_dataset(path)
    if name not in _READERS:
        plugins = _plugins()
        if name in plugins:
            return _loaded(plugins[name], path)(path, camera)
        known = ", ".join((*DATASETS, *plugins))
        raise DatasetError(f"dataset = {dataset!r} is not a known format; use auto or one of {known}")
    if path.is_file() and name not in _SUFFIXES.values():
        raise DatasetError(f"{path} is a file; pass the folder that holds the sequence")
    module = importlib.import_module(f"warpslam.sequences.{_MODULES.get(name, name)}")
    reader = getattr(module, _READERS[name])
    if topics is not None:
        if name != "bag":
            raise DatasetError(f"{path}: is {name}, which has no topics; leave them out")
        return reader(path, camera, topics)
    return reader(path, camera)


def _match(path: Path) -> str | None:
    if path.is_file():
        found = _SUFFIXES.get(path.suffix.lower())
    else:
        found = next((name for name, groups in _SIGNS.items() if _has(path, groups)), None)
    return found or next((name for name, plugin in _plugins().items() if _recognises(plugin, path)), None)


def _has(path: Path, groups: tuple[tuple[str, ...], ...]) -> bool:
    return all(any(next(path.glob(sign), None) is not None for sign in group) for group in groups)


@cache
def _plugins() -> dict[str, EntryPoint]:
    """Readers that other packages bring, by name."""
    from importlib.metadata import entry_points

    return {entry.name.lower().replace("-", "_"): entry for entry in entry_points(group=GROUP)}


def _loaded(plugin: EntryPoint, path: Path) -> Callable[[Path, str | None], RgbdSequence]:
    try:
        return plugin.load()
    except Exception as error:
        raise DatasetError(
            f"{path}: the reader {plugin.name} ({plugin.value}) fails to load ({error}); install what it needs"
        ) from error


def _recognises(plugin: EntryPoint, path: Path) -> bool:
    """Whether a reader says that a folder or file is of its format; a package that is broken recognises nothing."""
    try:
        return bool(getattr(plugin.load(), "recognises", lambda path: False)(path))
    except Exception:  # noqa: BLE001
        logging.getLogger(__name__).warning("the reader %s (%s) fails to load", plugin.name, plugin.value)
        return False


def _existing(path: str | os.PathLike[str]) -> Path:
    try:
        path = Path(path).expanduser()
        exists = path.exists()
    except (OSError, ValueError, RuntimeError) as error:  # a name too long, a zero in it, a user without a home
        raise DatasetError(f"{brief(path)}: can't be a folder ({error})") from error
    if not exists:
        raise DatasetError(f"{path}: no such folder; check the path of the sequence")
    if not path.is_dir():
        check_regular(path)
    return path
