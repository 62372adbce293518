"""Whether two keyframes show one place: three gates, each of which must be passed, and what is known then.

Geometry: features of one, at its depth, are seen by the other where one pose has them. Registration: from there direct
registration of each to the other comes to the same pose, with depth and grey values agreeing both ways, and no
direction left open. Depth: what each measured lies where the other measured, and next to none of it in space that the
other saw empty; and the frame does not look the same elsewhere along directions that depth leaves open
(`warpslam.tracking.direct.aliases`). The number of inliers alone proves nothing: opposite sides of a symmetric box have
more of them than two views of one side.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np

from warpslam.camera import Intrinsics
from warpslam.kernels.direct import registration
from warpslam.poses import inverse, motion_between, orthonormalized
from warpslam.scene.image_pool import ImagePool
from warpslam.tracking.direct.measures import Measures
from warpslam.tracking.direct.pyramid import records
from warpslam.tracking.direct.registrar import new_tasks
from warpslam.tracking.direct.second import Picture
from warpslam.tracking.direct.tracker import MAX_SIGMA, TELLING, DirectTracker, covariance_of
from warpslam.tracking.direct.window import Pose, refine_window
from warpslam.tracking.features.detection import DEPTH_STRIDE, FeatureFrame, detect
from warpslam.tracking.features.pairs import descriptor_pairs
from warpslam.tracking.features.settings import FeatureSettings

LEAST_INLIERS, LEAST_SHARE = 12, 0.25
"""Of the matches, for a pose to be tried further."""
INLIER_ERROR, LEAST_ERROR = 0.009, 2.5
"""Distance of an inlier, as a share of the image's width, and in pixels at least."""
LEAST_SEEN, MOST_EMPTY = 0.2, 0.06
"""Share of one's depth that the other must have measured as well; share of what both tell of that may be in empty
space.
"""
DRAWS, REFITS = 300, 3
"""Triples that are tried; fits to all inliers after that."""
TOLERANCE = 0.02, 4.0
"""Depths agree within this [m], and so many standard deviations more."""
LEAST_AGREEMENT, LEAST_CORRELATION, LEAST_VIEW = 0.75, 0.65, 0.2
"""Of a registration, both ways."""
SAME_ANSWER = 0.03, 1.5
"""Registrations of one to the other and back may differ by no more [m], [degrees]."""
ROUNDS = 4
"""Iterations over both ways together."""
CACHED = 48
"""Keyframes whose features are kept; those of others are found anew."""


class Gate(StrEnum):
    """What a candidate failed at, or all it passed."""

    GEOMETRY = "geometry"
    REGISTRATION = "registration"
    DEPTH = "depth"
    UNIQUE = "unique"
    PLAUSIBLE = "plausible"
    """That tracking may have drifted so far; asked by who knows the way between."""
    PASSED = "passed"


@dataclass(frozen=True, eq=False)
class Verdict:
    """What became of a candidate."""

    gate: Gate
    """The one that it failed at, or `Gate.PASSED`."""
    why: str = ""
    """In words."""
    T_a_b: np.ndarray | None = None
    """Where b is in the axes of a, (4, 4), where it is known."""
    covariance: np.ndarray | None = None
    """Of exp(e) on its right, e = (v, w), (6, 6), where all was passed."""


class FeatureCache:
    """Features of keyframes, found when they are wanted.

    Args:
        tracker: Whose keyframes they are of.
        images: Where theirs are kept.
    """

    def __init__(self, tracker: DirectTracker, images: ImagePool) -> None:
        self.tracker, self.images = tracker, images
        self.settings = FeatureSettings(max_depth=tracker.registrar.max_depth)
        self._known: OrderedDict[int, FeatureFrame] = OrderedDict()

    def of(self, number: int) -> FeatureFrame:
        """Those of a keyframe."""
        if number in self._known:
            self._known.move_to_end(number)
            return self._known[number]
        kept = self.images.kept(self.tracker.keyframes[number].image).unpack(self.tracker.camera)
        found = self._known[number] = self.of_picture(Picture.of(*kept))
        if len(self._known) > CACHED:
            self._known.popitem(last=False)
        return found

    def of_picture(self, picture: Picture) -> FeatureFrame:
        """Those of a frame."""
        return detect(picture.grey, picture.depth, self.tracker.camera, self.settings)


class Verifier:
    """Compares keyframes of a tracker.

    Args:
        tracker: That has them.
        features: Theirs.
    """

    def __init__(self, tracker: DirectTracker, features: FeatureCache) -> None:
        self.tracker, self.features = tracker, features

    def by_features(self, a: int, b: int) -> Verdict:
        """First gate: where b is by features that both have."""
        A, B = self.features.of(a), self.features.of(b)
        i, j = descriptor_pairs(A.descriptors, B.descriptors)
        both = (A.depth[i] > 0) & (B.depth[j] > 0)
        points, seen = A.points[i[both]].astype(np.float64), B.points[j[both]].astype(np.float64)
        if len(points) < LEAST_INLIERS:
            return Verdict(Gate.GEOMETRY, f"{len(points)} matches")
        T_b_a, inliers = rigid_motion(points, seen, self.tracker.camera)
        if inliers < LEAST_INLIERS or inliers < LEAST_SHARE * len(points):
            return Verdict(Gate.GEOMETRY, f"{inliers} inliers of {len(points)} matches")
        return Verdict(Gate.PASSED, T_a_b=inverse(T_b_a))

    def by_images(self, a: int, b: int, T_a_b: np.ndarray) -> Verdict:
        """The other gates, from where b is about."""
        registered = self._registered(a, b, T_a_b)
        T = registered.T_a_b
        if registered.gate is not Gate.PASSED or T is None:
            return registered
        A, B = self.features.of(a).thin_depth, self.features.of(b).thin_depth
        camera, max_depth = self.tracker.camera.strided(DEPTH_STRIDE), self.tracker.registrar.max_depth
        for one, other, T_other_one in ((A, B, inverse(T)), (B, A, T)):
            seen, empty = depth_consistency(one, other, T_other_one, camera, max_depth)
            if seen < LEAST_SEEN or empty > MOST_EMPTY:
                return Verdict(Gate.DEPTH, f"{seen:.0%} measured by both, {empty:.1%} of it where one saw nothing", T)
        elsewhere = self.tracker.difference_elsewhere(self.tracker.keyframe_row(b))
        if elsewhere < TELLING:
            return Verdict(Gate.UNIQUE, f"the frame differs from itself elsewhere by only {elsewhere:.2f}", T)
        return registered

    def _registered(self, a: int, b: int, T_a_b: np.ndarray) -> Verdict:
        """Each to the other, and then both ways together."""
        tracker, config = self.tracker, self.tracker.config
        registrar, rows = tracker.registrar, [tracker.keyframe_row(a), tracker.keyframe_row(b)]
        points = [tracker.points_of(a), tracker.points_of(b)]
        tasks = new_tasks(2)
        tasks["grey"], tasks["depth"] = config.grey_weight, config.depth_weight
        tasks["keyframe"], tasks["row"] = points, rows[::-1]
        tasks["top"], tasks["cost_level"] = min(registrar.plan.middle + 1, registrar.plan.top), 0
        tasks["T"] = inverse(T_a_b), T_a_b
        results = registrar.register(tasks)
        there, back = (np.asarray(result["T"], np.float64) for result in results)
        if not all(result["ok"] for result in results) or not np.isfinite([there, back]).all():
            return Verdict(Gate.REGISTRATION, "no registration came to an end")
        step, turn = motion_between(inverse(there), back)
        if step > SAME_ANSWER[0] or turn > SAME_ANSWER[1]:
            return Verdict(Gate.REGISTRATION, f"there and back differ by {step:.3f} m and {turn:.1f} degrees")
        members = [Pose(points[0], rows[0], np.eye(4), True), Pose(points[1], rows[1], orthonormalized(inverse(there)))]
        refined = refine_window(registrar, members, tracker.judged, config.grey_weight, config.depth_weight, ROUNDS)
        if not refined.information:
            return Verdict(Gate.REGISTRATION, "too little overlap")
        T, covariance = refined.poses[1], covariance_of(refined.information[0, 1])
        measures = self._measures(points, rows, T, results)
        sigma = float(np.linalg.eigvalsh(covariance[:3, :3])[-1]) ** 0.5
        why = ""
        for one in measures:
            if one.agreement < LEAST_AGREEMENT or one.correlation < LEAST_CORRELATION or one.view < LEAST_VIEW:
                why = (
                    f"{one.agreement:.0%} of the depth agrees, grey values correlate by {one.correlation:.2f}, "
                    f"{one.view:.0%} in view"
                )
        if not sigma < MAX_SIGMA:
            why = f"a direction is left open: uncertain by {sigma:.2f} m"
        return Verdict(Gate.REGISTRATION if why else Gate.PASSED, why, T, covariance)

    def _measures(self, points: list[int], rows: list[int], T: np.ndarray, results: Any) -> list[Measures]:
        """Of the pose that both ways came to, each way, the better of two levels."""
        tracker, config = self.tracker, self.tracker.config
        pairs = records(registration.Pair, 2)
        pairs["keyframe"], pairs["row"] = points, rows[::-1]
        pairs["T"], pairs["exposure"] = (inverse(T), T), [result["exposure"] for result in results]
        found = []
        levels = [
            tracker.registrar.pairs(level, pairs, config.grey_weight, config.depth_weight)
            for level in range(tracker.judged + 1)
        ]
        for n in range(2):
            each = [Measures.of(sums[n]["counts"]) for sums in levels]
            best = max(one.correlation for one in each)
            found.append(Measures(each[-1].view, each[-1].known, each[-1].agreement, best))
        return found


def rigid_motion(points: np.ndarray, seen: np.ndarray, camera: Intrinsics) -> tuple[np.ndarray, int]:
    """The motion that takes most points to where they are seen, in the image and in depth: fits to three pairs each
    (Kabsch), whose draws are always the same, and to all inliers of the best.

    Args:
        points: In the axes of one camera [m], (n, 3), n >= 3.
        seen: The same in those of another, (n, 3).
        camera: Both.

    Returns:
        T_seen_points (4, 4), and its inliers.
    """
    drawn = np.random.default_rng(0).random((DRAWS, len(points))).argpartition(2, axis=1)[:, :3]
    motions = _fitted(points[drawn], seen[drawn])
    inside = _agree(motions, points, seen, camera)
    best = int(inside.sum(axis=1).argmax())
    T, good = motions[best], inside[best]
    for _ in range(REFITS):
        if good.sum() < 3:
            break
        T = _fitted(points[None, good], seen[None, good])[0]
        good = _agree(T[None], points, seen, camera)[0]
    return orthonormalized(T), int(good.sum())


def _fitted(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Rigid motions (m, 4, 4) that take points a to b best, (m, k, 3)."""
    a0, b0 = a.mean(axis=1, keepdims=True), b.mean(axis=1, keepdims=True)
    U, _, Vt = np.linalg.svd(np.swapaxes(b - b0, 1, 2) @ (a - a0))
    U[:, :, 2] *= np.sign(np.linalg.det(U @ Vt))[:, None]
    T = np.tile(np.eye(4), (len(a), 1, 1))
    T[:, :3, :3] = U @ Vt
    T[:, :3, 3] = b0[:, 0] - np.einsum("mij,mj->mi", T[:, :3, :3], a0[:, 0])
    return T


def _agree(T: np.ndarray, points: np.ndarray, seen: np.ndarray, camera: Intrinsics) -> np.ndarray:
    """Which points come to where they are seen by each motion, bool (m, n)."""
    moved = np.einsum("mij,nj->mni", T[:, :3, :3], points) + T[:, None, :3, 3]
    z = np.maximum(moved[..., 2], 0.05)
    expected = camera.project(seen[:, 0], seen[:, 1], seen[:, 2])
    found = camera.project(moved[..., 0], moved[..., 1], z)
    pixels = np.hypot(found[0] - expected[0], found[1] - expected[1])
    close = np.abs(moved[..., 2] - seen[:, 2]) < 2.0 * TOLERANCE[0] + TOLERANCE[1] * _sigma(seen[:, 2])
    return np.asarray(close & (pixels < max(LEAST_ERROR, INLIER_ERROR * camera.width)))


def depth_consistency(
    one: np.ndarray, other: np.ndarray, T_other_one: np.ndarray, camera: Intrinsics, max_depth: float
) -> tuple[float, float]:
    """Where what one camera measured lies for another that measured, too.

    Args:
        one: z-depth [m], (H, W), 0 = missing.
        other: The same of the other camera.
        T_other_one: From the axes of the first to those of the other, (4, 4).
        camera: Of both images.
        max_depth: Larger depth counts as missing [m].

    Returns:
        Share of the first one's points that lie on what the other measured, and of those that do or would be in front
        of it, where it saw nothing, those that are in front. What lies behind may be hidden.
    """
    v, u = np.nonzero((one > 0) & (one < max_depth))
    if not len(v):
        return 0.0, 1.0
    points = camera.backproject(u.astype(float), v.astype(float), one[v, u].astype(float))
    points = points @ T_other_one[:3, :3].T + T_other_one[:3, 3]
    points = points[points[:, 2] > 0.05]
    x, y = np.rint(camera.project(*points.T)).astype(np.int64)
    inside = (x >= 1) & (y >= 1) & (x < camera.width - 1) & (y < camera.height - 1)
    x, y, z = x[inside], y[inside], points[inside, 2]
    near = np.stack([other[y + dy, x + dx] for dy in (-1, 0, 1) for dx in (-1, 0, 1)])
    known = (near > 0).all(axis=0) & (near < max_depth).all(axis=0)
    near, z = near[:, known], z[known]
    margin = TOLERANCE[0] + TOLERANCE[1] * _sigma(z)
    in_front = z < near.min(axis=0) - margin
    agree = ~in_front & (z < near.max(axis=0) + margin)
    return float(agree.sum() / len(v)), float(in_front.sum() / max(agree.sum() + in_front.sum(), 1))


def _sigma(z: np.ndarray) -> np.ndarray:
    """Standard deviation of depth [m], as registration has it."""
    return 0.0012 + 0.0019 * (z - 0.4) ** 2
