"""Frames of a rendered room, and the folders that people have, written from them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from tests.sequences.writers import write_image, write_log
from warpslam.camera import Intrinsics
from warpslam.poses import vector_from_pose
from warpslam.synthetic import SyntheticSequence

CAMERA = Intrinsics(60.0, 60.0, 39.5, 29.5, 80, 60)
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Room:
    """Frames of a camera that looks round a furnished room."""

    rgb: np.ndarray
    """uint8 (N, H, W, 3)."""
    depth: np.ndarray
    """[m], float32 (N, H, W)."""
    poses: np.ndarray
    """T_world_camera (N, 4, 4)."""

    def __len__(self) -> int:
        return len(self.rgb)

    def scaled(self, factor: float) -> Room:
        """The same room, that much as large."""
        poses = self.poses.copy()
        poses[:, :3, 3] *= factor
        return Room(self.rgb, (self.depth * np.float32(factor)), poses)


@cache
def room(frames: int = 24, camera: Intrinsics = CAMERA, seed: int = 1) -> Room:
    """Rendered once a process."""
    sequence = SyntheticSequence(seed, frames, intrinsics=camera, device="cpu")
    views = [sequence[i] for i in range(frames)]
    return Room(*(np.stack([getattr(view, name) for view in views]) for name in ("rgb", "depth", "T_world_camera")))


def stored(depth: np.ndarray, scale: float = 1000.0) -> np.ndarray:
    """Depth as a 16-bit image, 0 = missing."""
    return np.clip(np.rint(depth * scale), 0, 65535).astype(np.uint16)


def camera_yaml(folder: Path, scale: float = 1000.0, camera: Intrinsics = CAMERA, more: str = "") -> None:
    """The camera of the room."""
    folder.mkdir(parents=True, exist_ok=True)
    lines = [f"{name}: {value}" for name, value in vars(camera).items()]
    (folder / "camera.yaml").write_text("\n".join([*lines, f"depth_scale: {scale}", more]) + "\n")


def write_own(
    folder: Path,
    room: Room,
    *,
    scale: float = 1000.0,
    with_poses: bool = False,
    with_camera: bool = True,
    camera: Intrinsics = CAMERA,
) -> Path:
    """color/, depth/, camera.yaml and, where wanted, trajectory.log."""
    for i in range(len(room)):
        write_image(folder / f"color/{i:06d}.png", room.rgb[i])
        write_image(folder / f"depth/{i:06d}.png", stored(room.depth[i], scale))
    if with_camera:
        camera_yaml(folder, scale, camera)
    if with_poses:
        write_log(folder / "trajectory.log", dict(enumerate(room.poses)))
    return folder


def write_lists(
    folder: Path, room: Room, times: list[str], depth_times: list[str] | None = None, every: int = 1
) -> Path:
    """TUM's lists with times as they are given, and a depth image for every n-th colour image."""
    depth_times = times if depth_times is None else depth_times
    camera_yaml(folder, 5000)
    for i in range(len(room)):
        write_image(folder / f"rgb/{i:04d}.png", room.rgb[i])
        if i % every == 0:
            write_image(folder / f"depth/{i:04d}.png", stored(room.depth[i], 5000))
    (folder / "rgb.txt").write_text("".join(f"{t} rgb/{i:04d}.png\n" for i, t in enumerate(times)))
    lines = (f"{t} depth/{i:04d}.png\n" for i, t in enumerate(depth_times) if i % every == 0)
    (folder / "depth.txt").write_text("".join(lines))
    return folder


def tum_line(time: float, T: np.ndarray, order: tuple[int, ...] = (1, 2, 3, 0)) -> str:
    """``t tx ty tz`` and the quaternion in that order of w x y z."""
    vector = vector_from_pose(T)
    return " ".join(f"{value:.9f}" for value in (time, *vector[4:], *vector[list(order)])) + "\n"


def write_tum_poses(path: Path, room: Room, times: np.ndarray, order: tuple[int, ...] = (1, 2, 3, 0)) -> Path:
    """A trajectory in the TUM format."""
    path.write_text("".join(tum_line(t, T, order) for t, T in zip(times, room.poses, strict=True)))
    return path


def write_video(path: Path, images: np.ndarray, rate: float = 30.0) -> Path:
    """Motion JPEG or MPEG-4 by the suffix; frames (N, H, W, 3) in RGB order."""
    path.parent.mkdir(parents=True, exist_ok=True)
    code = "mp4v" if path.suffix == ".mp4" else "MJPG"
    height, width = images.shape[1:3]
    video = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*code), rate, (width, height))
    for image in images:
        video.write(np.ascontiguousarray(image[..., ::-1]))
    video.release()
    assert path.stat().st_size > 0
    return path


def enlarged(room: Room, factor: float) -> np.ndarray:
    """Colour images that much as large, uint8."""
    size = (int(CAMERA.width * factor), int(CAMERA.height * factor))
    return np.stack([cv2.resize(image, size, interpolation=cv2.INTER_LINEAR) for image in room.rgb])
