"""Pictures of random rooms, side by side."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from warpslam.camera import Intrinsics
from warpslam.errors import InputError
from warpslam.synthetic.sequence import DEFAULT_INTRINSICS, SyntheticSequence


def contact_sheet(
    seeds: Iterable[int],
    *,
    views: int = 3,
    intrinsics: Intrinsics = DEFAULT_INTRINSICS,
    depth_range: float = 6.0,
    device: str | None = None,
) -> np.ndarray:
    """One row per room: ``views`` colour images spread over its path, and the last one's depth.

    Args:
        seeds: Room seeds.
        views: Colour images per room.
        intrinsics: Camera.
        depth_range: Depth shown white [m]; missing depth is red.
        device: Warp device, None = Warp's default one.

    Returns:
        RGB image, uint8, shape (rooms * H, (views + 1) * W, 3).

    Raises:
        InputError: There is no seed.
    """
    rows = []
    for seed in seeds:
        sequence = SyntheticSequence(seed, 480, intrinsics=intrinsics, device=device)
        frames = [sequence[480 * view // views] for view in range(views)]
        depth = frames[-1].depth
        gray = np.repeat(np.clip(255 * depth / depth_range, 0, 255).astype(np.uint8)[..., None], 3, axis=2)
        gray[depth == 0] = (255, 0, 0)
        rows.append(np.concatenate([*[frame.rgb for frame in frames], gray], axis=1))
    if not rows:
        raise InputError("contact_sheet needs at least one seed")
    return np.concatenate(rows)
