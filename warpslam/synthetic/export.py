"""Write a synthetic sequence with everything that is known about it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

from warpslam.camera import Intrinsics
from warpslam.errors import ConfigError
from warpslam.synthetic.attacks import AlteredSequence
from warpslam.synthetic.gap import GapSequence
from warpslam.synthetic.hard_scenes import HARD_SCENES, HardScene
from warpslam.synthetic.moving import MovingObjectSequence
from warpslam.synthetic.sequence import DEFAULT_INTRINSICS, SyntheticSequence, write_replica

Truthful = SyntheticSequence | MovingObjectSequence | GapSequence | HardScene | AlteredSequence

SEQUENCE_KINDS = ("room", "moving", "gap", *HARD_SCENES)


def make_sequence(
    kind: str,
    seed: int = 0,
    frame_count: int | None = None,
    *,
    intrinsics: Intrinsics = DEFAULT_INTRINSICS,
    gap: str = "black",
    device: str | None = None,
) -> Truthful:
    """A sequence by the name of its kind.

    Args:
        kind: "room" (a static room), "moving" (an object moves through the view), "gap" (frames are lost), or one of
            `HARD_SCENES`.
        seed: Seed of the room, the path and the object.
        frame_count: Number of frames; by default the kind's own. Of "gap" the middle 100 are lost, or the middle half
            of fewer than 200.
        intrinsics: Camera.
        gap: "black" or "absent", see `GapSequence`.
        device: Warp device that renders, None = Warp's default one.

    Raises:
        ConfigError: There is no such kind.
        InputError: The kind can't have so few frames.
    """
    if kind == "room":
        return SyntheticSequence(seed, frame_count or 120, intrinsics=intrinsics, path_seed=seed, device=device)
    if kind == "moving":
        return MovingObjectSequence(
            seed, frame_count or 100, intrinsics=intrinsics, path_seed=seed, object_seed=seed, device=device
        )
    if kind == "gap":
        count = frame_count or 220
        length = min(100, count // 2)
        return GapSequence(
            seed, count, gap_start=(count - length) // 2, gap_length=length, kind=gap, intrinsics=intrinsics,
            path_seed=seed, device=device,
        )  # fmt: skip
    if kind in HARD_SCENES:
        return HardScene(kind, frame_count, seed=seed, intrinsics=intrinsics, device=device)
    raise ConfigError(f"kind = {kind!r} of sequence is unknown; choose one of {', '.join(SEQUENCE_KINDS)}")


def write_sequence(sequence: Truthful, folder: str | Path, *, progress: Callable[[int], None] | None = None) -> None:
    """Write the frames in the Replica layout (see `write_replica`) and the truth beside them.

    ``mesh.ply``: surface of the static room, in the frame of the poses. ``timestamps.txt``: time of each frame [s].
    With a moving object: ``masks/mask%06d.png`` (255 = object), ``object.ply`` in its own frame, ``object_poses.txt``
    (one row-major object-to-world matrix a line). With a gap: ``lost.txt`` (1 a line where the frame is blacked out).

    Raises:
        DatasetError: The folder already holds frames.
    """
    folder = Path(folder)
    write_replica(sequence, folder, progress=progress)
    if sequence.mesh is not None:
        sequence.mesh.export(folder / "mesh.ply")
    np.savetxt(folder / "timestamps.txt", [sequence.timestamp(index) for index in range(len(sequence))], fmt="%.9f")
    if isinstance(sequence, GapSequence):
        np.savetxt(folder / "lost.txt", sequence.is_lost, fmt="%d")
    if isinstance(sequence, MovingObjectSequence):
        (folder / "masks").mkdir(exist_ok=True)
        for index in range(len(sequence)):
            mask = np.where(sequence.object_mask(index), 255, 0).astype(np.uint8)
            Image.fromarray(mask).save(folder / "masks" / f"mask{index:06d}.png")
        sequence.object_mesh.export(folder / "object.ply")
        np.savetxt(folder / "object_poses.txt", sequence.object_poses.reshape(-1, 16), fmt="%.17g")
