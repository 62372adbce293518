"""Poses against depth: do the sequence's own, or those of a file, belong to its frames, and in which reading?"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from warpslam.sequences.base import RgbdSequence
from warpslam.sequences.findings import ERROR, OK, WARNING, Finding
from warpslam.sequences.images import ImageSequence
from warpslam.sequences.pose_convention import EXPECTED, READINGS, W_FIRST, Pairs, agreement, on_axis, posed_pairs

KNOWN_DEPTH_SCALES = (1.0, 256.0, 1000.0, 4000.0, 5000.0, 6553.5, 8000.0, 10000.0)
"""Stored units per metre that are in use."""

_MAX_JUMP = 0.5  # [m] of the true pose from frame to frame
_PAIR_COUNT = 6  # of frames that poses and depth are compared in
_SURE = 0.85  # agreement of depth and poses beyond which nothing else is tried
_MEANINGFUL, _CLEARLY = 0.5, 0.15  # agreement of another reading that counts, and by how much it must be better
_MIN_PAIRS = 3  # that must disagree before given poses are refused
_RAYS_SURE = 0.8  # the same for depth along the ray, which changes little
_NAMED = 3


@dataclass(frozen=True)
class PoseFit:
    """Poses and the depth of frames that are far enough apart to tell."""

    poses: np.ndarray | None
    """Of the frames looked at, as given, (N, 4, 4), NaN where unknown; None where there are none."""
    pairs: Pairs
    given: float
    """Share of the depth that agrees with the poses as they are read; 0 where nothing tells."""
    path: Path | None = None
    """The file of poses that take the place of the sequence's own."""

    @property
    def confirms(self) -> bool:
        """Whether poses and depth are of one scale: their agreement is no chance."""
        return bool(self.pairs) and self.given > _SURE

    @classmethod
    def of(
        cls,
        sequence: RgbdSequence,
        frames: Sequence[int],
        given: np.ndarray | None = None,
        path: Path | None = None,
    ) -> PoseFit:
        """The fit of the poses ``given`` to the frames, (N, 4, 4), or of the sequence's own."""
        poses = given
        if poses is None:
            truth = sequence.ground_truth()
            poses = None if truth is None else truth[np.asarray(frames)]
        if poses is None:
            return cls(None, [], 0.0, path)
        pairs = posed_pairs(sequence, poses, frames, _PAIR_COUNT)
        return cls(poses, pairs, agreement(pairs, sequence.intrinsics) if pairs else 0.0, path)


def check_poses(sequence: RgbdSequence, frames: Sequence[int], fit: PoseFit, poses_matter: bool) -> Iterator[Finding]:
    """What is to be said of the poses: how many are known, whether they jump, and whether depth agrees with them."""
    if fit.poses is None:
        yield Finding("poses", OK, "no ground truth: no trajectory error will be given")
        return
    known = np.isfinite(fit.poses).all(axis=(1, 2))
    whose = "" if fit.path is None else f" in {fit.path}"
    if not known.all():
        message = f"{np.count_nonzero(~known)} of {len(known)} frames have no pose{whose}"
        yield Finding("poses", WARNING if poses_matter else OK, message)
    where = np.flatnonzero(known)
    gaps = np.diff(where)
    jumps = np.linalg.norm(np.diff(fit.poses[where, :3, 3], axis=0), axis=1)
    stride = getattr(frames, "step", 1)
    large = np.flatnonzero(jumps > _MAX_JUMP * stride * gaps)
    if len(large):
        named = ", ".join(f"frame {frames[int(where[i + 1])]} ({jumps[i]:.2f} m)" for i in large[:_NAMED])
        message = f"{len(large)} poses{whose} jump from one frame to the next: {named}"
        yield Finding("poses", WARNING, message, "check that poses belong to these frames and are in metres")
    yield _check_convention(sequence, fit, poses_matter)


def _check_convention(sequence: RgbdSequence, fit: PoseFit, poses_matter: bool) -> Finding:
    if not fit.pairs:
        return Finding("pose convention", OK, "the camera moves too little, or its frames can't be read, to tell")
    camera, pairs, given = sequence.intrinsics, fit.pairs, fit.given
    scores = {name: agreement(pairs, camera, name) for name in READINGS}
    best = max(scores, key=lambda name: scores[name])
    bad = ERROR if poses_matter else WARNING
    if _is_clearly_better(scores[best], given):
        message = f"poses are read as {EXPECTED}, which {given:.0%} of the depth agrees with; as {best} it is "
        message += f"{scores[best]:.0%}"
        return Finding("pose convention", bad, message, _remedy(best, fit.path))
    if given < _SURE and isinstance(sequence, ImageSequence):
        found = _other_depth(sequence, pairs, given, bad)
        if found is not None:
            return found
    if given > _MEANINGFUL:
        return Finding("pose convention", OK, f"{given:.0%} of the depth agrees with the poses, as {EXPECTED}")
    message = f"only {given:.0%} of the depth agrees with the poses, and no other convention fits"
    remedy = "check that poses, camera and frames are of one recording"
    # Poses of a file are about to be believed; wrong ones would smear the map without a word.
    is_sure = fit.path is not None and len(fit.pairs) >= _MIN_PAIRS
    return Finding("pose convention", bad if is_sure else WARNING, message, remedy)


def _other_depth(sequence: ImageSequence, pairs: Pairs, given: float, bad: str) -> Finding | None:
    """What would make depth agree with the poses: depth along the ray, or another unit; None if nothing would."""
    camera, calibration = sequence.intrinsics, sequence.calibration
    # Every scale fits a little where the camera only turns, so another one has to fit clearly better.
    scale = calibration.depth_scale
    others = [known for known in KNOWN_DEPTH_SCALES if known != scale]
    fits = {known: agreement(pairs, camera, depth_factor=scale / known) for known in others}
    better = max(others, key=lambda known: fits[known])
    along = agreement([(on_axis(a, camera), on_axis(b, camera)) for a, b in pairs], camera)
    if _is_clearly_better(fits[better], given) and fits[better] > along:
        message = f"with depth_scale {scale:g} {given:.0%} of the depth agrees with the poses, with {better:g} "
        message += f"{fits[better]:.0%}"
        return Finding("depth scale", bad, message, f"type --camera {camera_text(sequence, better)}")
    if not calibration.along_ray and along > max(_RAYS_SURE, given + _CLEARLY / 3):
        message = f"as depth along the axis {given:.0%} agrees with the poses, as depth along the ray {along:.0%}"
        return Finding("depth along the ray", bad, message, along_ray_remedy(sequence))
    return None


def _is_clearly_better(other: float, given: float) -> bool:
    """Whether an agreement is so much better than the one given that it is no chance: by far, or with half as much that
    disagrees.
    """
    halves = other > given + _CLEARLY / 2 and 1 - other < (1 - given) / 2
    return other > _MEANINGFUL and (other > given + _CLEARLY or halves)


def _remedy(reading: str, path: Path | None) -> str:
    """How to convert poses that are meant in another way."""
    if reading == W_FIRST:
        name = "FILE" if path is None else str(path)
        return f"type: awk '{{print $1,$2,$3,$4,$6,$7,$8,$5}}' {name} > xyzw.tum, and use that file"
    steps = []
    if reading.startswith("world"):
        steps.append("T = numpy.linalg.inv(T)")
    if reading.endswith("OpenGL axes"):
        steps.append("T[:, 1:3] *= -1")
    if "mirrored" in reading:
        steps.append("M = numpy.diag([1, -1, 1, 1]); T = M @ T @ M")
    return "convert each 4x4 matrix T: " + "; ".join(steps)


def camera_text(sequence: RgbdSequence, depth_scale: float | None = None) -> str:
    """The stored camera as ``--camera`` takes it."""
    if not isinstance(sequence, ImageSequence):
        return "FX,FY,CX,CY,WIDTH,HEIGHT,DEPTH_SCALE"
    k = sequence.calibration.stored
    numbers = (k.fx, k.fy, k.cx, k.cy, k.width, k.height, depth_scale or sequence.calibration.depth_scale)
    return ",".join(f"{number:g}" for number in numbers)


def along_ray_remedy(sequence: ImageSequence) -> str:
    """The line that makes a camera.yaml with ``along_ray``."""
    k = sequence.calibration.stored
    fields = f"fx: {k.fx:g}, fy: {k.fy:g}, cx: {k.cx:g}, cy: {k.cy:g}, width: {k.width}, height: {k.height}, "
    fields += f"depth_scale: {sequence.calibration.depth_scale:g}, along_ray: true"
    return f"type: echo '{{{fields}}}' > camera.yaml, in the folder of the sequence"
