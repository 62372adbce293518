"""The frames of a mapping call (Sec. 3.4): keyframes that see what the current frame sees, and the last keyframe."""

from __future__ import annotations

import numpy as np

from warpslam.camera import Intrinsics
from warpslam.runtime.phases import phase
from warpslam.scene.image_pool import ImagePool
from warpslam.scene.keyframes import Keyframe, overlap_fractions


@phase("keyframe selection")
def overlapping_window(
    keyframes: list[Keyframe],
    size: int,
    rng: np.random.Generator,
    depth: np.ndarray,
    T_world_camera: np.ndarray,
    camera: Intrinsics,
) -> list[Keyframe]:
    """Up to ``size`` - 2 random keyframes of those that see what the current frame sees, and the last keyframe.

    Args:
        keyframes: All of them, in their order.
        size: Frames of the window, the current one included.
        rng: Chooses.
        depth: Current depth image [m], (H, W).
        T_world_camera: Current pose (4, 4).
        camera: Intrinsics.
    """
    if not keyframes or size < 2:
        return []
    *candidates, last = keyframes
    if candidates:
        poses = [keyframe.pose for keyframe in candidates]
        fractions = overlap_fractions(depth, T_world_camera, poses, camera, rng)
        candidates = [keyframe for keyframe, fraction in zip(candidates, fractions, strict=True) if fraction > 0]
    return [*_some(candidates, size - 2, rng), last]


@phase("keyframe selection")
def random_window(keyframes: list[Keyframe], size: int, rng: np.random.Generator) -> list[Keyframe]:
    """Up to ``size`` - 2 random keyframes, and the last one."""
    if not keyframes or size < 2:
        return []
    *candidates, last = keyframes
    return [*_some(candidates, size - 2, rng), last]


@phase("keyframe selection")
def replayed_keyframes(
    keyframes: list[Keyframe],
    count: int,
    rng: np.random.Generator,
    images: ImagePool,
    T_world_camera: np.ndarray,
    camera: Intrinsics,
) -> list[Keyframe]:
    """``count`` random ones of the keyframes that see a tenth of what the current frame sees, in turn where there are
    fewer; none if there are none.
    """
    if not keyframes or not count:
        return []
    poses = [keyframe.pose for keyframe in keyframes]
    fractions = overlap_fractions(images.current_depth(), T_world_camera, poses, camera, rng)
    return random_keyframes([one for one, share in zip(keyframes, fractions, strict=True) if share > 0.1], count, rng)


def random_keyframes(keyframes: list[Keyframe], count: int, rng: np.random.Generator) -> list[Keyframe]:
    """``count`` keyframes in random order, in turn where there are fewer; none if there are none."""
    return keyframes_in_turn(keyframes, 0, count, rng)


def keyframes_in_turn(keyframes: list[Keyframe], first: int, count: int, rng: np.random.Generator) -> list[Keyframe]:
    """``count`` keyframes from place ``first`` on of their random order, which repeats; none if there are none."""
    if not keyframes:
        return []
    order = rng.permutation(len(keyframes))
    return [keyframes[order[n % len(order)]] for n in range(first, first + count)]


def _some(keyframes: list[Keyframe], count: int, rng: np.random.Generator) -> list[Keyframe]:
    return [keyframes[n] for n in rng.permutation(len(keyframes))[: max(count, 0)]]
