"""Bags of ROS 1 and ROS 2, and RealSense's own, written here and read back."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.sequences.recordings import CAMERA, Room, room
from tests.sequences.test_cases import find, same_frames
from warpslam.errors import DatasetError, MissingDependencyError
from warpslam.poses import vector_from_pose
from warpslam.sequences import guess_dataset, open_sequence
from warpslam.sequences.checking import OK, WARNING, check_folder

pytest.importorskip("rosbags", reason="the package rosbags is not installed")
START = 1_700_000_000_000_000_000
STEP = 33_333_333
FRAMES = 12


class Bag:
    """Writes one bag of any kind; messages are made of the types of that ROS."""

    def __init__(self, path: Path, kind: str) -> None:
        from rosbags.rosbag1 import Writer as Writer1
        from rosbags.rosbag2 import StoragePlugin
        from rosbags.rosbag2 import Writer as Writer2
        from rosbags.typesys import Stores, get_typestore

        self.is_ros1 = kind == "ros1"
        self.store = get_typestore(Stores.ROS1_NOETIC if self.is_ros1 else Stores.ROS2_HUMBLE)
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        self.writer = Writer1(path) if self.is_ros1 else Writer2(path, version=9, storage_plugin=plugin)
        self.writer.open()
        self.connections: dict[str, object] = {}

    def type(self, name: str):
        return self.store.types[name]

    def header(self, time: int, frame: str):
        stamp = self.type("builtin_interfaces/msg/Time")(time // 10**9, time % 10**9)
        fields = (0, stamp, frame) if self.is_ros1 else (stamp, frame)
        return self.type("std_msgs/msg/Header")(*fields)

    def write(self, topic: str, time: int, message) -> None:
        name = message.__msgtype__
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, name, typestore=self.store)
        serialize = self.store.serialize_ros1 if self.is_ros1 else self.store.serialize_cdr
        self.writer.write(self.connections[topic], time, serialize(message, name))

    def image(self, topic: str, time: int, image: np.ndarray, encoding: str, frame: str, padding: int = 0) -> None:
        rows = np.ascontiguousarray(image).view(np.uint8).reshape(image.shape[0], -1)
        rows = np.pad(rows, ((0, 0), (0, padding)))
        Image = self.type("sensor_msgs/msg/Image")
        fields = (self.header(time, frame), *image.shape[:2], encoding, 0, rows.shape[1], rows.ravel())
        self.write(topic, time, Image(*fields))

    def compressed(self, topic: str, time: int, data: bytes, form: str, frame: str) -> None:
        Compressed = self.type("sensor_msgs/msg/CompressedImage")
        self.write(topic, time, Compressed(self.header(time, frame), form, np.frombuffer(data, np.uint8)))

    def camera(self, topic: str, time: int, camera, frame: str) -> None:
        roi = self.type("sensor_msgs/msg/RegionOfInterest")(0, 0, 0, 0, False)
        p = np.hstack([camera.matrix, np.zeros((3, 1))]).ravel()
        fields = (
            self.header(time, frame),
            camera.height,
            camera.width,
            "plumb_bob",
            np.zeros(5),
            camera.matrix.ravel(),
        )
        Info = self.type("sensor_msgs/msg/CameraInfo")
        self.write(topic, time, Info(*fields, np.eye(3).ravel(), p, 0, 0, roi))

    def transform(self, T: np.ndarray):
        w, x, y, z, *t = vector_from_pose(T)
        Vector, Quaternion = (self.type(f"geometry_msgs/msg/{name}") for name in ("Vector3", "Quaternion"))
        return self.type("geometry_msgs/msg/Transform")(Vector(*t), Quaternion(x, y, z, w))

    def tf(self, topic: str, time: int, parent: str, child: str, T: np.ndarray) -> None:
        Stamped = self.type("geometry_msgs/msg/TransformStamped")
        item = Stamped(self.header(time, parent), child, self.transform(T))
        self.write(topic, time, self.type("tf2_msgs/msg/TFMessage")([item]))

    def odometry(self, topic: str, time: int, parent: str, child: str, T: np.ndarray) -> None:
        w, x, y, z, *t = vector_from_pose(T)
        Point, Quaternion, Vector = (
            self.type(f"geometry_msgs/msg/{name}") for name in ("Point", "Quaternion", "Vector3")
        )
        pose = self.type("geometry_msgs/msg/Pose")(Point(*t), Quaternion(x, y, z, w))
        twist = self.type("geometry_msgs/msg/Twist")(Vector(0, 0, 0), Vector(0, 0, 0))
        with_pose = self.type("geometry_msgs/msg/PoseWithCovariance")(pose, np.zeros(36))
        with_twist = self.type("geometry_msgs/msg/TwistWithCovariance")(twist, np.zeros(36))
        Odometry = self.type("nav_msgs/msg/Odometry")
        self.write(topic, time, Odometry(self.header(time, parent), child, with_pose, with_twist))

    def close(self) -> None:
        self.writer.close()


def source() -> Room:
    whole = room()
    return Room(whole.rgb[:FRAMES], whole.depth[:FRAMES], whole.poses[:FRAMES])


def write_bag(path: Path, kind: str, extra: Callable[[Bag], None] | None = None) -> Path:
    """A camera driver's topics: colour, depth registered to it a little later, infrared, cameras."""
    bag, frames = Bag(path, kind), source()
    for i in range(FRAMES):
        time = START + i * STEP
        bag.image("/camera/color/image_raw", time, frames.rgb[i], "rgb8", "optical", padding=16)
        bag.image("/camera/infra1/image_rect_raw", time, frames.rgb[i, ..., :1], "mono8", "infra")
        depth = np.rint(frames.depth[i] * 1000).astype(np.uint16)
        bag.image("/camera/aligned_depth_to_color/image_raw", time + 4_000_000, depth, "16UC1", "optical")
        bag.camera("/camera/color/camera_info", time, CAMERA, "optical")
        bag.camera("/camera/aligned_depth_to_color/camera_info", time, CAMERA, "optical")
    if extra is not None:
        extra(bag)
    bag.close()
    return path


@pytest.mark.parametrize("kind", ["ros1", "sqlite", "mcap"])
def test_a_bag_of_each_kind(tmp_path, kind):
    """Topics are told by name, pairs by time; frames, camera and stamps come back, in any order."""
    path = write_bag(tmp_path / ("record.bag" if kind == "ros1" else "record"), kind)
    assert guess_dataset(path) == "bag"
    sequence = open_sequence(path)
    assert sequence.name == "record" and sequence.intrinsics == CAMERA and sequence.ground_truth() is None
    same_frames(sequence, source(), poses=False)
    np.testing.assert_array_equal(sequence[7].rgb, source().rgb[7])
    np.testing.assert_array_equal(sequence[2].rgb, source().rgb[2])
    assert sequence[3].timestamp == pytest.approx((START + 3 * STEP) * 1e-9, abs=1e-6)
    assert sequence[3].depth_timestamp - sequence[3].timestamp == pytest.approx(0.004, abs=1e-6)
    report = check_folder(path)
    find(report, "topics", OK, "colour is /camera/color/image_raw, depth is /camera/aligned_depth_to_color/image_raw")
    assert not report.errors and not report.warnings


def test_the_file_of_a_ros2_bag(tmp_path):
    """The .mcap inside is a bag as well."""
    (file,) = write_bag(tmp_path / "record", "mcap").glob("*.mcap")
    same_frames(open_sequence(file), source(), poses=False)


def test_other_encodings(tmp_path):
    """Float depth in metres, colour as BGR, JPEG and PNG, and compressedDepth of both kinds, each named with topics."""
    path, frames = tmp_path / "record.bag", source()
    bag = Bag(path, "ros1")
    for i in range(FRAMES):
        time, rgb, depth = START + i * STEP, frames.rgb[i], frames.depth[i].copy()
        depth[0] = np.nan
        bag.image("/a/rgb", time, rgb[..., ::-1], "bgr8", "c")
        bag.compressed("/a/rgb/compressed", time, cv2.imencode(".jpg", rgb[..., ::-1])[1].tobytes(), "jpeg", "c")
        bag.image("/a/depth", time, depth, "32FC1", "c")
        mm = np.rint(frames.depth[i] * 1000).astype(np.uint16)
        png = cv2.imencode(".png", mm)[1].tobytes()
        form = "16UC1; compressedDepth png"
        bag.compressed("/a/depth/compressedDepth", time, struct.pack("<iff", 0, 0, 0) + png, form, "c")
        a, b = 5000.0, 0.0
        inverse = np.rint(a / frames.depth[i] + b).astype(np.uint16)
        png = cv2.imencode(".png", inverse)[1].tobytes()
        form = "32FC1; compressedDepth png"
        bag.compressed("/a/depth/inverse", time, struct.pack("<iff", 0, a, b) + png, form, "c")
        bag.camera("/a/camera_info", time, CAMERA, "c")
    bag.close()
    for color in ("/a/rgb", "/a/rgb/compressed"):
        for depth in ("/a/depth", "/a/depth/compressedDepth", "/a/depth/inverse"):
            sequence = open_sequence(path, topics=f"{color},{depth}", camera="60,60,39.5,29.5,80,60,1000")
            same_frames(sequence, frames, poses=False, tolerance=0.005)
    assert (open_sequence(path, topics="/a/rgb,/a/depth", camera="60,60,39.5,29.5,80,60,1000")[0].depth[0] == 0).all()


def test_poses_from_transforms(tmp_path):
    """A moving base and a camera fixed to it: the camera's pose in the world is the ground truth."""
    frames, T_base_camera = source(), np.eye(4)
    T_base_camera[:3, 3] = 0.1, 0.2, -0.05

    def extra(bag: Bag) -> None:
        bag.tf("/tf_static", START, "base", "optical", T_base_camera)
        for i in range(FRAMES):
            bag.tf("/tf", START + i * STEP, "world", "base", frames.poses[i] @ np.linalg.inv(T_base_camera))

    path = write_bag(tmp_path / "record", "sqlite", extra)
    same_frames(open_sequence(path), frames)
    find(check_folder(path), "poses", OK, "from the transforms, of optical in world")


def test_poses_from_odometry(tmp_path):
    """Odometry of the camera's frame, and one that ends early: the rest has no pose."""

    def extra(bag: Bag) -> None:
        for i in range(FRAMES - 5):
            bag.odometry("/odom", START + i * STEP, "map", "optical", source().poses[i])

    sequence = open_sequence(write_bag(tmp_path / "record", "mcap", extra))
    truth = sequence.ground_truth()
    np.testing.assert_allclose(truth[:7], source().poses[:7], atol=1e-6)
    assert np.isnan(truth[11]).all()


def write_realsense(path: Path) -> Path:
    """As librealsense records: a stream a sensor, depth in its own camera, units and extrinsics as messages."""
    bag, frames = Bag(path, "ros1"), source()
    depth, color = "/device_0/sensor_0/Depth_0", "/device_0/sensor_1/Color_0"
    T_color_depth = np.eye(4)
    T_color_depth[0, 3] = 0.015
    bag.write("/device_0/sensor_0/option/Depth_Units/value", START, bag.type("std_msgs/msg/Float32")(0.00025))
    bag.write(f"{depth}/tf/0", START, bag.transform(np.eye(4)))
    bag.write(f"{color}/tf/0", START, bag.transform(T_color_depth))
    bag.camera(f"{depth}/info/camera_info", START, CAMERA, "0")
    bag.camera(f"{color}/info/camera_info", START, CAMERA, "1")
    for i in range(FRAMES):
        time = START + i * STEP
        bag.image(f"{depth}/image/data", time, np.rint(frames.depth[i] * 4000).astype(np.uint16), "mono16", "0")
        bag.image(f"{color}/image/data", time, frames.rgb[i], "rgb8", "1")
    bag.close()
    return path


def test_realsense(tmp_path):
    """Unit and extrinsics of RealSense's own file are used: depth is moved into the colour camera."""
    sequence = open_sequence(write_realsense(tmp_path / "d435.bag"))
    color = sequence.calibration.color
    assert sequence.calibration.depth_scale == pytest.approx(4000) and color is not None
    np.testing.assert_allclose(color.transform[:3, 3], [0.015, 0, 0], atol=1e-9)
    frame, depth = sequence[4], source().depth[4]
    np.testing.assert_array_equal(frame.rgb, source().rgb[4])
    # 15 mm at 60 px are less than a pixel beyond 0.9 m.
    both = frame.depth > 0
    assert both.mean() > 0.9 and np.median(np.abs(frame.depth - depth)[both]) < 0.02


def test_topics_that_are_not_there(tmp_path):
    """A bag without depth, names that are not in it, and topics of what is no bag."""
    path = tmp_path / "record.bag"
    bag = Bag(path, "ros1")
    bag.image("/cam/image_raw", START, source().rgb[0], "rgb8", "c")
    bag.close()
    with pytest.raises(DatasetError, match="no topic of images is called depth; the bag has /cam/image_raw.*--topics"):
        open_sequence(path)
    with pytest.raises(DatasetError, match="--topics /x,/y: give COLOR,DEPTH.*the bag has /cam/image_raw"):
        open_sequence(path, topics="/x,/y")


def test_depth_that_starts_late(tmp_path):
    """Colour images without depth near in time are counted."""
    path, frames = tmp_path / "record.bag", source()
    bag = Bag(path, "ros1")
    for i in range(FRAMES):
        bag.image("/cam/rgb/image", START + i * STEP, frames.rgb[i], "rgb8", "c")
        if i >= 6:
            depth = np.rint(frames.depth[i] * 1000).astype(np.uint16)
            bag.image("/cam/depth/image", START + i * STEP, depth, "16UC1", "c")
        bag.camera("/cam/rgb/camera_info", START + i * STEP, CAMERA, "c")
    bag.close()
    assert len(open_sequence(path)) == 8  # within 0.08 s of the first depth
    find(check_folder(path), "association", WARNING, "4 of 12 colour images have no depth")


def test_damaged_bag_and_missing_package(tmp_path, monkeypatch):
    """What can't be read is said, and what to install."""
    for suffix in (".bag", ".mcap", ".db3"):
        (tmp_path / f"a{suffix}").write_bytes(b"#ROSBAG V2.0\nnothing")
        with pytest.raises(DatasetError, match=f"a{suffix}: can't be read as a bag"):
            open_sequence(tmp_path / f"a{suffix}")
    import builtins

    original = builtins.__import__

    def without(name, *arguments, **keywords):
        if name.startswith("rosbags"):
            raise ImportError(name)
        return original(name, *arguments, **keywords)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(MissingDependencyError, match="pip install rosbags"):
        open_sequence(tmp_path / "a.bag")
