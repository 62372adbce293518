"""Bags of ROS 1, ROS 2 (sqlite and MCAP) and of RealSense, read with the package rosbags."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from warpslam.camera import Intrinsics
from warpslam.errors import ConfigError, DatasetError, MissingDependencyError
from warpslam.reading import check_regular
from warpslam.sequences.bag_messages import camera_of, color_image, depth_image, stamp_of, transform_of
from warpslam.sequences.bag_poses import Transforms, at_times
from warpslam.sequences.base import Remark
from warpslam.sequences.calibration import Calibration, find_calibration
from warpslam.sequences.files import typed_name
from warpslam.sequences.images import ImageSequence
from warpslam.sequences.pairing import COMPLETE
from warpslam.sequences.registration import ColorCamera
from warpslam.storage.tum import nearest

SUFFIXES = (".bag", ".db3", ".mcap")
_BAG_FILES = (*SUFFIXES, ".yaml", ".zstd")
_MAX_TIME_DIFFERENCE = 0.08  # [s] between colour and depth of a frame
_IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_POSES = ("nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/TransformStamped")
_CAMERA = "sensor_msgs/msg/CameraInfo"
_TF = "tf2_msgs/msg/TFMessage"
_TF_TYPES = (_TF, "tf/msg/tfMessage")
# Parts of a name that speak for a topic, the more so the earlier, and such that rule it out.
_DEPTH_WORDS = ("aligned_depth", "depth_registered", "depth_to_color", "registered", "depth")
_COLOR_WORDS = ("color", "colour", "rgb", "image_raw", "image")
_NO_COLOR = ("depth", "infra", "/ir", "thermal", "mask", "disparity", "confidence")


@dataclass(frozen=True)
class _Topic:
    """Messages of one topic."""

    name: str
    received: np.ndarray
    """When each message was recorded [ns], int64 (N,)."""
    stamps: np.ndarray
    """Times in their headers [s], float64 (N,)."""


class BagSequence(ImageSequence):
    """A bag; colour and depth are paired by time.

    Args:
        path: File, or folder of a ROS 2 bag.
        camera: Camera, as `warpslam.sequences.open_sequence` takes it.
        topics: Names of the colour and the depth topic and, where wanted, of that of the poses, parted by commas.
    """

    can_read_ahead = False  # a connection to sqlite works in the thread that opened it

    def __init__(self, path: Path, camera: str | None = None, topics: str | None = None) -> None:
        self.path = path
        self._reader = _open(path)
        self._is_ros2 = self._reader.is2
        names = self._choose(topics)
        color, depth = (self._index(name) for name in names[:2])
        index, gap = nearest(color.stamps, depth.stamps)
        keep = np.flatnonzero(gap < _MAX_TIME_DIFFERENCE)
        if not len(keep):
            raise DatasetError(
                f"{path}: no image of {color.name} has one of {depth.name} within {_MAX_TIME_DIFFERENCE} s; choose "
                f"others with --topics COLOR,DEPTH from {', '.join(self._image_topics())}"
            )
        self._color, self._depth = color, depth
        self._color_at, self._depth_at = keep, index[keep]
        times = color.stamps[keep]
        remarks = [Remark("topics", f"colour is {color.name}, depth is {depth.name}", is_fine=True)]
        if len(keep) < len(color.stamps):
            text = f"{len(color.stamps) - len(keep)} of {len(color.stamps)} colour images have no depth within "
            remarks.append(Remark("association", f"{text}{_MAX_TIME_DIFFERENCE} s", COMPLETE))
        frames = self._frame_of(color), self._frame_of(depth)
        transforms = self._transforms()
        calibration = find_calibration(path, camera, None) if camera else self._calibrate(frames, transforms)
        poses, found = self._read_poses(names[2] if len(names) > 2 else None, frames[0], transforms, times)
        super().__init__(
            typed_name(path),
            calibration,
            len(keep),
            poses=poses,
            timestamps=times,
            depth_timestamps=depth.stamps[index[keep]],
            remarks=(*remarks, *found),
        )

    def labels(self, index: int) -> tuple[str, str]:
        """Bag, topic and time of both images."""
        rows = ((self._color, self._color_at), (self._depth, self._depth_at))
        color, depth = (f"{self.path}: {topic.name} at {topic.stamps[at[index]]:.6f} s" for topic, at in rows)
        return color, depth

    def _stored_rgb(self, index: int) -> np.ndarray:
        where = self.labels(index)[0]
        return color_image(self._message(self._color, self._color_at[index]), where, self._check_color_size)

    def _stored_depth(self, index: int) -> np.ndarray:
        where = self.labels(index)[1]
        stored = depth_image(self._message(self._depth, self._depth_at[index]), where, self._check_depth_size)
        if stored.dtype == np.float32:  # of the standard in metres, whatever the unit of integers is
            with np.errstate(invalid="ignore"):
                return np.where((stored > 0) & np.isfinite(stored), stored, np.float32(0))
        return self.metres(stored)

    def _choose(self, topics: str | None) -> list[str]:
        """Names of colour and depth, and of the poses where they are named."""
        there = self._image_topics()
        if topics is not None:
            names = [name.strip() for name in topics.split(",")]
            known = {connection.topic for connection in self._reader.connections}
            unknown = [name for name in names if name not in known]
            if len(names) not in (2, 3) or unknown:
                raise DatasetError(
                    f"{self.path}: --topics {topics}: give COLOR,DEPTH or COLOR,DEPTH,POSES; the bag has "
                    f"{', '.join(sorted(known))}"
                )
            return names
        depth = _best(there, _DEPTH_WORDS, ("confidence", "/color_", "disparity"))
        color = _best([name for name in there if name != depth], _COLOR_WORDS, _NO_COLOR)
        if depth is None or color is None:
            missing = "depth" if depth is None else "colour"
            raise DatasetError(
                f"{self.path}: no topic of images is called {missing}; the bag has {', '.join(there) or 'no images'}: "
                "choose with --topics COLOR,DEPTH"
            )
        return [color, depth]

    def _image_topics(self) -> list[str]:
        return sorted({c.topic for c in self._reader.connections if c.msgtype in _IMAGES})

    def _connections(self, name: str | Sequence[str]) -> list[Any]:
        names = (name,) if isinstance(name, str) else name
        return [connection for connection in self._reader.connections if connection.topic in names]

    def _index(self, name: str) -> _Topic:
        rows = [
            (received, stamp_of(data, self._is_ros2))
            for _, received, data in self._reader.messages(self._connections(name))
        ]
        if not rows:
            raise DatasetError(f"{self.path}: {name} has no message; the recording is incomplete")
        rows.sort(key=lambda row: row[1])
        stamps = np.array([stamp for _, stamp in rows])
        received = np.array([at for at, _ in rows], dtype=np.int64)
        if np.ptp(stamps) == 0 and len(rows) > 1:  # headers that nobody filled in
            stamps = received * 1e-9
        return _Topic(name, received, stamps)

    def _message(self, topic: _Topic, position: int) -> Any:
        received = int(topic.received[position])
        for connection, _, data in self._reader.messages(self._connections(topic.name), received, received + 1):
            return self._reader.deserialize(data, connection.msgtype)
        raise DatasetError(f"{self.path}: {topic.name} has no message at {topic.stamps[position]:.6f} s; it is damaged")

    def _frame_of(self, topic: _Topic) -> str:
        return str(self._message(topic, 0).header.frame_id).strip("/")

    def _first(self, name: str) -> Any:
        for connection, _, data in self._reader.messages(self._connections(name)):
            return self._reader.deserialize(data, connection.msgtype)
        return None

    def _camera_info(self, topic: str) -> tuple[Intrinsics, tuple[float, ...]] | None:
        """Camera of an image topic: the camera_info beside it."""
        infos = [c.topic for c in self._reader.connections if c.msgtype == _CAMERA]
        base = topic.split("/image")[0]
        near = [name for name in infos if name.rsplit("/", 1)[0] == topic.rsplit("/", 1)[0]]
        near += [name for name in infos if name.startswith(base + "/") and name not in near]
        message = self._first(near[0]) if near else None
        return None if message is None else camera_of(message, "rect" in topic)

    def _calibrate(self, frames: tuple[str, str], transforms: Transforms) -> Calibration:
        depth_camera, color_camera = self._camera_info(self._depth.name), self._camera_info(self._color.name)
        if depth_camera is None and color_camera is None:
            raise DatasetError(
                f"{self.path}: no camera_info beside {self._depth.name} or {self._color.name}; give the camera as "
                "--camera fx,fy,cx,cy,width,height,depth_scale"
            )
        if depth_camera is None or color_camera is None:
            depth_camera = color_camera = depth_camera or color_camera
        assert depth_camera is not None and color_camera is not None
        camera, distortion = depth_camera
        try:
            calibration = Calibration(camera, self._units(), source=f"camera_info of {self._depth.name}")
        except ConfigError as error:
            raise DatasetError(f"{self.path}: {error}") from error
        T_color_depth = self._extrinsic(frames, transforms)
        is_registered = frames[0] == frames[1] or any(word in self._depth.name for word in _DEPTH_WORDS[:-1])
        if is_registered or (T_color_depth is None and camera == color_camera[0]):
            return replace(calibration, distortion=color_camera[1], depth_distorted=bool(color_camera[1]))
        numbers = np.eye(4) if T_color_depth is None else T_color_depth
        color = ColorCamera(color_camera[0], color_camera[1], tuple(numbers.ravel().tolist()))
        return replace(calibration, color=color)

    def _units(self) -> float:
        """Stored units a metre of integer depth: RealSense's own files say so, else millimetres."""
        names = [c.topic for c in self._reader.connections if "Depth_Units/value" in c.topic]
        message = self._first(names[0]) if names else None
        return 1 / float(message.data) if message is not None and float(message.data) > 0 else 1000.0

    def _extrinsic(self, frames: tuple[str, str], transforms: Transforms) -> np.ndarray | None:
        """T_color_depth of the static transforms, or of RealSense's own, which lead from a common stream to each."""
        found = transforms.between(frames[0], frames[1]) if all(frames) else None
        if found is not None:
            return found
        tf = {}
        for kind, topic in (("color", self._color.name), ("depth", self._depth.name)):
            base = topic.split("/image")[0]
            names = [c.topic for c in self._reader.connections if c.topic.startswith(f"{base}/tf/")]
            message = self._first(names[0]) if names else None
            if message is None:
                return None
            tf[kind] = transform_of(message)
        return tf["color"] @ np.linalg.inv(tf["depth"])

    def _transforms(self) -> Transforms:
        transforms = Transforms()
        names = [c.topic for c in self._reader.connections if c.msgtype in _TF_TYPES]
        for connection, _, data in self._reader.messages(self._connections(names)) if names else ():
            transforms.add(self._reader.deserialize(data, connection.msgtype), "static" in connection.topic)
        return transforms

    def _read_poses(
        self, name: str | None, frame: str, transforms: Transforms, times: np.ndarray
    ) -> tuple[np.ndarray | None, tuple[Remark, ...]]:
        """Poses of the camera (N, 4, 4) from the topic named, else from transforms, else from odometry."""
        if name is None:
            poses, root = transforms.path_of(frame, times)
            if poses is not None:
                return poses, (Remark("poses", f"from the transforms, of {frame} in {root}", is_fine=True),)
        candidates = [c for c in self._reader.connections if c.msgtype in _POSES and name in (None, c.topic)]
        if not candidates:
            return None, ()
        track, child = [], ""
        for connection, _, data in self._reader.messages(self._connections(candidates[0].topic)):
            message = self._reader.deserialize(data, connection.msgtype)
            body = getattr(message, "transform", None) or message.pose
            stamp = message.header.stamp
            track.append((stamp.sec + 1e-9 * stamp.nanosec, transform_of(getattr(body, "pose", body))))
            child = getattr(message, "child_frame_id", "")
        topic, body_camera = candidates[0].topic, transforms.between(child, frame) if child else None
        poses = at_times(track, times)
        text = f"from {topic}"
        if body_camera is None:
            return poses, (Remark("poses", f"{text}, taken as those of the camera", is_fine=True),)
        return poses @ body_camera, (Remark("poses", f"{text}, of {frame} fixed to {child}", is_fine=True),)


def _best(names: list[str], words: tuple[str, ...], excluded: tuple[str, ...]) -> str | None:
    """The name with the word that speaks most for it; of several the raw one, and of these the first."""
    fit = [name for name in names if not any(word in name.lower() for word in excluded)]
    ranks = {name: next((i for i, word in enumerate(words) if word in name.lower()), None) for name in fit}
    known = {name: rank for name, rank in ranks.items() if rank is not None}
    return min(known, key=lambda name: (known[name], "compressed" in name.lower(), name)) if known else None


def _open(path: Path) -> Any:
    try:
        from rosbags.highlevel import AnyReader, AnyReaderError
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise MissingDependencyError(
            f"{path}: reading bags needs the package rosbags; type: pip install rosbags"
        ) from error
    logging.getLogger("rosbags").setLevel(logging.ERROR)
    try:
        for file in path.iterdir() if path.is_dir() else (path,):
            if file.suffix in _BAG_FILES:
                check_regular(file)
        reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        reader.open()
    except (AnyReaderError, OSError, ValueError, KeyError) as error:
        raise DatasetError(
            f"{path}: can't be read as a bag ({error}); record it again, or repair it with its tools"
        ) from error
    return reader
