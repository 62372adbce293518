"""A sequence in which a piece of furniture moves through the view of a static room."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from warpslam.camera import Intrinsics
from warpslam.errors import InputError
from warpslam.sequences.base import Frame
from warpslam.synthetic.camera_path import room_trajectory
from warpslam.synthetic.furniture import Piece, box_stack, chair, plant
from warpslam.synthetic.render import MeshRenderer
from warpslam.synthetic.rooms import Room, make_room
from warpslam.synthetic.sequence import DEFAULT_INTRINSICS, RenderedSequence
from warpslam.synthetic.solids import yaw_rotation

if TYPE_CHECKING:
    import trimesh

CAMERA_CLEARANCE = 0.35  # [m] between the object and the camera
TURN = 0.8  # [rad] by which the object turns on its way
_BUILDERS = (chair, box_stack, plant)


class MovingObjectSequence(RenderedSequence):
    """A camera walks through a room while an object crosses its view.

    The object moves along a straight line, turning about the vertical, during the middle three fifths of the frames,
    and stands still before and after. It floats where the floor is taken, and touches neither the room nor the camera.
    Depth, poses and masks are exact; the object keeps its shading while it turns.

    room, mesh: The static room and its mesh.
    object_mesh: The object in its own frame [m].
    object_poses: T_world_object of each frame, float64, shape (N, 4, 4).
    moving_frames: Frames during which the object moves.
    """

    def __init__(
        self,
        room_seed: int = 0,
        frame_count: int = 100,
        *,
        intrinsics: Intrinsics = DEFAULT_INTRINSICS,
        path_seed: int = 0,
        object_seed: int = 0,
        device: str | None = None,
    ) -> None:
        """Build the room, the camera's path and the object's; frames are rendered on demand.

        Args:
            room_seed: Seed of the room.
            frame_count: Number of frames, at least 10.
            intrinsics: Camera.
            path_seed: Seed of the camera's path.
            object_seed: Seed of the object and of its way.
            device: Warp device that renders, None = Warp's default one.

        Raises:
            InputError: There are too few frames, or nowhere in view is room for the object to move.
        """
        if frame_count < 10:
            raise InputError(f"frame_count = {frame_count} must be at least 10 for an object to move")
        self.room = make_room(room_seed)
        self.mesh = self.room.mesh()
        poses = room_trajectory(self.room, frame_count, path_seed)
        rng = np.random.default_rng([object_seed, room_seed])
        self.object_mesh = make_object(rng)
        self.moving_frames = range(frame_count // 5, frame_count - frame_count // 5)
        self.object_poses = _object_path(self.room, self.object_mesh, poses, self.moving_frames, intrinsics, rng)
        super().__init__(f"synthetic_{room_seed}_moving", MeshRenderer(self.mesh, intrinsics, device=device), poses)
        self._object_renderer = MeshRenderer(self.object_mesh, intrinsics, device=device)

    def __getitem__(self, index: int) -> Frame:
        frame = super().__getitem__(index)
        rgb, depth = self._object_view(frame.index)
        mask = _in_front(depth, frame.depth)
        frame.rgb[mask], frame.depth[mask] = rgb[mask], depth[mask]
        return frame

    def object_mask(self, index: int) -> np.ndarray:
        """Pixels of a frame that show the object, bool, shape (H, W)."""
        return _in_front(self._object_view(index)[1], super().__getitem__(index).depth)

    def static_frame(self, index: int) -> Frame:
        """The same frame of the room without the object."""
        return super().__getitem__(index)

    def _object_view(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        return self._object_renderer.render(np.linalg.inv(self.object_poses[index]) @ self._poses[index])


def make_object(rng: np.random.Generator) -> trimesh.Trimesh:
    """A random piece of furniture in its own frame: origin in the middle of its footprint, z up [m]."""
    piece = Piece(rng, [])
    _BUILDERS[rng.integers(len(_BUILDERS))](piece)
    boxes = np.stack([solid.bounds for solid in piece.solids])
    extent = np.stack([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])
    # `Room.mesh` leaves out what lies outside the interior or in another solid; the interior is all of the piece.
    body = Room(piece.solids, piece.materials, extent + [[-0.1], [0.1]], np.zeros(3), 0.0)
    return body.mesh()


def _in_front(depth: np.ndarray, behind: np.ndarray) -> np.ndarray:
    return (depth > 0) & ((behind == 0) | (depth < behind))


def _object_path(
    room: Room,
    mesh: trimesh.Trimesh,
    poses: np.ndarray,
    moving: range,
    camera: Intrinsics,
    rng: np.random.Generator,
) -> np.ndarray:
    """T_world_object, shape (N, 4, 4), along the free line that shows most of the object at half time.

    Lines lie across the view at half time, in random places.
    """
    low, high = mesh.bounds
    radius = float(np.hypot(*np.abs(mesh.bounds[:, :2]).max(axis=0)))
    # A cylinder around the object, turned any way, as points on its axis and rim.
    angles = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    rim = radius * np.column_stack([np.cos(angles), np.sin(angles)])
    body = np.array([[*xy, z] for z in np.linspace(low[2] + 0.07, high[2], 5) for xy in [*rim, (0.0, 0.0)]])
    T = poses[(moving.start + moving.stop) // 2]
    floor = room.interior_bounds[0, 2]
    right = np.array([*T[:2, 0], 0.0]) / np.linalg.norm(T[:2, 0])
    ahead = np.array([*T[:2, 2], 0.0]) / np.linalg.norm(T[:2, 2])
    best: tuple[float, np.ndarray, np.ndarray] | None = None
    for _ in range(400):
        distance, length = rng.uniform(0.8 + radius, 3.2), rng.uniform(0.6, 1.6)
        shift, height = rng.uniform(-0.3, 0.3), rng.choice([0.0, 0.3, 0.6, 0.9, 1.2])
        slant = rng.uniform(-0.5, 0.5)
        middle = np.array([*T[:2, 3], floor + height]) + distance * ahead + shift * right
        half = 0.5 * length * (right + slant * ahead) * rng.choice([-1.0, 1.0])
        if height + high[2] > room.interior_bounds[1, 2] - floor - 0.05:
            continue
        way = middle + np.linspace(-1, 1, 8)[:, None] * half
        if np.linalg.norm(way[:, None, :2] - poses[None, :, :2, 3], axis=2).min() < radius + CAMERA_CLEARANCE:
            continue
        if not room.free_space((way[:, None] + body).reshape(-1, 3), 0.06).all():
            continue
        share = _share_in_view(middle + body, T, camera) / distance**2
        if best is None or share > best[0]:
            best = share, middle, half
    if best is None:
        raise InputError("nowhere in view is room for the object to move; use another room, path or object seed")
    _, middle, half = best
    result = np.tile(np.eye(4), (len(poses), 1, 1))
    start, turn = rng.uniform(0, 2 * np.pi), TURN * rng.choice([-1.0, 1.0])
    for index in range(len(poses)):
        s = np.clip((index - moving.start) / max(len(moving) - 1, 1), 0.0, 1.0)
        # Starts and stops smoothly.
        s = s * s * (3 - 2 * s)
        result[index, :3, :3] = yaw_rotation(start + turn * s)
        result[index, :3, 3] = middle + (2 * s - 1) * half
    return result


def _share_in_view(points: np.ndarray, T_world_camera: np.ndarray, camera: Intrinsics) -> float:
    q = (points - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
    z = np.maximum(q[:, 2], 1e-3)
    u, v = camera.project(q[:, 0], q[:, 1], z)
    return float(np.mean((q[:, 2] > 0.1) & (u > 0) & (u < camera.width) & (v > 0) & (v < camera.height)))
