"""Writes tiny sequences in every format, with frames that are known exactly."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from warpslam.poses import pose_from_vector

WIDTH, HEIGHT = 24, 16
CAMERA = f"20,21,11.5,7.5,{WIDTH},{HEIGHT},1000"
CAMERA_YAML = f"fx: 20\nfy: 21\ncx: 11.5\ncy: 7.5\nwidth: {WIDTH}\nheight: {HEIGHT}\ndepth_scale: 1000\n"


def make_rgb(index: int, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """Colour image with different channels, so that an RGB / BGR mix-up shows."""
    rgb = np.zeros((height, width, 3), np.uint8)
    rgb[..., 0], rgb[..., 1] = 200, 10 * index
    rgb[..., 2] = np.arange(width)
    return rgb


def make_depth(index: int, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """Stored depth, uint16, each pixel different, pixel (0, 0) missing."""
    return (1000 * index + np.arange(width * height).reshape(height, width)).astype(np.uint16) * (
        np.arange(width * height).reshape(height, width) > 0
    ).astype(np.uint16)


def make_pose(index: int) -> np.ndarray:
    """Camera-to-world transform with a rotation that is no permutation."""
    return pose_from_vector([0.8, 0.1 * index, 0.3, -0.2, 1.0 + index, -2.0, 0.5])


def write_image(path: Path, image: np.ndarray) -> Path:
    """Write colour (RGB) or depth with OpenCV."""
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image[..., ::-1] if image.ndim == 3 else image)
    return path


def matrix_text(T: np.ndarray) -> str:
    """Four lines of four numbers."""
    return "\n".join(" ".join(repr(float(value)) for value in row) for row in T) + "\n"


def write_log(path: Path, poses: dict[int, np.ndarray]) -> None:
    """Redwood trajectory."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(f"{i} {i} {i + 1}\n{matrix_text(T)}" for i, T in poses.items()))


def write_replica(folder: Path, count: int = 3, camera: str | None = CAMERA_YAML) -> Path:
    """Replica layout with PNG colour."""
    for i in range(count):
        write_image(folder / "results" / f"frame{i:06d}.png", make_rgb(i))
        write_image(folder / "results" / f"depth{i:06d}.png", make_depth(i))
    lines = (" ".join(repr(float(v)) for v in make_pose(i).ravel()) for i in range(count))
    (folder / "traj.txt").write_text("\n".join(lines) + "\n")
    if camera is not None:
        (folder / "camera.yaml").write_text(camera)
    return folder


def write_tum(folder: Path, times: list[float], depth_times: list[float], pose_times: list[float]) -> Path:
    """TUM layout; images of index i, poses of index i, at the given times."""
    for kind, stamps, make in (("rgb", times, make_rgb), ("depth", depth_times, make_depth)):
        lines = ["# a comment", "# timestamp filename"]
        folder.mkdir(parents=True, exist_ok=True)
        for i, time in enumerate(stamps):
            write_image(folder / kind / f"{time:.6f}.png", make(i))
            lines.append(f"{time:.6f} {kind}/{time:.6f}.png")
        (folder / f"{kind}.txt").write_text("\n".join(lines) + "\n")
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    for i, time in enumerate(pose_times):
        w, x, y, z = np.array([0.8, 0.1 * i, 0.3, -0.2])
        lines.append(
            f"{time:.6f} {1.0 + i} -2.0 0.5 {x!r} {y!r} {z!r} {w!r}".replace("np.float64(", "").replace(")", "")
        )
    (folder / "groundtruth.txt").write_text("\n".join(lines) + "\n")
    return folder


def write_scannet(folder: Path, count: int = 3) -> Path:
    """ScanNet layout with colour twice the size of depth; pose 1 is -inf. Names make 10 sort before 2 as text."""
    for i, name in list(enumerate(("0", "2", "10")))[:count]:
        write_image(folder / "frames" / "color" / f"{name}.jpg", make_rgb(i, 2 * WIDTH, 2 * HEIGHT))
        write_image(folder / "frames" / "depth" / f"{name}.png", make_depth(i))
        pose_file = folder / "frames" / "pose" / f"{name}.txt"
        pose_file.parent.mkdir(parents=True, exist_ok=True)
        pose_file.write_text("-inf -inf -inf -inf\n" * 4 if i == 1 else matrix_text(make_pose(i)))
    return folder


def write_seven_scenes(folder: Path, count: int = 3) -> Path:
    """7-Scenes layout; pixel (0, 1) of depth is 65535."""
    for i in range(count):
        depth = make_depth(i)
        depth[0, 1] = 65535
        write_image(folder / f"frame-{i:06d}.color.png", make_rgb(i))
        write_image(folder / f"frame-{i:06d}.depth.png", depth)
        (folder / f"frame-{i:06d}.pose.txt").write_text(matrix_text(make_pose(i)))
    return folder


def write_color_depth(folder: Path, color: str, count: int = 3) -> Path:
    """Folders ``color`` and depth/, without poses."""
    for i in range(count):
        write_image(folder / color / f"{i:05d}.png", make_rgb(i))
        write_image(folder / "depth" / f"{i:05d}.png", make_depth(i))
    return folder


def write_exr(path: Path, pixels: np.ndarray, channel: str = "Y") -> Path:
    """Uncompressed one-channel float EXR, written by hand from the published file layout."""
    height, width = pixels.shape

    def attribute(name: str, kind: str, value: bytes) -> bytes:
        return name.encode() + b"\0" + kind.encode() + b"\0" + np.int32(len(value)).tobytes() + value

    box = np.array([0, 0, width - 1, height - 1], "<i4").tobytes()
    channels = channel.encode() + b"\0" + np.array([2, 0, 1, 1], "<i4").tobytes() + b"\0"
    header = b"".join(
        [
            np.array([20000630, 2], "<i4").tobytes(),
            attribute("channels", "chlist", channels),
            attribute("compression", "compression", b"\0"),
            attribute("dataWindow", "box2i", box),
            attribute("displayWindow", "box2i", box),
            attribute("lineOrder", "lineOrder", b"\0"),
            attribute("pixelAspectRatio", "float", np.float32(1).tobytes()),
            attribute("screenWindowCenter", "v2f", np.zeros(2, "<f4").tobytes()),
            attribute("screenWindowWidth", "float", np.float32(1).tobytes()),
            b"\0",
        ]
    )
    line_bytes = 8 + 4 * width
    offsets = len(header) + 8 * height + line_bytes * np.arange(height, dtype="<u8")
    body = b"".join(
        np.array([row, 4 * width], "<i4").tobytes() + pixels[row].astype("<f4").tobytes() for row in range(height)
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(header + offsets.tobytes() + body)
    return path


def write_cofusion(folder: Path, count: int = 2) -> Path:
    """Co-Fusion layout; pixel (0, 1) is where the ray leaves the scene, (0, 2) is infinite, (0, 3) not a number."""
    for i in range(count):
        depth = make_depth(i).astype(np.float32) / 1000
        depth[0, 1:4] = 1e10, np.inf, np.nan
        write_image(folder / "colour" / f"Color{i + 1:04d}.png", make_rgb(i))
        write_exr(folder / "depth_noise" / f"Depth{i + 1:04d}.exr", depth)
    return folder
