"""A sequence whose frames are lost for a while, during which the camera walks on, turns round and comes back."""

from __future__ import annotations

import numpy as np

from warpslam.camera import Intrinsics
from warpslam.errors import InputError
from warpslam.sequences.base import Frame
from warpslam.synthetic.camera_path import room_trajectory
from warpslam.synthetic.render import MeshRenderer
from warpslam.synthetic.rooms import make_room
from warpslam.synthetic.sequence import DEFAULT_INTRINSICS, FRAME_RATE, RenderedSequence

GAP_KINDS = ("absent", "black")


class GapSequence(RenderedSequence):
    """A room seen before and after a gap; after it the camera shows ground that was seen before.

    The camera walks on into the gap, turns round within its first half, and walks back. When frames come again it is
    half a gap's way before the place at which they stopped, and goes on backwards.

    room, mesh: The room, and the mesh that is rendered.
    gap: Frames that are lost, on the clock of the camera.
    camera_frames: Number on that clock of each frame, int, shape (N,).
    is_lost: Whether a frame is blacked out, bool, shape (N,); never where lost frames are absent.
    """

    def __init__(
        self,
        room_seed: int = 0,
        frame_count: int = 220,
        *,
        gap_start: int = 60,
        gap_length: int = 100,
        kind: str = "black",
        intrinsics: Intrinsics = DEFAULT_INTRINSICS,
        path_seed: int = 0,
        device: str | None = None,
    ) -> None:
        """Build the room and its path; frames are rendered on demand.

        Args:
            room_seed: Seed of the room.
            frame_count: Frames on the camera's clock, the lost ones included.
            gap_start: First lost frame.
            gap_length: Lost frames.
            kind: "black": lost frames come without colour and depth. "absent": they are missing, and only the times of
                the others tell.
            intrinsics: Camera.
            path_seed: Seed of the path.
            device: Warp device that renders, None = Warp's default one.

        Raises:
            InputError: The kind is unknown, or the gap leaves no frame before or after it.
        """
        if kind not in GAP_KINDS:
            raise InputError(f"kind = {kind!r} must be one of {', '.join(GAP_KINDS)}")
        if gap_start < 1 or gap_length < 1 or gap_start + gap_length >= frame_count:
            raise InputError(
                f"a gap of {gap_length} frames from frame {gap_start} on leaves no frame before or after it in "
                f"{frame_count} frames; use a later start, a shorter gap or more frames"
            )
        self.room = make_room(room_seed)
        self.mesh = self.room.mesh()
        self.gap = range(gap_start, gap_start + gap_length)
        frames = np.arange(frame_count)
        in_gap = (frames >= self.gap.start) & (frames < self.gap.stop)
        self.camera_frames = frames[~in_gap] if kind == "absent" else frames
        self.is_lost = in_gap[self.camera_frames]
        path = room_trajectory(self.room, frame_count, path_seed, there_and_back(frame_count, self.gap))
        super().__init__(
            f"synthetic_{room_seed}_gap_{kind}",
            MeshRenderer(self.mesh, intrinsics, device=device),
            path[self.camera_frames],
        )

    def __getitem__(self, index: int) -> Frame:
        frame = super().__getitem__(index)
        if self.is_lost[frame.index]:
            frame.rgb[:], frame.depth[:] = 0, 0
        return frame

    def timestamp(self, index: int) -> float:
        """Time of a frame on the camera's clock [s]."""
        return float(self.camera_frames[index]) / FRAME_RATE


def there_and_back(frame_count: int, gap: range) -> np.ndarray:
    """Progress along a path, in frames of steady walking, shape (frame_count,).

    The speed is 1 up to the gap, goes to -1 along a cosine within the gap's first half, and stays there.
    """
    turning = np.clip((np.arange(frame_count - 1) + 0.5 - gap.start) / max(len(gap) // 2, 1), 0.0, 1.0)
    return np.concatenate([[0.0], np.cumsum(np.cos(np.pi * turning))])
