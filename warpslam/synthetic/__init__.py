"""Synthetic rooms, a ray-cast renderer and RGB-D sequences with exact ground truth."""

from __future__ import annotations

from warpslam.synthetic.attacks import ALTERATIONS, AlteredSequence, altered
from warpslam.synthetic.camera_path import look_at, orbit, room_trajectory, walk
from warpslam.synthetic.export import SEQUENCE_KINDS, make_sequence, write_sequence
from warpslam.synthetic.gap import GAP_KINDS, GapSequence
from warpslam.synthetic.hand_held import hand_held
from warpslam.synthetic.hard_scenes import HARD_SCENES, HardScene
from warpslam.synthetic.moving import MovingObjectSequence
from warpslam.synthetic.noise import sensor_noise
from warpslam.synthetic.render import AntialiasedRenderer, MeshRenderer, load_mesh
from warpslam.synthetic.rooms import Room, make_room
from warpslam.synthetic.sequence import RenderedSequence, SyntheticSequence, write_replica
from warpslam.synthetic.sheet import contact_sheet

__all__ = [
    "ALTERATIONS",
    "GAP_KINDS",
    "HARD_SCENES",
    "SEQUENCE_KINDS",
    "AlteredSequence",
    "AntialiasedRenderer",
    "GapSequence",
    "HardScene",
    "MeshRenderer",
    "MovingObjectSequence",
    "RenderedSequence",
    "Room",
    "SyntheticSequence",
    "altered",
    "contact_sheet",
    "hand_held",
    "load_mesh",
    "look_at",
    "make_room",
    "make_sequence",
    "orbit",
    "room_trajectory",
    "sensor_noise",
    "walk",
    "write_replica",
    "write_sequence",
]
