"""The built-in sequence: a small furnished room, rendered on the spot, with exact depth, poses and surface."""

from __future__ import annotations

from warpslam.camera import Intrinsics
from warpslam.synthetic.sequence import SyntheticSequence

# Sized so that two CPU cores are done within five minutes, with no kernel compiled beforehand.
FRAME_COUNT = 60
INTRINSICS = Intrinsics(fx=125.0, fy=125.0, cx=79.5, cy=59.5, width=160, height=120)
ROOM_SEED = 0
PRESET = "default"


def demo_sequence() -> SyntheticSequence:
    """The sequence of ``warpslam demo``; its ``mesh`` is the true surface."""
    sequence = SyntheticSequence(ROOM_SEED, FRAME_COUNT, intrinsics=INTRINSICS)
    sequence.name = "demo"
    return sequence
