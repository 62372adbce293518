"""RGB-D sequences of synthetic rooms with exact ground truth, and export in the Replica layout."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation, Slerp

from warpslam.camera import Intrinsics
from warpslam.errors import DatasetError, InputError
from warpslam.sequences.base import Frame, RgbdSequence
from warpslam.synthetic.camera_path import room_trajectory
from warpslam.synthetic.noise import sensor_noise
from warpslam.synthetic.render import AntialiasedRenderer, MeshRenderer
from warpslam.synthetic.rooms import make_room

DEFAULT_INTRINSICS = Intrinsics(fx=250.0, fy=250.0, cx=159.5, cy=119.5, width=320, height=240)
REPLICA_DEPTH_SCALE = 6553.5
FRAME_RATE = 30.0
BLUR_VIEWS = 8
"""Views whose mean is an image with motion blur."""


class RenderedSequence(RgbdSequence):
    """Views of a mesh along a path, rendered when they are asked for.

    noise_seed: None = exact depth, else frame i's depth carries `sensor_noise` that depends on (noise_seed, i) only.
    exposure: Shutter time over the time between two frames; above 0, colour has motion blur.
    depth_range: Depth beyond is missing [m], while its colour is seen; None = all is measured.
    warp_modules: Modules of kernels that rendering needs, beside those of SLAM.
    """

    warp_modules = ("warpslam.kernels.raycast",)
    can_read_ahead = False  # kernels of two threads would wait for one another

    def __init__(
        self,
        name: str,
        renderer: MeshRenderer | AntialiasedRenderer,
        poses: np.ndarray,
        *,
        noise_seed: int | None = None,
        exposure: float = 0.0,
        depth_range: float | None = None,
    ) -> None:
        self.name = name
        self.intrinsics = renderer.intrinsics
        self.noise_seed = noise_seed
        self.exposure = exposure
        self.depth_range = depth_range
        self._renderer = renderer
        self._poses = np.asarray(poses, dtype=np.float64)

    def __len__(self) -> int:
        return len(self._poses)

    def __getitem__(self, index: int) -> Frame:
        if not -len(self) <= index < len(self):
            raise IndexError(f"{self.name}: frame {index} of {len(self)}")
        index %= len(self)
        rgb, depth = self._renderer.render(self._poses[index])
        if self.exposure > 0.0:
            views = [self._renderer.render(pose)[0] for pose in self._exposed_poses(index)]
            rgb = np.rint(np.mean(views, axis=0, dtype=np.float32)).astype(np.uint8)
        if self.depth_range is not None:
            depth[depth > self.depth_range] = 0.0
        if self.noise_seed is not None:
            depth = sensor_noise(depth, np.random.default_rng((self.noise_seed, index)), self.intrinsics)
        return Frame(index, self.timestamp(index), rgb, depth, self._poses[index].copy())

    def _exposed_poses(self, index: int) -> np.ndarray:
        """Poses while the shutter is open, a `BLUR_VIEWS`-th of that time apart, around the frame's own."""
        near = np.clip([index - 1, index, index + 1], 0, len(self) - 1)
        # At the ends of the path the camera is taken to stand still on the outer side.
        knots = np.array([-1.0, 0.0, 1.0])
        turn = Slerp(knots, Rotation.from_matrix(self._poses[near, :3, :3]))
        times = self.exposure * ((np.arange(BLUR_VIEWS) + 0.5) / BLUR_VIEWS - 0.5)
        poses = np.tile(np.eye(4), (BLUR_VIEWS, 1, 1))
        poses[:, :3, :3] = turn(times).as_matrix()
        poses[:, :3, 3] = np.stack([np.interp(times, knots, self._poses[near, axis, 3]) for axis in range(3)], axis=1)
        return poses

    def timestamp(self, index: int) -> float:
        """Time of a frame [s]."""
        return index / FRAME_RATE

    def ground_truth(self) -> np.ndarray:
        """All poses, float64, shape (N, 4, 4)."""
        return self._poses.copy()


class SyntheticSequence(RenderedSequence):
    """A camera walking through a random furnished room (see `make_room`, `room_trajectory`).

    room: The room, whose occupancy and surface are known exactly.
    mesh: The mesh that is rendered.
    """

    def __init__(
        self,
        room_seed: int = 0,
        frame_count: int = 120,
        *,
        intrinsics: Intrinsics = DEFAULT_INTRINSICS,
        path_seed: int = 0,
        noise: bool = False,
        device: str | None = None,
    ) -> None:
        """Build the room and its path; frames are rendered on demand.

        Args:
            room_seed: Seed of the room.
            frame_count: Number of frames.
            intrinsics: Camera.
            path_seed: Seed of the path.
            noise: Whether depth carries sensor noise.
            device: Warp device that renders, None = Warp's default one.
        """
        self.room = make_room(room_seed)
        self.mesh = self.room.mesh()
        super().__init__(
            f"synthetic_{room_seed}",
            MeshRenderer(self.mesh, intrinsics, device=device),
            room_trajectory(self.room, frame_count, path_seed),
            noise_seed=room_seed if noise else None,
        )


def write_replica(sequence: RgbdSequence, folder: str | Path, *, progress: Callable[[int], None] | None = None) -> None:
    """Write a sequence with known poses in the Replica layout.

    ``results/frame%06d.png`` (lossless), ``results/depth%06d.png`` (uint16, 6553.5 per metre; beyond 9.99 m: 0),
    ``traj.txt`` (one row-major camera-to-world matrix per line, OpenCV axes) and ``camera.yaml``.

    Args:
        progress: Called with the index of each frame written.

    Raises:
        DatasetError: The folder already holds frames.
        InputError: A frame has no ground-truth pose.
    """
    folder = Path(folder)
    results = folder / "results"
    if results.is_dir() and any(results.iterdir()):
        raise DatasetError(f"{results} already holds files; give an empty folder")
    results.mkdir(parents=True, exist_ok=True)
    k = sequence.intrinsics
    lines = [f"{name}: {getattr(k, name)}" for name in ("fx", "fy", "cx", "cy", "width", "height")]
    (folder / "camera.yaml").write_text("\n".join([*lines, f"depth_scale: {REPLICA_DEPTH_SCALE}", ""]))
    with open(folder / "traj.txt", "w") as trajectory:
        for number, frame in enumerate(sequence):
            if frame.T_world_camera is None:
                raise InputError(f"{sequence.name}: frame {frame.index} has no pose, which traj.txt needs")
            trajectory.write(" ".join(f"{value:.17g}" for value in frame.T_world_camera.ravel()) + "\n")
            scaled = np.round(frame.depth.astype(np.float64) * REPLICA_DEPTH_SCALE)
            scaled = np.where(scaled <= np.iinfo(np.uint16).max, scaled, 0).astype(np.uint16)
            # Fast compression: rendering, not disk space, is what the caller waits for.
            Image.fromarray(frame.rgb).save(results / f"frame{number:06d}.png", compress_level=3)
            Image.fromarray(scaled).save(results / f"depth{number:06d}.png", compress_level=3)
            if progress is not None:
                progress(number)
